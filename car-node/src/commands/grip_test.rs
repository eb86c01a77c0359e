//! `car-node grip-test`: the pull that slides the simulated car, beside the paper's.

use serde::Serialize;
use simulator::{Grip, GripTest, VehicleParams};

use crate::cli;

/// A row of the table.
#[derive(Serialize)]
struct Row {
    tyres: &'static str,
    #[serde(flatten)]
    test: GripTest,
    paper_n: f64,
    friction: f64,
}

pub(crate) fn run(arguments: cli::GripTest) -> anyhow::Result<()> {
    let tyres = [("HQ, clean", Grip::HQ), ("LQ, taped", Grip::LQ)];
    let rows = tyres.map(|(tyres, grip)| Row {
        tyres,
        test: GripTest::of(&VehicleParams::default().with_grip(grip)),
        paper_n: grip.lateral_pull,
        friction: grip.friction(),
    });
    if arguments.json {
        say!("{}", serde_json::to_string_pretty(&rows)?);
        return Ok(());
    }
    let car = VehicleParams::default();
    say!(
        "a car of {} kg at rest, pulled sideways at its centre of gravity, 0.1 N more every 0.5 s",
        car.mass
    );
    say!(
        "{:<12} {:>11} {:>11} {:>10} {:>14} {:>17}",
        "tyres",
        "holds up to",
        "the paper",
        "friction",
        "deflection",
        "then slides at"
    );
    say!(
        "{:<12} {:>11} {:>11} {:>10} {:>14} {:>17}",
        "",
        "N",
        "N",
        "1",
        "mm",
        "m/s"
    );
    for row in rows {
        say!(
            "{:<12} {:>11.1} {:>11.1} {:>10.3} {:>14.1} {:>17.2}",
            row.tyres,
            row.test.held_n,
            row.paper_n,
            row.friction,
            1000.0 * row.test.deflection_m,
            row.test.sliding_mps
        );
    }
    Ok(())
}
