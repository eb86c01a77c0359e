//! Tests of the page in a browser, with cars that run as separate processes.
//!
//! Needs Chromium and its driver: `cargo test -p system-tests --features browser --test page`. Screenshots
//! go to the folder that `PITWALL_CI_OUTPUT` names, else to the folder for temporary files.

#![allow(
    clippy::too_many_lines,
    reason = "a test follows one user's steps from start to end"
)]

use std::process::{Child, Command, Stdio};
use std::sync::LazyLock;

use pitwall::{PageOptions, PitWallOptions, PitWallServer, read_events};
use serde_json::Value;
use system_tests::{Behaviour, Browser, FakeCar, free_endpoint, router, wait_until};
use tokio::sync::{Mutex, MutexGuard};

/// Held by the test that runs, so that only one uses the processor.
static ONE_AT_A_TIME: LazyLock<Mutex<()>> = LazyLock::new(Mutex::default);

struct TestBench {
    server: PitWallServer,
    endpoint: String,
    recordings: tempfile::TempDir,
    _guard: MutexGuard<'static, ()>,
}

impl TestBench {
    /// Starts a pit wall and its page on free ports.
    async fn start() -> Self {
        let guard = ONE_AT_A_TIME.lock().await;
        let endpoint = free_endpoint();
        let recordings = tempfile::tempdir().expect("a folder");
        let server = PitWallServer::start(PitWallOptions {
            role: router(&endpoint),
            page: PageOptions {
                address: ([127, 0, 0, 1], 0).into(),
                recordings: recordings.path().to_owned(),
                ..PageOptions::default()
            },
        })
        .await
        .expect("a pit wall");
        Self {
            server,
            endpoint,
            recordings,
            _guard: guard,
        }
    }

    async fn browser(&self) -> Browser {
        Browser::open(self.server.url(), 1366, 768).await
    }
}

/// A car in a process of its own. Dropping it kills the process.
struct CarProcess(Child);

impl CarProcess {
    fn race(name: &str, start: f64, endpoint: &str) -> Self {
        let child = Command::new(env!("CARGO_BIN_EXE_test-car"))
            .args(["race", name, &start.to_string(), endpoint])
            .stdin(Stdio::null())
            .spawn();
        Self(child.expect("a car"))
    }

