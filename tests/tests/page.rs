//! The page as its users have it: in a browser, with cars that are processes of their own.
//!
//! Needs Chromium and its driver: `cargo test -p system-tests --features browser --test page`. Pictures go to the
//! folder that `PITWALL_CI_OUTPUT` names, else to the system's folder for temporary files.

#![allow(
    clippy::too_many_lines,
    reason = "a story is told from its beginning to its end"
)]

use std::process::{Child, Command, Stdio};
use std::sync::LazyLock;

use pitwall::{PageOptions, PitWallOptions, PitWallServer, read_events};
use serde_json::Value;
use system_tests::{Behaviour, Browser, FakeCar, free_endpoint, router, wait_until};
use tokio::sync::{Mutex, MutexGuard};

/// One browser at a time is enough for two cores.
static TURN: LazyLock<Mutex<()>> = LazyLock::new(Mutex::default);

struct Stage {
    server: PitWallServer,
    endpoint: String,
    recordings: tempfile::TempDir,
    _turn: MutexGuard<'static, ()>,
}

impl Stage {
    /// A pit wall with its page, at ports that nobody else uses.
    async fn set() -> Self {
        let turn = TURN.lock().await;
        let endpoint = free_endpoint();
        let recordings = tempfile::tempdir().expect("a folder");
        let server = PitWallServer::start(PitWallOptions {
            role: router(&endpoint),
            page: PageOptions {
                address: ([127, 0, 0, 1], 0).into(),
                recordings: recordings.path().to_owned(),
            },
        })
        .await
        .expect("a pit wall");
        Self {
            server,
            endpoint,
            recordings,
            _turn: turn,
        }
    }

    async fn browser(&self) -> Browser {
        Browser::open(self.server.url(), 1366, 768).await
    }
}

/// A process that a test ends by force.
struct CarProcess(Child);

impl CarProcess {
    fn race(name: &str, start: f64, endpoint: &str) -> Self {
        let child = Command::new(env!("CARGO_BIN_EXE_test-car"))
            .args(["race", name, &start.to_string(), endpoint])
            .stdin(Stdio::null())
            .spawn();
        Self(child.expect("a car"))
    }

    /// Ends it as a power cut does.
    fn kill(&mut self) {
        self.0.kill().expect("killed");
    }
}

impl Drop for CarProcess {
    fn drop(&mut self) {
        drop(self.0.kill());
        drop(self.0.wait());
    }
}

fn card(car: &str) -> String {
    format!("document.querySelector('.card[data-car=\"{car}\"]')")
}

fn said(text: &str) -> String {
    format!("[...document.querySelectorAll('#log li')].some((line) => line.textContent.includes('{text}'))")
}

fn number(value: &Value) -> f64 {
    value.as_f64().expect("a number")
}

/// Does something to a car until the car says that it is done, and returns what it says. Where the machine has much else
/// to do, an answer may not come in time: the page says so, and giving the command again is harmless.
async fn until_done(browser: &Browser, car: &str, act: impl AsyncFn()) -> String {
    let answer = format!(
        "(() => {{ const note = {}.querySelector('.note p'); return /done|failed/.test(note.className) && [note.className, note.textContent]; }})()",
        card(car)
    );
    for _ in 0..10 {
        act().await;
        let said = browser.wait("the car answers, or does not", &answer).await;
        let [kind, text] = [0, 1].map(|i| said[i].as_str().unwrap_or_default().to_owned());
        if kind == "done" {
            return text;
        }
        assert!(text.contains("NO ANSWER"), "{text}");
    }
    panic!("{car} never answers in time");
}

