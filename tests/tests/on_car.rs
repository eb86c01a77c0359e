//! A car that records on its own disk, a link that is cut, and a car that is rebooted meanwhile: fetched and merged, nothing is
//! missing.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Child, Command, Stdio};

use pitwall::{EventPayload, FetchOptions, FleetService, RunEnd, read_events};
use protocol::{Action, CarName, Outcome, RecordAction, Reply, Topic};
use system_tests::{Link, named, recording, send_command, start_real, wait_until};

/// A real node in a process of its own.
struct CarProcess(Child);

impl CarProcess {
    fn start(name: &CarName, endpoint: &str, folder: &Path) -> Self {
        let child = Command::new(env!("CARGO_BIN_EXE_test-car"))
            .args(["race", name.as_str(), "0", endpoint])
            .args([folder.join("state"), folder.join("recordings")])
            .stdin(Stdio::null())
            .spawn();
        Self(child.expect("a car"))
    }

    /// A power cut.
    fn kill(mut self) {
        self.0.kill().expect("killed");
        self.0.wait().expect("ended");
    }
}

impl Drop for CarProcess {
    fn drop(&mut self) {
        // It may have been killed already.
        self.0.kill().ok();
        self.0.wait().ok();
    }
}

/// The sequence numbers of the streams that must be complete, by topic and run.
fn numbers(file: &Path) -> BTreeMap<(Topic, u64), Vec<u64>> {
    let mut numbers = BTreeMap::<_, Vec<u64>>::new();
    for event in read_events(file).expect("opens") {
        if let EventPayload::Message { topic, header, .. } = event.expect("intact").payload
            && topic.recovered()
        {
            numbers
                .entry((topic, header.run_id))
                .or_default()
                .push(header.sequence);
        }
    }
    numbers
}

fn received(service: &FleetService, car: &CarName, topic: Topic) -> u64 {
    let streams = service.recording().expect("a recording").summary.streams;
    let stream = streams
        .iter()
        .find(|stream| stream.car == *car && stream.topic == topic);
    stream.map_or(0, |stream| stream.gaps.received)
}

/// The size of the last recording on the car \[bytes\].
fn last_file(folder: &Path) -> (usize, u64) {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut files: Vec<_> = entries
        .map(|entry| entry.path())
        .filter(|path| path.extension().is_some_and(|end| end == "mcap"))
        .collect();
    files.sort();
    let bytes = files.last().and_then(|file| std::fs::metadata(file).ok());
    (files.len(), bytes.map_or(0, |metadata| metadata.len()))
}