    /// Kills the process, as a power cut would.
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

fn logged(text: &str) -> String {
    format!("[...document.querySelectorAll('#log li')].some((line) => line.textContent.includes('{text}'))")
}

fn number(value: &Value) -> f64 {
    value.as_f64().expect("a number")
}

/// Repeats an action on a car until the car accepts it, and returns the text on its card. On a busy machine an answer may
/// come too late; the page then shows NO ANSWER, and repeating the command is harmless.
async fn until_done(browser: &Browser, car: &str, act: impl AsyncFn()) -> String {
    let answer = format!(
        "(() => {{ const note = {}.querySelector('.note p'); return /done|failed/.test(note.className) && [note.className, note.textContent]; }})()",
        card(car)
    );
    for _ in 0..10 {
        act().await;
        let note = browser.wait("an answer or a failure on the card", &answer).await;
        let [kind, text] = [0, 1].map(|i| note[i].as_str().unwrap_or_default().to_owned());
        if kind == "done" {
            return text;
        }
        assert!(text.contains("NO ANSWER"), "{text}");
    }
    panic!("no answer of {car} came in time");
}

/// A race engineer watches three cars, switches a set, sets a pose, and sees one car fall silent.
#[tokio::test(flavor = "multi_thread")]
async fn three_cars_are_shown_switched_relocated_and_lost() {
    let bench = TestBench::start().await;
    let mut cars: Vec<CarProcess> = [("car-1", -4.0), ("car-2", -12.0), ("car-3", -20.0)]
        .map(|(name, start)| CarProcess::race(name, start, &bench.endpoint))
        .into();
    let ana = bench.browser().await;
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

    // Screenshots of two sizes in both themes.
    ana.evaluate(
        "document.documentElement.dataset.theme === 'dark' || document.getElementById('theme').click()",
    )
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
                ana.evaluate(overflow).await,
                false,
                "an element overflows at {width}x{height}"
            );
            ana.screenshot(&format!("page-{theme}-{width}x{height}")).await;
        }
        ana.key("t").await;
    }
    ana.resize(1366, 768).await;

    let ben = bench.browser().await;
    ben.wait(
        "the other browser has the cars",
        "document.querySelectorAll('.card').length === 3",
    )
    .await;
    ben.fill("#operator", "ben").await;
    ana.wait(
        "the other operator is shown",
        "document.getElementById('people').textContent.includes('ben')",
    )
    .await;

    // A switch by one operator is confirmed and seen by both.
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
                "the switch is in the log",
                &logged("car-2 set lq (revision 2) replaces hq"),
            )
            .await;
        browser.wait("the operator is in the log", &logged("[ana]")).await;
    }

    // The other operator drags a pose.
    ben.click(".card[data-car=\"car-3\"]").await;
    ben.wait("car-3 is selected", "pitwall.selected === 'car-3'")
        .await;
    let canvas = "document.getElementById('map').getBoundingClientRect()";
    let at = |x: f64, y: f64| {
        format!(
            "((box) => {{ const [x, y] = pitwall.toCanvas({x}, {y}); return [box.left + x, box.top + y]; }})({canvas})"
        )
    };
    // The drag starts at the car and goes along its heading.
    let pressed = std::cell::Cell::new((0.0, 0.0));
    let drag_pose = async || {
        ben.click("#place").await;
        let pose = ben
            .evaluate("((p) => [p.x_m, p.y_m, p.heading_rad])(pitwall.snapshot.cars.find((c) => c.car === 'car-3').pose)")
            .await;
        let [x, y, heading] = [0, 1, 2].map(|i| number(&pose[i]));
        let [from, to] = [
            ben.evaluate(&at(x, y)).await,
            ben.evaluate(&at(x + 3.0 * heading.cos(), y + 3.0 * heading.sin()))
                .await,
        ]
        .map(|point| [number(&point[0]), number(&point[1])]);
        pressed.set((x, y));
        ben.drag(from, to).await;
    };
    until_done(&ben, "car-3", drag_pose).await;
    let (x, y) = pressed.get();
    for browser in [&ana, &ben] {
        browser
            .wait("the log has the pose", &logged("car-3 initial pose ("))
            .await;
    }
    let given = ben
        .evaluate("[...document.querySelectorAll('#log li')].find((line) => line.textContent.includes('car-3 initial pose (') && line.textContent.includes('[ben]')).textContent.match(/-?\\d+\\.\\d+/g).map(Number)")
        .await;
    let off = (number(&given[0]) - x).hypot(number(&given[1]) - y);
    assert!(
        off < 0.3,
        "pressed at ({x:.2}, {y:.2}), taken as {given}: {off:.2} m off"
    );

    // A car is killed. Its card turns grey on both pages.
    for browser in [&ana, &ben] {
        browser
            .evaluate(&format!(
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
                "the card shows for how long",
                &format!("{}.innerText.match(/silent for \\d/)", card("car-1")),
            )
            .await;
        browser
            .wait("there is an alarm", "!document.getElementById('alarm').hidden")
            .await;
    }
    ana.screenshot("page-car-1-blind").await;

    // One operator acknowledges the alarm for all.
    ana.click("#alarm").await;
    for browser in [&ana, &ben] {
        browser
            .wait("no alarm is open", "document.getElementById('alarm').hidden")
            .await;
    }
    let origin = bench.server.url().to_owned();
    for browser in [ana, ben] {
        browser.expect_clean(&origin).await;
        browser.close().await;
    }
    bench.server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn refusals_timeouts_candidates_and_markers_are_shown() {
    let bench = TestBench::start().await;
    let car = FakeCar::start("car-1", &bench.endpoint, Behaviour::default()).await;
    let silent = FakeCar::start_mute(&bench.endpoint).await;
    let browser = bench.browser().await;
    browser
        .wait(
            "both cars",
            "document.querySelectorAll('.card button[data-set=lq]').length === 2",
        )
        .await;
    browser.fill("#operator", "ana").await;

    // A timeout is shown differently from a refusal.
    browser.click(".card[data-car=mute] button[data-set=lq]").await;
    let failed = |name: &str| format!("{}.querySelector('.note p.failed')?.textContent", card(name));
    let text = browser.wait("the timeout is shown", &failed("mute")).await;
    assert!(
        text.as_str().is_some_and(|text| text.contains("NO ANSWER")),
        "{text}"
    );
    browser.click(".card[data-car=car-1]").await;
    browser
        .wait("car-1 is selected", "pitwall.selected === 'car-1'")
        .await;
    browser.key("c").await;
    let text = browser.wait("the refusal is shown", &failed("car-1")).await;
    assert!(
        text.as_str().is_some_and(|text| text.contains("REFUSED")),
        "{text}"
    );

    // Relocalization returns candidates to choose from.
    browser.key("g").await;
    browser
        .wait(
            "three candidates",
            "document.querySelectorAll('#candidates button').length === 3",
        )
        .await;
    browser.click("#candidates button:nth-child(2)").await;
    let done = format!("{}.querySelector('.note p.done')", card("car-1"));
    browser.wait("the choice is accepted", &done).await;
    browser
        .wait(
            "no candidates are left",
            "document.getElementById('candidates').hidden",
        )
        .await;

    // A lap's sectors add up to its time.
    browser.click("#tab-laps").await;
    let sectors = "(() => { const row = [...document.querySelectorAll('#laps tr')].map((r) => [...r.cells].map((c) => c.textContent)) \
                   .find((r) => r[5]?.match(/^\\d/) && r[3].match(/^\\d/)); return row && row.slice(1, 6).map(Number); })()";
    let lap = browser.wait("a lap with all sectors", sectors).await;
    let [time, one, two, three] = [0, 2, 3, 4].map(|i| number(&lap[i]));
    // Fake cars report 2 s for every lap. Each sector is rounded to a hundredth.
    assert!((one + two + three - time).abs() < 0.5, "{lap}");

    // A marker goes into the recording.
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
        .wait("the marker is in the log", &logged("rain at turn two [ana]"))
        .await;
    browser.key("r").await;
    browser
        .wait(
            "it is saved",
            "document.getElementById('recording').textContent.includes('saved')",
        )
        .await;
    let file = std::fs::read_dir(bench.recordings.path())
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

    // The large view, the help and every tab open without an error.
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
    browser.screenshot("page-large").await;
    browser.key("Escape").await;
    browser.expect_clean(bench.server.url()).await;

    // After the pit wall has stopped, the page is grey and shows the age of its data.
    let TestBench { server, .. } = bench;
    server.stop().await;
    browser
        .wait("the page is grey", "document.body.classList.contains('cut') && document.getElementById('link').textContent.includes('no news for')")
        .await;
    browser.screenshot("page-cut").await;
    browser.close().await;
    drop((car, silent));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_recording_is_replayed_on_the_same_page() {
    let guard = ONE_AT_A_TIME.lock().await;
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
    // The replay is paused before the page opens.
    replay
        .set_playback(Some(false), Some(2.0), Some(0.5))
        .expect("valid settings");
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
            "it is paused at the time given",
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
    let laps = replay.bus().fleet().cars().next().map(|car| car.laps().len());
    assert!(laps.is_some_and(|laps| laps >= 2), "{laps:?}");
    browser.screenshot("page-replay").await;
    let epoch = number(&browser.evaluate("pitwall.snapshot.epoch").await);
    browser.key(",").await;
    browser
        .wait("it has jumped back", &format!("pitwall.snapshot.epoch > {epoch}"))
        .await;
    browser.expect_clean(page.url()).await;
    browser.close().await;
    page.stop().await;
    replay.stop();
    drop(guard);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_session_is_found_and_replayed_beside_the_live_view() {
    let bench = TestBench::start().await;
    let service = bench.server.service();
    let car = FakeCar::start("car-1", &bench.endpoint, Behaviour::default()).await;
    let file = bench.recordings.path().join("wet-morning.mcap");
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
    std::fs::write(bench.recordings.path().join("torn.mcap"), b"no recording").expect("written");

    let browser = bench.browser().await;
    browser.wait("the car is there", &card("car-1")).await;
    browser.click("#sessions-button").await;
    let rows = "[...document.querySelectorAll('#sessions-table tr')].map((row) => row.innerText)";
    browser
        .wait(
            "both files are listed, and the index is read",
            &format!(
                "{rows}.length === 3 && document.getElementById('sessions-said').textContent === '2 sessions'"
            ),
        )
        .await;
    browser.screenshot("page-sessions").await;
    let listed = browser.evaluate(&format!("{rows}.join(' / ')")).await;
    let listed = listed.as_str().unwrap_or_default();
    assert!(
        listed.contains("DAMAGED") && listed.contains("nothing"),
        "{listed}"
    );
    browser.fill("#sessions-words", "wet CAR-1").await;
    browser
        .wait(
            "one is left",
            &format!("{rows}.length === 2 && {rows}[1].includes('wet-morning')"),
        )
        .await;
    // The test has no second tab: the address is what counts.
    browser
        .evaluate("window.open = () => ({ close() {}, set location(url) { window.opened = url; } })")
        .await;
    browser.click("#sessions-table button").await;
    let url = browser.wait("its page is served", "window.opened").await;
    let replay = Browser::open(url.as_str().expect("an address"), 1366, 768).await;
    replay
        .wait(
            "the recording is played there",
            "pitwall.snapshot?.replay?.file.endsWith('wet-morning.mcap')",
        )
        .await;
    replay.close().await;
    let live = browser.evaluate("pitwall.snapshot.replay").await;
    assert!(live.is_null(), "the first page is still live");
    browser.expect_clean(bench.server.url()).await;
    browser.close().await;
    drop(car);
    bench.server.stop().await;
}
