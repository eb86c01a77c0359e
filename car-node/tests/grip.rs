//! The grip test gives the paper's forces.

use std::process::Command;

#[test]
fn the_grip_test_gives_the_paper_s_forces() {
    let ended = Command::new(env!("CARGO_BIN_EXE_car-node"))
        .args(["grip-test", "--json"])
        .output()
        .expect("it starts");
    let rows: Vec<serde_json::Value> = serde_json::from_slice(&ended.stdout).expect("JSON");
    for (row, paper) in rows.iter().zip([26.0, 19.0]) {
        let held = row["held_n"].as_f64().expect("a number");
        assert!((held - paper).abs() < 0.2, "{row}");
    }
    assert_eq!(rows.len(), 2);
}
