//! Tests of the page in a browser, with cars that run as separate processes.
//!
//! Needs Chromium and its driver: `cargo test -p system-tests --features browser --test page`. Screenshots
//! go to the folder that `PITWALL_CI_OUTPUT` names, else to the folder for temporary files.

#![allow(
    clippy::too_many_lines,
    reason = "a test follows one user's steps from start to end"
)]

use std::process::{Child, Command, Stdio};
use std::sync::{Arc, LazyLock};

use pitwall::{Fleet, PageOptions, PitWallOptions, PitWallServer, read_events};
use serde_json::Value;
use system_tests::{Behaviour, Browser, FakeCar, RaceSession, free_endpoint, router, wait_until};
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
            protection: keys::Protection::None,
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

/// Waits for a question and gives its first answer.
async fn answer_question(browser: &Browser, question: &str) {
    let asked = format!(
        "document.getElementById('ask').open && document.getElementById('ask-text').textContent.includes('{question}')"
    );
    browser.wait("the page asks first", &asked).await;
    browser.click("#ask-answers button").await;
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
            // Three cars once needed a scroll bar.
            let below = "[...document.querySelectorAll('.card')].some((card) => card.getBoundingClientRect().bottom > innerHeight)";
            assert_eq!(
                ana.evaluate(below).await,
                false,
                "a card is out of sight at {width}x{height}"
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
                &format!("{}.innerText.match(/\\d( s)? silent/)", card("car-1")),
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
    answer_question(&browser, "Search the whole map for car-1?").await;
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

    // A limit of one's own raises an alarm, and is kept with the track.
    let note = "alarm limits: alignment 95 %";
    browser.click("#tab-log").await;
    browser.click("#limits-button").await;
    browser
        .wait("the dialog", "document.getElementById('limits').open")
        .await;
    browser.fill("#limit-alignment", "95").await;
    browser
        .wait(
            "an alarm",
            &logged("car-1 alignment 90.0 % beyond the limit of 95.0 % at s ="),
        )
        .await;
    browser.wait("the limits are in the log", &logged(note)).await;
    assert_eq!(
        std::fs::read_dir(bench.recordings.path().join("tracks"))
            .expect("a folder of tracks")
            .count(),
        1
    );

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
    // A value must be beyond its limit for a moment before it is an alarm.
    tokio::time::sleep(std::time::Duration::from_secs(2)).await;
    browser.key("r").await;
    answer_question(&browser, "Stop the recording?").await;
    browser
        .wait(
            "it is saved",
            "document.getElementById('recording').textContent.includes('saved')",
        )
        .await;
    let file = std::fs::read_dir(bench.recordings.path())
        .expect("a folder")
        .map(|entry| entry.expect("readable").path())
        .find(|path| path.extension().is_some_and(|extension| extension == "mcap"))
        .expect("a recording");
    let markers: Vec<String> = read_events(&file)
        .expect("a recording")
        .filter_map(|event| match event.expect("whole").payload {
            pitwall::EventPayload::Marker { who, text } => Some(format!("{who}: {text}")),
            _ => None,
        })
        .collect();
    // The limits that held at its start, once for each car on the track.
    let limits = format!("pit wall: {note}");
    let (limits, others): (Vec<String>, Vec<String>) =
        markers.into_iter().partition(|marker| *marker == limits);
    assert_eq!(
        (limits.len(), &others[..]),
        (2, &["ana: rain at turn two".to_owned()][..])
    );
    let mut replayed = Fleet::default();
    for event in read_events(&file).expect("a recording") {
        replayed.apply(&event.expect("whole"));
    }
    let alarms = replayed.log().since(0).filter(|entry| entry.kind == "limit");
    assert!(alarms.count() > 0, "a replay raises the engineer's alarms, too");

    // The run sheet is shown with the car.
    browser.key("w").await;
    browser
        .wait("the dialog", "document.getElementById('sheet').open")
        .await;
    browser.fill("#sheet-tyre", "taped").await;
    browser
        .wait(
            "the run sheet is in the log",
            &logged("run sheet: tyre: taped [ana]"),
        )
        .await;
    browser
        .wait(
            "it is with the car",
            "pitwall.snapshot.cars[0].run_sheet === 'tyre: taped'",
        )
        .await;

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
    // Numbers once overlapped in a wide window.
    browser.resize(1920, 1080).await;
    let overlaps = "[...document.querySelectorAll('#large .big b')].some((value) => value.getBoundingClientRect().right > value.parentElement.getBoundingClientRect().right + 1)";
    assert_eq!(browser.evaluate(overlaps).await, false, "numbers overlap");
    browser.resize(1366, 768).await;
    browser.screenshot("page-large").await;
    browser
        .evaluate("((list) => { list.value = 'mute'; list.dispatchEvent(new Event('change')); })(document.querySelector('#large select'))")
        .await;
    browser
        .wait(
            "two cars side by side",
            "document.querySelector('#large-2 .headline')?.innerText.includes('mute')",
        )
        .await;
    browser.screenshot("page-large-two").await;
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
    let (page, browser) = page_of(&replay).await;
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

/// The page of a replay, and a browser that shows it.
async fn page_of(replay: &Arc<pitwall::Replay>) -> (pitwall::Page, Browser) {
    let options = PageOptions {
        address: ([127, 0, 0, 1], 0).into(),
        ..PageOptions::default()
    };
    let page = pitwall::Page::serve_replay(replay.clone(), options)
        .await
        .expect("a page");
    let browser = Browser::open(page.url(), 1366, 768).await;
    (page, browser)
}

/// The numbers in a text, in their order.
fn numbers_in(text: &str) -> Vec<f64> {
    let parts = text.split(|c: char| !(c.is_ascii_digit() || c == '.'));
    parts.filter_map(|part| part.parse().ok()).collect()
}

/// The page shows a race with the figures of `car-node race --json`. The report is compared in `race_figures.rs`.
#[tokio::test(flavor = "multi_thread")]
async fn a_race_has_the_same_figures_on_the_page() {
    /// Times are shown to a millisecond. The car times its laps by its own pose: the line is passed up to a centimetre early or
    /// late \[s\].
    const TIME_S: f64 = 5.5e-3;
    let guard = ONE_AT_A_TIME.lock().await;
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("race.mcap");
    let session = RaceSession::two_heats();
    let heats = {
        let (session, file) = (session.clone(), file.clone());
        let recorded = tokio::task::spawn_blocking(move || session.record(&file)).await;
        recorded.expect("no panic").expect("a recording").0
    };
    let replay = pitwall::Replay::start(&file).expect("a good file");
    replay
        .set_playback(Some(false), None, Some(1e6))
        .expect("its end");
    let (page, browser) = page_of(&replay).await;
    browser.key("l").await;
    let rows = |table: &str| {
        format!(
            "[...document.querySelectorAll('#{table} tr')].slice(1).map((row) => [...row.cells].map((cell) => [cell.innerText, cell.title]))"
        )
    };
    let near = |what: &str, shown: f64, raced: f64, tolerance: f64| {
        assert!(
            (shown - raced).abs() <= tolerance,
            "{what}: {shown} is shown, {raced} was raced"
        );
    };
    for index in 0..2 {
        let car = format!("car-{}", index + 1);
        browser
            .wait(
                "the car is in the standings",
                "document.querySelectorAll('#standings tbody tr').length === 2",
            )
            .await;
        browser
            .evaluate(&format!(
                "[...document.querySelectorAll('#standings tbody tr')].find((row) => row.innerText.includes('{car}')).click()"
            ))
            .await;
        let its_laps = format!(
            "document.querySelector('#laps th')?.innerText === '{car}' && document.querySelectorAll('#laps tr').length > 4"
        );
        browser.wait("its laps", &its_laps).await;
        let mut laps = browser
            .evaluate(&rows("laps"))
            .await
            .as_array()
            .cloned()
            .expect("rows");
        laps.reverse();
        let text = |lap: &Value, cell: usize| lap[cell][0].as_str().unwrap_or_default().to_owned();
        let mut best = f64::INFINITY;
        for ((set, ..), heat) in session.heats.iter().zip(&heats) {
            let raced = &heat[index];
            let shown: Vec<_> = laps.iter().filter(|lap| text(lap, 6) == *set).collect();
            // The race ends when the last car is over the line, before that car's own pose is.
            assert!(shown.len() + 1 >= raced.laps.len(), "{car} on {set}: {shown:#?}");
            let mut alignments = Vec::new();
            for (shown, raced) in shown.iter().zip(&raced.laps) {
                let who = format!("{car} on {set}, lap {}", text(shown, 0));
                let time = numbers_in(&text(shown, 1))[0];
                near(&format!("{who}, time"), time, raced.time_s, TIME_S);
                best = best.min(raced.time_s);
                let sectors: f64 = (3..6).map(|cell| numbers_in(&text(shown, cell))[0]).sum();
                near(&format!("{who}, sectors"), sectors, raced.time_s, TIME_S + 0.015);
                // "worst slip 3 %, mean alignment 97 %, mean distance from the raceline 5.1 cm"
                let about = numbers_in(shown[7][1].as_str().unwrap_or_default());
                near(
                    &format!("{who}, off the line"),
                    about[2] * 1e-2,
                    raced.line_error_m,
                    1.5e-3,
                );
                alignments.push(about[1] * 1e-2);
            }
            let alignment = alignments.iter().sum::<f64>() / alignments.len() as f64;
            near(
                &format!("{car} on {set}, alignment"),
                alignment,
                raced.alignment.expect("known"),
                0.01,
            );
        }
        let standings = browser
            .evaluate(&rows("standings"))
            .await
            .as_array()
            .cloned()
            .expect("rows");
        let row = standings.iter().find(|row| text(row, 1) == car).expect("its row");
        near(
            &format!("{car}, best lap"),
            numbers_in(&text(row, 2))[0],
            best,
            TIME_S,
        );

        // The analysis lists the same laps.
        let listed = format!(
            "pitwall.analysis.view.laps.filter((lap) => lap.car === '{car}' && lap.time_s !== null).map((lap) => lap.time_s)"
        );
        browser.key("d").await;
        browser
            .wait("the analysis", "pitwall.analysis?.view?.laps.length > 6")
            .await;
        let listed: Vec<_> = browser
            .evaluate(&listed)
            .await
            .as_array()
            .expect("times")
            .iter()
            .map(number)
            .collect();
        let in_table: Vec<_> = laps.iter().map(|lap| numbers_in(&text(lap, 1))[0]).collect();
        assert_eq!(listed.len(), in_table.len(), "{listed:?}, {in_table:?}");
        for (listed, in_table) in listed.iter().zip(&in_table) {
            near(&format!("{car}, lap in the analysis"), *listed, *in_table, 2e-3);
        }
        browser.key("l").await;
    }
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

/// A car's laps are laid over each other by the track coordinate; sectors are drawn and kept; health is shown over the
/// track.
#[tokio::test(flavor = "multi_thread")]
async fn laps_and_health_are_compared_over_the_track() {
    let bench = TestBench::start().await;
    let behind = Behaviour {
        updates_behind: 20,
        ..Behaviour::default()
    };
    let cars = [
        FakeCar::start("car-1", &bench.endpoint, Behaviour::default()).await,
        FakeCar::start("car-2", &bench.endpoint, behind).await,
    ];
    let ana = bench.browser().await;
    ana.key("d").await;
    ana.wait(
        "each car has two laps that count",
        "['car-1', 'car-2'].every((car) => [...document.querySelectorAll('.an-laps tr.flying')].filter((row) => row.innerText.includes(car)).length >= 2)",
    )
    .await;
    ana.wait(
        "the best lap of each car is chosen and loaded",
        "pitwall.analysis.chosen.length === 2 && pitwall.analysis.chosen.every((id) => pitwall.analysis.numbers(id))",
    )
    .await;
    // Fake cars drive a ring at one speed: 3 m times pi a second, 0 m off the line.
    let at = "((a) => { const track = a.trackOf(); const id = a.chosen[0]; return [a.valueAt(id, 'speed', track, 9), a.valueAt(id, 'lateral', track, 9), \
              a.valueAt(id, 'alignment', track, 9), a.timeAt(a.numbers(id), track, track.length / 2)]; })(pitwall.analysis)";
    let values = ana.evaluate(at).await;
    // Half a lap takes a second, or somewhat more or less where the machine is busy.
    for (i, expected, tolerance) in [(0, 9.425, 0.01), (1, 0.0, 0.01), (2, 0.9, 0.001), (3, 1.0, 0.4)] {
        let value = number(&values[i]);
        assert!((value - expected).abs() < tolerance, "value {i}: {value}");
    }
    // The cursor is moved by keys, and a second one shows differences.
    ana.click("[data-mode=laps]").await;
    ana.evaluate("document.querySelector('.an-plots').focus()").await;
    let press = |key: &str, shift: bool| {
        format!(
            "document.querySelector('.an-plots').dispatchEvent(new KeyboardEvent('keydown', {{key: '{key}', shiftKey: {shift}, bubbles: true}}))"
        )
    };
    for _ in 0..8 {
        ana.evaluate(&press("ArrowRight", false)).await;
    }
    ana.evaluate(&press("ArrowRight", true)).await;
    ana.wait(
        "values and differences at two cursors",
        "document.querySelector('.an-readout')?.innerText.match(/→/)",
    )
    .await;
    for (width, height) in [(1366, 768), (1920, 1080), (390, 844)] {
        ana.resize(width, height).await;
        let overflow = "document.documentElement.scrollWidth <= innerWidth";
        ana.wait("nothing is wider than the page", overflow).await;
        ana.screenshot(&format!("analysis-{width}")).await;
    }
    ana.resize(1366, 768).await;

    // Sectors are drawn by clicks on the track, and kept for all pages and runs.
    ana.wait(
        "the map is drawn",
        "document.querySelector('.an-map').width > 100",
    )
    .await;
    let edit = "[...document.querySelectorAll('.an-right .an-bar button')].find((b) => b.textContent.includes('sectors')).click()";
    ana.evaluate(edit).await;
    let point = "((a) => { const track = a.trackOf(); const [x, y] = a.mapView(track).to(a.pointAt(track, 9.42)); \
                 a.map.scrollIntoView({ block: 'center' }); const box = a.map.getBoundingClientRect(); return [box.left + x, box.top + y]; })(pitwall.analysis)";
    let point = ana.evaluate(point).await;
    let point = [number(&point[0]), number(&point[1])];
    ana.drag(point, point).await;
    ana.wait("a border more", "pitwall.analysis.borders?.length === 3")
        .await;
    ana.evaluate(edit).await;
    let four = "pitwall.analysis?.view?.tracks[0]?.sectors.length === 3 && pitwall.analysis.borders === null";
    ana.wait("four sectors are kept", four).await;
    let ben = bench.browser().await;
    ben.key("d").await;
    ben.wait("another page has them", four).await;
    let kept = std::fs::read_dir(bench.recordings.path().join("tracks")).expect("a folder of tracks");
    assert_eq!(kept.count(), 1);
    // The sectors of a lap add up to its time, and none is faster than the ideal lap's.
    let sums = "pitwall.analysis.view.laps.filter((lap) => lap.kind === 'flying' && lap.time_s).map((lap) => [lap.time_s, lap.sectors.reduce((a, b) => a + b, 0), \
                pitwall.analysis.view.tracks[0].ideal.reduce((a, b) => a + b, 0)])";
    let sums = ben.evaluate(sums).await;
    let sums = sums.as_array().expect("laps");
    assert!(sums.len() >= 4);
    for lap in sums {
        let [time, sum, ideal] = [0, 1, 2].map(|i| number(&lap[i]));
        // Fake cars report 2 s for every lap, whatever the machine's timer did.
        assert!((time - sum).abs() < 0.5 && ideal <= sum + 1e-6, "{lap}");
    }

    // Health over the track.
    ana.click("[data-mode=health]").await;
    ana.wait("the heat-map has rows", "pitwall.analysis.heatRows?.length >= 4")
        .await;
    let canvas = ana
        .evaluate("((box) => [box.left + box.width / 2, box.top + 30])(document.querySelector('.an-heat canvas:not(.an-legend)').getBoundingClientRect())")
        .await;
    let canvas = [number(&canvas[0]), number(&canvas[1])];
    ana.drag(canvas, canvas).await;
    ana.wait(
        "lap, place, value and state in words",
        "document.querySelector('.an-heat p').textContent.match(/car-\\d lap \\d+ at \\d+\\.\\d m: alignment 90\\.0 %, LOCALIZED/)",
    )
    .await;
    ana.screenshot("analysis-health").await;
    let none = "document.querySelector('.an-findings').innerText.includes('nowhere')";
    ana.wait("nothing is wrong with the map", none).await;
    for browser in [ana, ben] {
        browser.expect_clean(bench.server.url()).await;
        browser.close().await;
    }
    drop(cars);
    bench.server.stop().await;
}

/// What a race engineer needs over two hours: alarms that stay, questions before what cannot be undone, the worst state in
/// the title.
#[tokio::test(flavor = "multi_thread")]
async fn alarms_outlive_a_reload_and_a_gone_car_can_be_dismissed() {
    let bench = TestBench::start().await;
    let stays = FakeCar::start("car-1", &bench.endpoint, Behaviour::default()).await;
    let goes = FakeCar::start("car-2", &bench.endpoint, Behaviour::default()).await;
    let page = bench.browser().await;
    page.wait("both cars in the title", "document.title.includes('2 localized')")
        .await;
    let small = "[...document.querySelectorAll('.card.selected .facts span')].every((label) => parseFloat(getComputedStyle(label).fontSize) >= 12) && \
                 [...document.querySelectorAll('.card.selected .facts b')].every((value) => parseFloat(getComputedStyle(value).fontSize) >= 18)";
    assert_eq!(
        page.evaluate(small).await,
        true,
        "labels of 12 px, values of 18 px"
    );

    // Keys that change something ask first, and offer a trial.
    page.key("L").await;
    answer_question(&page, "Put set lq in force on car-1?").await;
    let in_force = |set: &str| {
        format!(
            "{}.querySelector('button[data-set={set}]')?.getAttribute('aria-pressed') === 'true'",
            card("car-1")
        )
    };
    page.wait("lq is in force", &in_force("lq")).await;
    let trial = format!(
        "[...{}.querySelectorAll('.note button')].find((b) => b.textContent === 'try hq 60 s')",
        card("car-1")
    );
    page.wait("a trial is offered", &trial).await;
    page.evaluate(&format!("{trial}.click()")).await;
    page.wait("hq is in force", &in_force("hq")).await;

    // The last command is undone by one key: first the rates, then the set.
    page.key("y").await;
    page.wait("the rates of the car", "document.getElementById('rates').open")
        .await;
    page.fill("#rate-cloud", "2").await;
    wait_until("the rates are on the car", || stays.rates().cloud < 3.0).await;
    let pose = stays.rates().pose;
    assert!((pose - 1000.0).abs() < 1e-3, "the others are as they were");
    page.wait(
        "the answer is there",
        &format!("{}.querySelector('.note p.done')", card("car-1")),
    )
    .await;
    page.key("z").await;
    answer_question(&page, "Undo the telemetry rates on car-1?").await;
    wait_until("the rates are as before", || stays.rates().cloud > 9.0).await;
    page.key("z").await;
    answer_question(&page, "Undo set hq on car-1?").await;

    // Tabs by arrow keys.
    page.evaluate("document.getElementById('tab-log').focus()").await;
    page.evaluate("document.activeElement.dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowRight', bubbles: true}))")
        .await;
    page.wait(
        "the next tab",
        "document.activeElement.id === 'tab-laps' && !document.getElementById('laps-panel').hidden",
    )
    .await;

    drop(goes);
    page.wait(
        "the title shows the worst state",
        "document.title.includes('BLIND car-2')",
    )
    .await;
    let alarm = "!document.getElementById('alarm').hidden && document.querySelector('#log li.open')";
    page.wait("an alarm", alarm).await;
    page.evaluate("location.reload()").await;
    page.wait("the alarm is there again", alarm).await;
    page.screenshot("page-alarm-after-reload").await;
    page.click("#alarm").await;
    page.wait("no alarm is open", "document.getElementById('alarm').hidden")
        .await;
    let dismiss = format!(
        "[...{}.querySelectorAll('header button')].find((b) => b.textContent === '✕' && !b.hidden)",
        card("car-2")
    );
    page.wait("the gone car can be hidden", &dismiss).await;
    page.evaluate(&format!("{dismiss}.click()")).await;
    page.wait("it is hidden", &format!("!{}", card("car-2"))).await;
    let back = FakeCar::start("car-2", &bench.endpoint, Behaviour::default()).await;
    page.wait("it is back", &card("car-2")).await;
    page.expect_clean(bench.server.url()).await;
    page.close().await;
    drop((stays, back));
    bench.server.stop().await;
}