// Once the laptop's file alone said of a car that was stopped that the end of its run is not known.
#[tokio::test(flavor = "multi_thread")]
async fn a_car_that_stops_says_how_far_its_streams_go() {
    let (endpoint, service, _folder, laptop) = recording().await;
    let car = named("car-1");
    for run in 1..=2 {
        let before = received(&service, &car, Topic::RecordedScan);
        let node = start_real(&car, 0.0, &endpoint, None);
        wait_until("a second of scans is at the laptop", || {
            received(&service, &car, Topic::RecordedScan) > before + 40
        })
        .await;
        if run == 1 {
            let stop = tokio::task::spawn_blocking(move || node.shutdown("the test stops it"));
            stop.await.expect("stopped");
        } else {
            // The recording ends while it still drives.
            service
                .stop_recording()
                .await
                .expect("a recording")
                .expect("good");
            tokio::task::spawn_blocking(move || node.shutdown("the test is over"))
                .await
                .expect("stopped");
        }
    }
    service.close().await;
    let check = pitwall::check(&laptop).expect("a recording");
    let ends: Vec<_> = check.cars[0].runs.iter().map(|run| run.end).collect();
    assert_eq!(ends, [Some(RunEnd::Stopped), Some(RunEnd::Answered)], "{check}");
    assert!(check.complete, "{check}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_cut_link_and_a_reboot_leave_no_hole_after_fetch_and_merge() {
    let (endpoint, service, folder, laptop) = recording().await;
    let link = Link::to(&endpoint).await;
    let car = named("car-1");
    let on_car = folder.path().join("car");
    let disk = on_car.join("recordings");
    let process = CarProcess::start(&car, link.endpoint(), &on_car);
    wait_until("a second of scans is at the laptop", || {
        received(&service, &car, Topic::RecordedScan) > 40
    })
    .await;

    link.cut();
    let (_, before) = last_file(&disk);
    wait_until("the car records on", || last_file(&disk).1 > before + 300_000).await;
    // The power of the car is cut, with all that was in its memory.
    process.kill();
    let process = CarProcess::start(&car, link.endpoint(), &on_car);
    wait_until("the car records again, in the next file", || {
        let (files, bytes) = last_file(&disk);
        files == 2 && bytes > 100_000
    })
    .await;
    link.restore();
    let scans = received(&service, &car, Topic::RecordedScan);
    wait_until("it is back at the laptop", || {
        received(&service, &car, Topic::RecordedScan) > scans + 40
    })
    .await;
    let Some(Ok(_)) = service.stop_recording().await else {
        panic!("a recording");
    };

    // Recording on the car ends by a command, so that its last file is complete.
    let verdict = send_command(&service, &car, "ana", None, Action::Record(RecordAction::Stop)).await;
    let pitwall::Verdict::Answered { answer, .. } = verdict else {
        panic!("{verdict:?}");
    };
    let Outcome::Done {
        reply: Reply::Recorder(state),
        ..
    } = answer.outcome
    else {
        panic!("{answer:?}");
    };
    assert!(!state.recording && state.dropped == 0, "{state:?}");

    let options = FetchOptions {
        rate: 1e9,
        ..FetchOptions::new(folder.path().join("fetched"))
    };
    let files = service.client().files_of(&car);
    let fetched = pitwall::fetch(&car, &files, &options, |_| {})
        .await
        .expect("fetched");
    assert_eq!(fetched.len(), 2, "{fetched:?}");
    for file in &fetched {
        assert!(file.finished && file.received == file.bytes);
        let name = file.file.file_name().expect("a name");
        let original = std::fs::read(disk.join(name)).expect("the same name");
        assert!(std::fs::read(&file.file).expect("a copy") == original);
    }
    service.close().await;
    drop(process);

    let merged = folder.path().join("merged.mcap");
    let inputs = [laptop.clone(), options.folder.clone()];
    let report = pitwall::merge(&inputs, &merged).expect("merged");
    let (before, after) = (numbers(&laptop), numbers(&merged));
    let runs: Vec<_> = after
        .keys()
        .filter(|(topic, _)| *topic == Topic::RecordedScan)
        .map(|(_, run)| *run)
        .collect();
    assert_eq!(runs.len(), 2, "two runs of the car");
    for ((topic, run), numbers) in &after {
        let last = numbers.iter().max().copied().unwrap_or_default();
        let mut sorted = numbers.clone();
        sorted.sort_unstable();
        assert_eq!(
            sorted,
            (1..=last).collect::<Vec<_>>(),
            "{topic} of run {run}: nothing is missing, nothing is there twice"
        );
    }
    // What was only on the car.
    let first_run = (Topic::RecordedScan, runs[0]);
    let filled = after[&first_run].len() - before[&first_run].len();
    assert!(filled > 10, "{filled} scans were only on the car");
    assert_eq!(report.summary.missing(), 0, "{}", report.summary);
    // Before, nobody knows how far the run goes that was cut off. Afterwards it has lost what was not on its disk, and no more.
    let before = pitwall::check(&laptop).expect("a recording");
    assert!(!before.all_there_is, "{before}");
    let check = pitwall::check(&merged).expect("a recording");
    assert!(check.all_there_is && !check.complete, "{check}");
    assert_eq!(check.cars[0].runs[0].end, Some(RunEnd::CutOff), "{check}");
    for topic in [
        Topic::RecordedPose,
        Topic::RecordedOdometry,
        Topic::RecordedHealth,
    ] {
        assert!(after[&(topic, runs[0])].is_sorted(), "{topic} is in order");
    }
}
