//! `car-node track` and `race` as a user calls them, with valid and with faulty input.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use tempfile::TempDir;

const OVAL: &str = "name: oval\nseed: 7\ncentre: [[0, 0], [4, -2], [8, 0], [8, 3], [4, 5], [0, 3]]\n\
                    half_width: [0.8]\nmargin: 0.3\n";

fn car_node(folder: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_car-node"))
        .current_dir(folder)
        .args(arguments)
        .output()
        .expect("the program starts")
}

/// The message of a call that must fail with this code. It is one line that starts with the program's name.
fn complaint(folder: &Path, arguments: &[&str], code: i32) -> String {
    let output = car_node(folder, arguments);
    let text = String::from_utf8(output.stderr).expect("text");
    assert_eq!(output.status.code(), Some(code), "{arguments:?}: {text}");
    assert!(
        text.starts_with("car-node: ") && text.lines().count() == 1,
        "{text}"
    );
    text
}

#[test]
fn a_description_becomes_a_track_that_is_checked_drawn_and_raced_on() {
    let folder = TempDir::new().expect("a folder");
    let here = folder.path();
    fs::write(here.join("oval.yaml"), OVAL).expect("writes");
    let good = |arguments: &[&str]| {
        let output = car_node(here, arguments);
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{arguments:?}: {text}");
        String::from_utf8(output.stdout).expect("text")
    };
    good(&["track", "new", "mine", "--from", "oval.yaml"]);
    let report: serde_json::Value =
        serde_json::from_str(&good(&["track", "check", "mine", "--json"])).expect("JSON");
    let length = report["length_m"].as_f64().expect("a number");
    assert!((20.0..25.0).contains(&length), "{report}");
    good(&["track", "draw", "mine", "--svg", "mine.svg"]);
    let svg = fs::read_to_string(here.join("mine.svg")).expect("a file");
    assert!(svg.contains("<svg") && svg.trim_end().ends_with("</svg>"));
    let raced = good(&[
        "race",
        "--track",
        "mine",
        "--laps",
        "1",
        "--localizer",
        "truth",
        "--json",
    ]);
    let raced: serde_json::Value = serde_json::from_str(&raced).expect("JSON");
    assert_eq!(raced["summary"]["finished"], 1, "{raced}");
}

#[test]
fn a_faulty_description_is_refused_by_its_key_or_line_and_writes_nothing() {
    let folder = TempDir::new().expect("a folder");
    let here = folder.path();
    for (from, to, names) in [
        ("half_width: [0.8]", "half_width: [-0.8]", "half_width: -0.8"),
        ("margin: 0.3", "marge: 0.3", "unknown field `marge`"),
        ("seed: 7", "seed: seven", "line 2"),
        ("seed: 7", "seed: 7\nseed: 8", "line 3"),
        ("[[0, 0], [4, -2]", "[[0, 0], [0, 0]", "centre: points 1 and 2"),
        ("margin: 0.3", "margin: 0.9", "need 1.80 m"),
        (
            "margin: 0.3",
            "margin: 0.3\nspeed: { lateral: -1 }",
            "speed.lateral: -1",
        ),
        (
            "margin: 0.3",
            "margin: 0.3\nblocks: [{ at: [2, 1], size: [1e9, 1] }]",
            "blocks: block 1",
        ),
        // A line that crosses itself hits its own walls.
        (
            "[[0, 0], [4, -2], [8, 0], [8, 3], [4, 5], [0, 3]]",
            "[[0, 0], [6, 4], [6, 0], [0, 4]]",
            "cannot be raced on: ",
        ),
        // A bend that is too tight for a car, although the road is wide enough.
        (
            "[[0, 0], [4, -2], [8, 0], [8, 3], [4, 5], [0, 3]]",
            "[[0, 0], [0.4, 0], [0, 0.4]]",
            "cannot be raced on: ",
        ),
    ] {
        let text = OVAL.replace(from, to);
        assert_ne!(text, OVAL, "{from} stands in the description");
        fs::write(here.join("t.yaml"), text).expect("writes");
        let said = complaint(here, &["track", "new", "out", "--from", "t.yaml"], 1);
        assert!(said.contains(names), "{said} should name {names}");
        assert!(!here.join("out").exists(), "{to}: something was written");
    }
}

