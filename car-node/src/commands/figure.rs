//! `car-node figure`: the paper's figures, and others that explain SynPF, drawn by the code that they are about.

use std::f64::consts::PI;
use std::sync::Arc;

use anyhow::Context;
use maps::Pose;
use simulator::Track;
use synpf::parts::{
    RangeCaster, RangeSource, beam_density, free_lasers, moved_particles, ranges_to_faces, weighed_beams,
};
use synpf::{BeamLayout, BeamParameters, MotionModel, MotionParameters, Parameters, TrackMap};

use super::plot::{Axis, COLOURS, Figure};
use crate::cli;

pub(crate) fn run(arguments: &cli::Figure) -> anyhow::Result<()> {
    let svg = match arguments.what {
        cli::FigureKind::MotionModels => motion_models(),
        cli::FigureKind::BeamLayouts => beam_layouts(),
        cli::FigureKind::SensorModel => sensor_model()?,
        cli::FigureKind::RangeMethods => range_methods()?,
    };
    std::fs::write(&arguments.out, svg).with_context(|| arguments.out.display().to_string())?;
    eprintln!("car-node: the figure is {}", arguments.out.display());
    Ok(())
}

/// Standard deviation of the values.
fn sigma(values: impl Iterator<Item = f64> + Clone) -> f64 {
    let count = values.clone().count().max(1) as f64;
    let mean = values.clone().sum::<f64>() / count;
    (values.map(|value| (value - mean).powi(2)).sum::<f64>() / count).sqrt()
}

/// The paper's figure 1: where particles are after a motion, by the differential-drive model and by that for race cars.
fn motion_models() -> String {
    const PARTICLES: usize = 1000;
    const SECONDS: f64 = 0.4;
    let set = MotionParameters::default();
    let mut figure = Figure::new(
        [980.0, 700.0],
        "Particles after 0.4 s of driving straight on, at low and at high speed",
    );
    let models = [
        (MotionModel::Amcl, "differential drive (amcl)", COLOURS[1]),
        (MotionModel::Tum, "race car (tum)", COLOURS[0]),
    ];
    for (column, speed) in [1.0, 7.0].into_iter().enumerate() {
        for (row, (model, name, colour)) in models.into_iter().enumerate() {
            let parameters = MotionParameters {
                motion_model: model,
                ..set.clone()
            };
            let steps = (SECONDS / set.noise_interval).round() as usize;
            let step = (
                Pose::new(speed * set.noise_interval, 0.0, 0.0),
                set.noise_interval,
            );
            let cloud = moved_particles(&parameters, &vec![step; steps], PARTICLES, 1);
            // Both models at one speed have one scale, the same along and across.
            let reach = if column == 0 { 0.7 } else { 5.6 };
            let [width, height] = [490.0 - 78.0, 330.0 - 82.0];
            let half = reach * height / width / 2.0;
            let mut panel = figure.panel(
                [490.0 * column as f64, 40.0 + 330.0 * row as f64, 490.0, 330.0],
                &format!("{name}, {speed:.0} m/s"),
                Axis::new("forward, m", [-0.12 * reach, 0.88 * reach]),
                Axis::new("to the left, m", [-half, half]),
            );
            let car = |x: f64, y: f64| [x * 0.06 * reach, y * 0.03 * reach];
            panel.fill(&[car(-1.0, -1.0), car(-1.0, 1.0), car(1.0, 0.0)], "#444");
            panel.line(
                &[[0.0, 0.0], [speed * SECONDS, 0.0]],
                "#444",
                1.2,
                "stroke-dasharray=\"5 4\"",
            );
            // Every tenth particle shows its heading.
            for pose in cloud.iter().step_by(10) {
                let ahead = *pose * Pose::new(0.045 * reach, 0.0, 0.0);
                panel.line(
                    &[[pose.x, pose.y], [ahead.x, ahead.y]],
                    colour,
                    0.8,
                    "stroke-opacity=\"0.6\"",
                );
            }
            let dots: Vec<[f64; 2]> = cloud.iter().map(|pose| [pose.x, pose.y]).collect();
            panel.dots(&dots, colour, 2.0, 0.35);
            let across = 100.0 * sigma(cloud.iter().map(|pose| pose.y));
            let along = 100.0 * sigma(cloud.iter().map(|pose| pose.x));
            let turned = sigma(cloud.iter().map(|pose| pose.heading)).to_degrees();
            panel.legend(&format!("along {along:.1} cm, across {across:.1} cm"), colour);
            panel.legend(&format!("heading {turned:.1} deg (all 1 sigma)"), colour);
            panel.end([0.0, 0.0]);
        }
    }
    figure.svg()
}