/// A race engineer's session, from the first car to a lost one.
#[tokio::test(flavor = "multi_thread")]
async fn three_cars_are_seen_switched_placed_and_lost() {
    let stage = Stage::set().await;
    let mut cars: Vec<CarProcess> = [("car-1", -4.0), ("car-2", -12.0), ("car-3", -20.0)]
        .map(|(name, start)| CarProcess::race(name, start, &stage.endpoint))
        .into();
    let ana = stage.browser().await;
    for car in ["car-1", "car-2", "car-3"] {
        let localized = format!("{}?.innerText.includes('LOCALIZED')", card(car));
        ana.wait("the car appears and is localized", &localized).await;
    }
    ana.wait(
        "the map is drawn",
        "pitwall.toCanvas(0, 0).every(Number.isFinite)",
    )
    .await;
    ana.fill("#operator", "ana").await;

    // Two sizes and both themes, to be looked at.
    ana.ask("document.documentElement.dataset.theme === 'dark' || document.getElementById('theme').click()")
        .await;
    for theme in ["dark", "light"] {
        ana.wait(
            "the theme",
            &format!("document.documentElement.dataset.theme === '{theme}'"),
        )
        .await;
        for (width, height) in [(1366, 768), (1024, 768)] {
            ana.resize(width, height).await;
            ana.wait(
                "the map fits again",
                "document.getElementById('map').width === document.getElementById('map').clientWidth",
            )
            .await;
            let overflow = "document.documentElement.scrollWidth > innerWidth || \
                            [...document.querySelectorAll('.card')].some((card) => card.scrollWidth > card.clientWidth + 1)";
            assert_eq!(
                ana.ask(overflow).await,
                false,
                "something is wider than its place at {width}x{height}"
            );
            ana.picture(&format!("page-{theme}-{width}x{height}")).await;
        }
        ana.key("t").await;
    }
    ana.resize(1366, 768).await;

    let ben = stage.browser().await;
    ben.wait(
        "the other browser has the cars",
        "document.querySelectorAll('.card').length === 3",
    )
    .await;
    ben.fill("#operator", "ben").await;
    ana.wait(
        "who else looks is visible",
        "document.getElementById('people').textContent.includes('ben')",
    )
    .await;

    // A switch, clicked and confirmed, and seen by the other.
    let switch = async || ana.click(".card[data-car=\"car-2\"] button[data-set=lq]").await;
    let answer = until_done(&ana, "car-2", switch).await;
    assert!(answer.contains("lq (revision"), "{answer}");
    let pressed = format!(
        "{}.querySelector('button[data-set=lq]')?.getAttribute('aria-pressed') === 'true'",
        card("car-2")
    );
    for browser in [&ana, &ben] {
        browser.wait("lq is in force", &pressed).await;
        browser
            .wait(
                "the log tells who",
                &said("car-2 set lq (revision 2) replaces hq"),
            )
            .await;
        browser.wait("by name", &said("[ana]")).await;
    }

    // A pose, dragged on the other browser.
    ben.click(".card[data-car=\"car-3\"]").await;
    ben.wait("car-3 is selected", "pitwall.selected === 'car-3'")
        .await;
    let canvas = "document.getElementById('map').getBoundingClientRect()";
    let at = |x: f64, y: f64| {
        format!(
            "((box) => {{ const [x, y] = pitwall.toCanvas({x}, {y}); return [box.left + x, box.top + y]; }})({canvas})"
        )
    };
    // Where the car is now, towards where it heads: a pose that an engineer could give.
    let pressed = std::cell::Cell::new((0.0, 0.0));
    let place = async || {
        ben.click("#place").await;
        let pose = ben
            .ask("((p) => [p.x_m, p.y_m, p.heading_rad])(pitwall.snapshot.cars.find((c) => c.car === 'car-3').pose)")
            .await;
        let [x, y, heading] = [0, 1, 2].map(|i| number(&pose[i]));
        let [from, to] = [
            ben.ask(&at(x, y)).await,
            ben.ask(&at(x + 3.0 * heading.cos(), y + 3.0 * heading.sin()))
                .await,
        ]
        .map(|point| [number(&point[0]), number(&point[1])]);
        pressed.set((x, y));
        ben.drag(from, to).await;
    };
    until_done(&ben, "car-3", place).await;
    let (x, y) = pressed.get();
    for browser in [&ana, &ben] {
        browser
            .wait("the log has the pose", &said("car-3 initial pose ("))
            .await;
    }
    let given = ben
        .ask("[...document.querySelectorAll('#log li')].find((line) => line.textContent.includes('car-3 initial pose (') && line.textContent.includes('[ben]')).textContent.match(/-?\\d+\\.\\d+/g).map(Number)")
        .await;
    let off = (number(&given[0]) - x).hypot(number(&given[1]) - y);
    assert!(
        off < 0.3,
        "pressed at ({x:.2}, {y:.2}), taken as {given}: {off:.2} m off"
    );

    // A car is killed: its card turns grey on both. The page itself watches for that.
    for browser in [&ana, &ben] {
        browser
            .ask(&format!(
                "new MutationObserver(() => {{ if (!window.greyed && {card}.classList.contains('blind')) window.greyed = Date.now(); }})\
                 .observe({card}, {{attributes: true}})",
                card = card("car-1")
            ))
            .await;
    }
    cars[0].kill();
    for browser in [&ana, &ben] {
        browser.wait("the card is grey", "window.greyed").await;
        browser
            .wait(
                "it says for how long",
                &format!("{}.innerText.match(/silent for \\d/)", card("car-1")),
            )
            .await;
        browser
            .wait("there is an alarm", "!document.getElementById('alarm').hidden")
            .await;
    }
    ana.picture("page-car-1-blind").await;

    // Seen by one, and so by all.
    ana.click("#alarm").await;
    for browser in [&ana, &ben] {
        browser
            .wait("no alarm is open", "document.getElementById('alarm').hidden")
            .await;
    }
    let origin = stage.server.url().to_owned();
    for browser in [ana, ben] {
        browser.expect_clean(&origin).await;
        browser.close().await;
    }
    stage.server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn refusals_silence_candidates_and_markers_are_shown() {
    let stage = Stage::set().await;
    let car = FakeCar::start("car-1", &stage.endpoint, Behaviour::default()).await;
    let silent = FakeCar::start_mute(&stage.endpoint).await;
    let browser = stage.browser().await;
    browser
        .wait(
            "both cars",
            "document.querySelectorAll('.card button[data-set=lq]').length === 2",
        )
        .await;
    browser.fill("#operator", "ana").await;

    // No answer reads differently from a refusal.
    browser.click(".card[data-car=mute] button[data-set=lq]").await;
    let failed = |name: &str| format!("{}.querySelector('.note p.failed')?.textContent", card(name));
    let text = browser.wait("the silence is told", &failed("mute")).await;
    assert!(
        text.as_str().is_some_and(|text| text.contains("NO ANSWER")),
        "{text}"
    );
    browser.click(".card[data-car=car-1]").await;
    browser
        .wait("car-1 is selected", "pitwall.selected === 'car-1'")
        .await;
    browser.key("c").await;
    let text = browser.wait("the refusal is told", &failed("car-1")).await;
    assert!(
        text.as_str().is_some_and(|text| text.contains("REFUSED")),
        "{text}"
    );

    // A search answers with places to pick from.
    browser.key("g").await;
    browser
        .wait(
            "three candidates",
            "document.querySelectorAll('#candidates button').length === 3",
        )
        .await;
    browser.click("#candidates button:nth-child(2)").await;
    let done = format!("{}.querySelector('.note p.done')", card("car-1"));
    browser.wait("the pick is taken", &done).await;
    browser
        .wait(
            "nothing is left to pick",
            "document.getElementById('candidates').hidden",
        )
        .await;

    // Laps have sectors that add up.
    browser.click("#tab-laps").await;
    let sectors = "(() => { const row = [...document.querySelectorAll('#laps tr')].map((r) => [...r.cells].map((c) => c.textContent)) \
                   .find((r) => r[5]?.match(/^\\d/) && r[3].match(/^\\d/)); return row && row.slice(1, 6).map(Number); })()";
    let lap = browser.wait("a lap with all sectors", sectors).await;
    let [time, one, two, three] = [0, 2, 3, 4].map(|i| number(&lap[i]));
    // Fake cars tell 2 s for a lap whatever it took; each sector is rounded to a hundredth.
    assert!((one + two + three - time).abs() < 0.5, "{lap}");

    // What the engineer types goes into the recording.
    browser.key("r").await;
    browser
        .wait(
            "it records",
            "document.getElementById('recording').textContent.includes('nothing missing')",
        )
        .await;
    browser.key("m").await;
    browser
        .wait("the dialog", "document.getElementById('marker').open")
        .await;
    browser.fill("#marker-text", "rain at turn two").await;
    browser
        .wait("the marker is in the log", &said("rain at turn two [ana]"))
        .await;
    browser.key("r").await;
    browser
        .wait(
            "it is saved",
            "document.getElementById('recording').textContent.includes('saved')",
        )
        .await;
    let file = std::fs::read_dir(stage.recordings.path())
        .expect("a folder")
        .next()
        .expect("a recording")
        .expect("readable")
        .path();
    let markers: Vec<String> = read_events(&file)
        .expect("a recording")
        .filter_map(|event| match event.expect("whole").payload {
            pitwall::EventPayload::Marker { who, text } => Some(format!("{who}: {text}")),
            _ => None,
        })
        .collect();
    assert_eq!(markers, ["ana: rain at turn two"]);

    // The large view, the help, and every tab open without a fault.
    for key in ["o", "p", "u", "Escape", "f", "0", "e", "ArrowDown", "ArrowUp"] {
        browser.key(key).await;
    }
    browser.key("o").await;
    browser
        .wait(
            "the large view",
            "document.querySelector('#large .headline')?.innerText.includes('LOCALIZED')",
        )
        .await;
    browser.picture("page-large").await;
    browser.key("Escape").await;
    browser.expect_clean(stage.server.url()).await;

    // The program ends: everything on the page is old, and says so.
    let Stage { server, .. } = stage;
    server.stop().await;
    browser
        .wait("the page is grey", "document.body.classList.contains('cut') && document.getElementById('link').textContent.includes('no news for')")
        .await;
    browser.picture("page-cut").await;
    browser.close().await;
    drop((car, silent));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_recording_is_replayed_on_the_same_page() {
    let turn = TURN.lock().await;
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("session.mcap");
    let endpoint = free_endpoint();
    let service = pitwall::FleetService::open(&router(&endpoint))
        .await
        .expect("a link");
    let car = FakeCar::start("car-1", &endpoint, Behaviour::default()).await;
    service.start_recording(&file).await.expect("a new file");
    wait_until("two laps are recorded", || {
        service
            .fleet()
            .car(car.name())
            .is_some_and(|car| car.laps().len() >= 2)
    })
    .await;
    service
        .stop_recording()
        .await
        .expect("a recording")
        .expect("a good file");
    drop(car);
    service.close().await;

    let replay = pitwall::Replay::start(&file).expect("a good file");
    // It waits at its begin until the page is there.
    replay
        .steer(Some(false), Some(2.0), Some(0.5))
        .expect("a good wish");
    let options = PageOptions {
        address: ([127, 0, 0, 1], 0).into(),
        ..PageOptions::default()
    };
    let page = pitwall::Page::serve_replay(replay.clone(), options)
        .await
        .expect("a page");
    let browser = Browser::open(page.url(), 1366, 768).await;
    let localized = format!("{}?.innerText.includes('LOCALIZED')", card("car-1"));
    browser.wait("the car drives again", &localized).await;
    browser
        .wait(
            "it is paused where it was put",
            "Math.abs(pitwall.snapshot.replay.at_s - 0.5) < 0.01",
        )
        .await;
    browser.key(" ").await;
    browser
        .wait(
            "it plays to its end",
            "pitwall.snapshot.replay.at_s === pitwall.snapshot.replay.duration_s",
        )
        .await;
    let laps = replay.board().fleet().cars().next().map(|car| car.laps().len());
    assert!(laps.is_some_and(|laps| laps >= 2), "{laps:?}");
    browser.picture("page-replay").await;
    let epoch = number(&browser.ask("pitwall.snapshot.epoch").await);
    browser.key(",").await;
    browser
        .wait("it has jumped back", &format!("pitwall.snapshot.epoch > {epoch}"))
        .await;
    browser.expect_clean(page.url()).await;
    browser.close().await;
    page.stop().await;
    replay.stop();
    drop(turn);
}
