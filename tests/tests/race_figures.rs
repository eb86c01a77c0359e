//! The report shows the same figures of a race as `car-node race --json`.

use car_node::race::{CarResult, RaceSummary};
use car_node::stress::DefectChoice;
use pitwall::Report;
use system_tests::RaceSession;

fn near(what: &str, shown: f64, raced: f64, tolerance: f64) {
    assert!(
        (shown - raced).abs() <= tolerance,
        "{what}: {shown} is shown, {raced} was raced"
    );
}

fn mean(values: impl IntoIterator<Item = f64>) -> f64 {
    let (sum, count) = values
        .into_iter()
        .fold((0.0, 0.0), |(sum, count), value| (sum + value, count + 1.0));
    sum / count
}

#[test]
fn the_report_shows_the_figures_of_the_race() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("race.mcap");
    let session = RaceSession::two_heats();
    let (heats, _) = session.record(&file).expect("a recording");
    let report = Report::of(&file).expect("a good file");
    assert_eq!(report.cars.len(), 2);
    for (number, car) in report.cars.iter().enumerate() {
        for (heat, (set, ..)) in session.heats.iter().enumerate() {
            let raced: &CarResult = &heats[heat][number];
            let who = format!("{} on {set}", car.car);
            assert!(raced.finished && raced.crashes == 0);
            let shown: Vec<_> = car.laps.iter().filter(|lap| lap.set == *set).collect();
            // The race ends when the last car is over the line, before that car's own pose is.
            assert!(shown.len() + 1 >= raced.laps.len(), "{who}: {shown:#?}");
            for (shown, raced) in shown.iter().zip(&raced.laps) {
                assert_eq!(shown.void, None, "{who}");
                // The car times its laps by its own pose: the line is passed up to a centimetre early or late.
                near(&format!("{who}, lap time"), shown.time_s, raced.time_s, 5e-3);
                let lateral = shown.lateral_m.expect("known");
                near(&format!("{who}, off the line"), lateral, raced.line_error_m, 1e-3);
            }
            let row = car.table.iter().find(|row| row.set == *set).expect("a row");
            let summary = RaceSummary::of(&[CarResult {
                laps: raced.laps.iter().copied().take(shown.len()).collect(),
                ..raced.clone()
            }]);
            let times = summary.lap_time_s.expect("laps");
            near(
                &format!("{who}, mean lap time"),
                row.time_s.mean,
                times.mean,
                5e-3,
            );
            near(
                &format!("{who}, spread of lap times"),
                row.time_s.sigma,
                times.sigma,
                5e-3,
            );
            let lateral = row.lateral_m.expect("known");
            let line = summary.line_error_m.expect("known");
            near(
                &format!("{who}, mean off the line"),
                lateral.mean,
                line.mean,
                1e-3,
            );
            near(
                &format!("{who}, spread off the line"),
                lateral.sigma,
                line.sigma,
                1e-3,
            );
            near(
                &format!("{who}, alignment"),
                row.alignment.expect("known"),
                summary.alignment.expect("known"),
                5e-3,
            );
        }
        let truth = car.truth.expect("the truth was recorded");
        let errors: Vec<_> = heats
            .iter()
            .map(|heat| heat[number].pose_error.expect("errors"))
            .collect();
        // Both heats have as many scans.
        let square = mean(errors.iter().map(|e| e.position_error_m.rmse.powi(2)));
        near(&format!("{} RMSE", car.car), truth.rmse_m, square.sqrt(), 5e-4);
        let heading = mean(errors.iter().map(|e| e.heading_error_rad.rmse.powi(2)));
        near(
            &format!("{} heading", car.car),
            truth.heading_rad,
            heading.sqrt(),
            2e-4,
        );
        let most = errors.iter().map(|e| e.position_error_m.max).fold(0.0, f64::max);
        near(&format!("{} greatest error", car.car), truth.max_m, most, 5e-4);
        for (state, share) in &car.states {
            let raced = mean(heats.iter().map(|heat| {
                let states = &heat[number].states;
                let found = states.iter().find(|(raced, _)| raced.to_string() == *state);
                found.map_or(0.0, |(_, share)| *share)
            }));
            near(&format!("{} {state}", car.car), *share, raced, 0.01);
        }
    }
}

// The pit wall once got the map without its defects, and found it right.
#[test]
fn a_wall_that_the_map_lacks_is_listed() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("race.mcap");
    let missing: DefectChoice = "wall-missing:mild".parse().expect("a defect");
    let session = RaceSession {
        cars: 1,
        defects: vec![missing.one()],
        ..RaceSession::two_heats()
    };
    session.record(&file).expect("a recording");
    let html = Report::of(&file).expect("a good file").to_html();
    let found = html.split_once("\"findings\":[").expect("the analysis").1;
    let found = found.split_once(']').map_or(found, |(found, _)| found);
    assert!(found.contains("\"disagreement\":\"not_drawn\""), "{found}");
}