/// Beams of both layouts in a corridor.
fn beam_layouts() -> String {
    const HALF_WIDTH: f64 = 1.1;
    const REACH: f64 = 14.0;
    const BEAMS: usize = 1081;
    let (angle_min, increment) = (-0.75 * PI, 1.5 * PI / (BEAMS - 1) as f64);
    let mut figure = Figure::new(
        [980.0, 610.0],
        "Where the weighed beams end: a car in a corridor of 2.2 m, 61 beams of 1081",
    );
    let layouts = [
        (BeamLayout::Uniform, "uniform: at equal angles", COLOURS[1]),
        (
            BeamLayout::Boxed,
            "boxed: at equal distances along a box of 3.5 : 1",
            COLOURS[0],
        ),
    ];
    for (row, (layout, title, colour)) in layouts.into_iter().enumerate() {
        let parameters = BeamParameters {
            beam_layout: layout,
            beams: 61,
            ..BeamParameters::default()
        };
        let chosen = weighed_beams(BEAMS, angle_min, increment, &parameters);
        let mut panel = figure.panel(
            [0.0, 40.0 + 280.0 * row as f64, 980.0, 280.0],
            title,
            Axis::new("along the corridor, m", [-REACH, REACH]),
            Axis::new("across, m", [-1.6, 1.6]),
        );
        let ends: Vec<[f64; 2]> = chosen
            .iter()
            .map(|i| {
                let (sin, cos) = (angle_min + increment * f64::from(*i)).sin_cos();
                let range = (HALF_WIDTH / sin.abs().max(1e-9)).min(40.0);
                [range * cos, range * sin]
            })
            .collect();
        for end in &ends {
            panel.line(&[[0.0, 0.0], *end], colour, 0.8, "stroke-opacity=\"0.5\"");
        }
        for side in [-HALF_WIDTH, HALF_WIDTH] {
            panel.line(&[[-REACH, side], [REACH, side]], "#333", 3.0, "");
        }
        panel.dots(&ends, colour, 6.0, 0.9);
        panel.fill(
            &[[-0.25, -0.14], [0.25, -0.14], [0.25, 0.14], [-0.25, 0.14]],
            "#222",
        );
        let beyond = |metres: f64| ends.iter().filter(|end| end[0].abs() > metres).count();
        panel.legend(
            &format!(
                "{} of {} beams end beyond 2 m, {} beyond 5 m",
                beyond(2.0),
                ends.len(),
                beyond(5.0)
            ),
            colour,
        );
        panel.end([0.0, 0.5]);
    }
    figure.svg()
}