#[test]
fn missing_existing_and_damaged_files_are_named() {
    let folder = TempDir::new().expect("a folder");
    let here = folder.path();
    fs::write(here.join("oval.yaml"), OVAL).expect("writes");
    let fails = |code: i32, arguments: &[&str], names: &str| {
        let said = complaint(here, arguments, code);
        assert!(said.contains(names), "{arguments:?}: {said} should name {names}");
    };
    let named = |arguments: &[&str], names: &str| fails(1, arguments, names);
    named(&["track", "new", "out", "--from", "none.yaml"], "none.yaml: ");
    named(&["track", "new", "out", "--from", "."], ".: ");
    named(
        &["track", "new", "oval.yaml", "--from", "oval.yaml"],
        "oval.yaml: ",
    );
    fs::create_dir_all(here.join("blocked/track.yaml")).expect("a folder");
    named(
        &["track", "new", "blocked", "--from", "oval.yaml"],
        "blocked/track.yaml: ",
    );
    let left = fs::read_dir(here.join("blocked")).expect("a folder").count();
    assert_eq!(left, 1, "nothing half-written");

    for command in [
        &["track", "check", "nowhere"][..],
        &["track", "draw", "nowhere"],
        &["race", "--track", "nowhere"],
        &["track", "check", ""],
    ] {
        fails(2, command, "one of club, hall, park, mirror");
    }
    named(
        &["track", "draw", "club", "--svg", "none/club.svg"],
        "none/club.svg: ",
    );
    fails(2, &["race", "--params", "none"], "none");
    // Every seed gives a track that can be raced on.
    let last = u64::MAX.to_string();
    let race = car_node(
        here,
        &[
            "race",
            "--seed",
            &last,
            "--seeds",
            "2",
            "--laps",
            "1",
            "--localizer",
            "truth",
        ],
    );
    assert!(race.status.success(), "{race:?}");
    let bytes: Vec<u8> = (0..=255).collect();
    fs::write(here.join("noise"), bytes).expect("writes");
    for command in [
        &["race", "--params", "noise"][..],
        &["race", "--raceline", "noise"],
        &["track", "check", "noise"],
        &["track", "new", "out", "--from", "noise"],
    ] {
        named(command, "noise: not a text file");
    }
    fs::write(here.join("noise.yaml"), "sigma_hit: .nan\n").expect("writes");
    named(&["race", "--params", "noise.yaml"], "line 1, column 12");

    assert!(
        car_node(here, &["track", "new", "mine", "--from", "oval.yaml"])
            .status
            .success()
    );
    named(&["track", "new", "mine", "--from", "oval.yaml"], "--force");
    fs::create_dir(here.join("lineless")).expect("a folder");
    for file in ["map.yaml", "map.png"] {
        fs::copy(here.join("mine").join(file), here.join("lineless").join(file)).expect("copies");
    }
    named(&["track", "check", "lineless"], "--raceline FILE");
    named(&["track", "check", "lineless"], "lineless/raceline.csv: ");
    let add = |file: &str, line: &str| {
        let path = here.join("mine").join(file);
        let good = fs::read_to_string(&path).expect("a file");
        fs::write(&path, format!("{good}{line}\n")).expect("writes");
        (path, good)
    };
    for (file, line) in [
        ("walls.csv", "9; plain; nan; 0"),
        ("walls.csv", "9; pink; 0; 0"),
        ("walls.csv", "9; plain; 9999; 0"),
        ("raceline.csv", "1; 2; x"),
    ] {
        let (path, good) = add(file, line);
        named(&["track", "check", "mine"], &format!("{file}, line "));
        fs::write(path, good).expect("writes");
    }
    let (path, good) = add("map.yaml", "");
    fs::write(&path, good.replace("resolution: ", "resolution: -")).expect("writes");
    named(&["track", "check", "mine"], "map.yaml: resolution: ");
}