/// The density of the beam model.
fn sensor_model() -> anyhow::Result<String> {
    const PREDICTED: f64 = 6.0;
    let mut figure = Figure::new([980.0, 430.0], "The beam model: density of a measured range");
    let set = Parameters::named("hq").context("set hq")?.sensor;
    let model = beam_density(&set, PREDICTED);
    // The last step holds everything without a return.
    let (none, before) = model.split_last().context("the model has no steps")?;
    let no_return = none[1] * 0.02;
    let floor = 1e-3;
    let mut panel = figure.panel(
        [0.0, 40.0, 640.0, 390.0],
        &format!("set hq, the map predicts {PREDICTED} m"),
        Axis::new("measured range, m", [0.0, set.max_range + 0.6]),
        Axis::log("density, 1/m", [floor, 10.0]),
    );
    panel.line(before, COLOURS[0], 2.0, "");
    panel.line(
        &[[set.max_range, floor], [set.max_range, none[1].min(9.0)]],
        COLOURS[1],
        4.0,
        "",
    );
    let share = |value: f64| format!("{:.1} %", 100.0 * value);
    panel.label(
        [PREDICTED, 4.0],
        &format!("hit, z_hit {}", share(set.z_hit)),
        "#222",
    );
    panel.label(
        [0.3, 0.045],
        &format!("short, z_short {}", share(set.z_short)),
        "#222",
    );
    panel.label(
        [9.5, 0.0022],
        &format!("random, z_rand {}", share(set.z_rand)),
        "#222",
    );
    panel.label(
        [12.2, 2.2],
        &format!("no return, z_max {}", share(set.z_max)),
        COLOURS[1],
    );
    panel.legend("density of the ranges", COLOURS[0]);
    panel.legend(
        &format!("no return: {} of the beams", share(no_return)),
        COLOURS[1],
    );
    panel.end([0.75, 0.42]);
    let mut panel = figure.panel(
        [640.0, 40.0, 340.0, 390.0],
        "around the wall",
        Axis::new("measured less predicted, m", [-0.6, 0.6]),
        Axis::new("share of the greatest", [0.0, 1.35]),
    );
    let greatest = before.iter().map(|point| point[1]).fold(0.0, f64::max);
    let curve = |power: f64| -> Vec<[f64; 2]> {
        let near = before.iter().filter(|point| (point[0] - PREDICTED).abs() < 0.7);
        near.map(|[range, density]| [range - PREDICTED, (density / greatest).powf(power)])
            .collect()
    };
    panel.line(&curve(1.0), COLOURS[0], 2.0, "");
    panel.line(&curve(1.0 / set.squash_factor), COLOURS[2], 2.0, "");
    panel.legend(&format!("density, sigma_hit {} m", set.sigma_hit), COLOURS[0]);
    panel.legend(&format!("as weighed: power 1/{}", set.squash_factor), COLOURS[2]);
    panel.end([0.0, 0.0]);
    Ok(figure.svg())
}

/// The distribution of each method's range error on a bundled track.
fn range_methods() -> anyhow::Result<String> {
    const RAYS: usize = 2500;
    const LONGEST: f64 = 20.0;
    let track = Track::bundled("club").context("the track club")?;
    let map = Arc::new(TrackMap::new(track.grid)?);
    let rays = free_lasers(&map, RAYS, 1);
    let truth = ranges_to_faces(&map, &rays);
    let (rays, truth): (Vec<Pose>, Vec<f64>) = rays
        .into_iter()
        .zip(truth)
        .filter_map(|(ray, range)| Some((ray, range?)))
        .filter(|(_, range)| *range < LONGEST)
        .unzip();
    let mut figure = Figure::new([980.0, 470.0], "Error of predicted ranges on club, cells of 5 cm");
    let mut panel = figure.panel(
        [0.0, 40.0, 980.0, 430.0],
        &format!(
            "{} rays from anywhere on the track, against the first wall face on the way",
            rays.len()
        ),
        Axis::log("error of the range, cm", [0.01, 300.0]),
        Axis::new("share of the rays with a smaller error, %", [0.0, 100.0]),
    );
    let methods = RangeSource::ALL
        .into_iter()
        .filter(|source| *source != RangeSource::Gpu);
    for (source, colour) in methods.zip(COLOURS) {
        let caster = RangeCaster::new(&map, source)?;
        let ranges = caster.ranges(&rays, LONGEST)?;
        let mut errors: Vec<f64> = ranges
            .iter()
            .zip(&truth)
            .map(|(range, truth)| 100.0 * (range - truth).abs())
            .collect();
        errors.sort_by(f64::total_cmp);
        let at = |share: f64| errors[((errors.len() - 1) as f64 * share) as usize];
        let points: Vec<[f64; 2]> = (0..=400)
            .map(|k| [at(f64::from(k) / 400.0).max(0.01), f64::from(k) / 4.0])
            .collect();
        panel.line(&points, colour, 2.2, "");
        panel.legend(
            &format!(
                "{}: median {:.2} cm, 99 % within {:.0} cm",
                source.name(),
                at(0.5),
                at(0.99)
            ),
            colour,
        );
    }
    panel.end([0.99, 0.97]);
    Ok(figure.svg())
}
