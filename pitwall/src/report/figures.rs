//! The figures of one car.

use protocol::Cell;

use super::svg::{Plot, WIDTH, escape};
use super::{CarReport, HealthPoint, error_of};

/// A figure with its caption.
pub(super) struct Figure {
    pub(super) title: &'static str,
    pub(super) svg: String,
}

/// The figures for which the recording has data.
pub(super) fn of(car: &CarReport, duration_s: f64) -> Vec<Figure> {
    let figure = |title, svg: Option<String>| svg.map(|svg| Figure { title, svg });
    [
        figure(
            "The track and where the car was, coloured by alignment",
            track(car),
        ),
        figure("Lap times; the fastest is green", laps(car)),
        figure(
            "Alignment over the lap: mean and lowest of all laps",
            along(
                car,
                "alignment",
                [0.0, 1.0],
                &[0.7, 0.45],
                |v| v.alignment,
                f64::min,
            ),
        ),
        figure(
            "Slip over the lap, without its sign: mean and highest of all laps",
            along(car, "slip", [0.0, 0.5], &[0.08, 0.2], |v| v.slip.abs(), f64::max),
        ),
        figure(
            "Distance from the raceline over the lap: mean and greatest",
            lateral(car),
        ),
        figure("State over time", states(car, duration_s)),
        figure("Error against the truth over time", error(car)),
        figure("CPU of the node over time", load(car, duration_s)),
    ]
    .into_iter()
    .flatten()
    .collect()
}

/// Number of places of a lap.
const PLACES: usize = 100;

fn place_of(s: f64, length: f64) -> usize {
    ((s / length * PLACES as f64) as usize).min(PLACES - 1)
}

/// Mean and worst of a value at each place of the lap.
fn along(
    car: &CarReport,
    name: &str,
    range: [f64; 2],
    limits: &[f64],
    value: impl Fn(&HealthPoint) -> f64,
    worst: impl Fn(f64, f64) -> f64,
) -> Option<String> {
    let length = car.series.length?;
    let values = car.series.healths.iter().filter_map(|v| Some((v.s?, value(v))));
    over_lap(length, values, &worst, |mean, extreme| {
        let mut plot = Plot::new([0.0, length], range, ["along the raceline [m]", name]);
        for limit in limits {
            plot.limit(*limit);
        }
        plot.line("faint", extreme);
        plot.line("main", mean);
        plot.finish()
    })
}

fn lateral(car: &CarReport) -> Option<String> {
    let length = car.series.length?;
    let values = car.series.poses.iter().filter_map(|spot| spot.track);
    let most = values.clone().map(|[_, d]| d.abs()).fold(0.05, f64::max);
    over_lap(
        length,
        values.map(|[s, d]| (s, d.abs())),
        &f64::max,
        |mean, extreme| {
            let mut plot = Plot::new(
                [0.0, length],
                [0.0, most],
                ["along the raceline [m]", "distance [m]"],
            );
            plot.line("faint", extreme);
            plot.line("main", mean);
            plot.finish()
        },
    )
}

fn over_lap(
    length: f64,
    values: impl Iterator<Item = (f64, f64)>,
    worst: &dyn Fn(f64, f64) -> f64,
    draw: impl FnOnce(Vec<[f64; 2]>, Vec<[f64; 2]>) -> String,
) -> Option<String> {
    let mut cells = vec![(0.0, 0_u32, f64::NAN); PLACES];
    for (s, value) in values {
        let (sum, count, extreme) = &mut cells[place_of(s, length)];
        *sum += value;
        *count += 1;
        // Any number replaces NaN.
        *extreme = worst(*extreme, value);
    }
    let at = |i: usize| (i as f64 + 0.5) / PLACES as f64 * length;
    let mean = |(i, (sum, count, _)): (usize, &(f64, u32, f64))| [at(i), sum / f64::from(*count)];
    let extreme = |(i, (_, _, extreme)): (usize, &(f64, u32, f64))| [at(i), *extreme];
    cells.iter().any(|(_, count, _)| *count > 0).then(|| {
        draw(
            cells.iter().enumerate().map(mean).collect(),
            cells.iter().enumerate().map(extreme).collect(),
        )
    })
}

fn laps(car: &CarReport) -> Option<String> {
    let best = car.laps.iter().map(|lap| lap.time_s).min_by(f64::total_cmp)?;
    let worst = car.laps.iter().map(|lap| lap.time_s).fold(best, f64::max);
    let last = car.laps.last()?.lap;
    let range = [0.5, f64::from(last) + 0.5];
    // The axis starts just below the best time, so that differences are visible.
    let low = (best - 0.3 * (worst - best) - 0.05 * best).max(0.0);
    let mut plot = Plot::new(range, [low, worst * 1.01], ["lap", "time [s]"]);
    plot.bars(
        0.8,
        car.laps.iter().map(|lap| {
            let class = if lap.time_s <= best { "best" } else { "bar" };
            let title = format!("lap {}: {:.3} s on {}", lap.lap, lap.time_s, lap.set);
            (class, [f64::from(lap.lap), lap.time_s], title)
        }),
    );
    Some(plot.finish())
}

fn states(car: &CarReport, duration_s: f64) -> Option<String> {
    let healths = &car.series.healths;
    let rank = |v: &HealthPoint| match v.state {
        protocol::State::Localized => 3.0,
        protocol::State::Degraded => 2.0,
        protocol::State::Init | protocol::State::Converging | protocol::State::Relocalizing => 1.0,
        protocol::State::Lost | protocol::State::Stale => 0.0,
    };
    let name = "3 localized, 2 degraded, 1 searching, 0 lost";
    let mut plot = Plot::new([0.0, duration_s], [0.0, 3.2], ["time [s]", name]);
    let steps = healths
        .windows(2)
        .flat_map(|pair| [[pair[0].at_s, rank(&pair[0])], [pair[1].at_s, rank(&pair[0])]]);
    plot.line("main", steps);
    (healths.len() > 1).then(|| plot.finish())
}

fn error(car: &CarReport) -> Option<String> {
    let (poses, truths) = (&car.series.poses, &car.series.truths);
    let first = poses.first()?.sensor;
    let last = poses.last()?.sensor;
    let seconds = |at: i64| (at - first) as f64 * 1e-9;
    // One point per pixel, each the worst of its interval.
    let slots = WIDTH as usize;
    let mut worst = vec![f64::NAN; slots];
    for spot in poses {
        if let Some([distance, ..]) = error_of(spot, truths) {
            let slot = (spot.sensor - first) as f64 / (last - first + 1) as f64 * slots as f64;
            let slot = &mut worst[(slot as usize).min(slots - 1)];
            *slot = slot.max(distance);
        }
    }
    let most = worst
        .iter()
        .copied()
        .filter(|e| e.is_finite())
        .fold(0.02, f64::max);
    car.truth?;
    let mut plot = Plot::new(
        [0.0, seconds(last)],
        [0.0, most],
        ["time since the first pose [s]", "distance [m]"],
    );
    let step = seconds(last) / slots as f64;
    plot.line(
        "main",
        worst.iter().enumerate().map(|(i, e)| [i as f64 * step, *e]),
    );
    Some(plot.finish())
}

fn load(car: &CarReport, duration_s: f64) -> Option<String> {
    let loads = &car.series.loads;
    let most = loads.iter().map(|load| load[1]).fold(0.1, f64::max);
    let mut plot = Plot::new([0.0, duration_s], [0.0, most], ["time [s]", "cores"]);
    plot.line("main", loads.iter().map(|load| [load[0], load[1]]));
    (loads.len() > 1).then(|| plot.finish())
}

/// The map from above with the poses on it.
fn track(car: &CarReport) -> Option<String> {
    let series = &car.series;
    let map = series.map.as_ref()?;
    let (sin, cos) = map.origin.heading.sin_cos();
    let in_map = |column: f64, row: f64| {
        let (u, v) = (column * map.resolution, row * map.resolution);
        [map.origin.x + cos * u - sin * v, map.origin.y + sin * u + cos * v]
    };
    let width = map.width.max(1) as usize;
    // One stroke for each run of walls in a row, which is a fraction of the number of cells.
    let (mut walls, mut at) = (String::new(), 0_usize);
    let mut extent = [f64::INFINITY, f64::INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY];
    for &(cell, length) in &map.runs {
        let end = at + length as usize;
        if cell == Cell::Occupied {
            let mut from = at;
            while from < end {
                let to = end.min((from / width + 1) * width);
                let row = (from / width) as f64 + 0.5;
                let [x0, y0] = in_map((from % width) as f64, row);
                let [x1, y1] = in_map((from % width + (to - from)) as f64, row);
                for [x, y] in [[x0, y0], [x1, y1]] {
                    extent = [
                        extent[0].min(x),
                        extent[1].min(y),
                        extent[2].max(x),
                        extent[3].max(y),
                    ];
                }
                walls.push_str(&format!("M{x0:.2} {:.2}L{x1:.2} {:.2}", -y0, -y1));
                from = to;
            }
        }
        at = end;
    }
    if !extent[0].is_finite() || series.poses.is_empty() {
        return None;
    }
    let mut paths = [String::new(), String::new(), String::new()];
    let mut health = series.healths.iter().peekable();
    let mut alignment = 1.0;
    let begin = series.poses[0].sensor;
    let first_health = series.healths.first().map_or(0.0, |v| v.at_s);
    let mut before: Option<[f64; 2]> = None;
    // A few thousand points are enough.
    for spot in series.poses.iter().step_by(series.poses.len() / 6000 + 1) {
        let at_s = (spot.sensor - begin) as f64 * 1e-9 + first_health;
        while let Some(vital) = health.next_if(|vital| vital.at_s <= at_s) {
            alignment = vital.alignment;
        }
        let here = [spot.pose.x, spot.pose.y];
        let near = before.is_some_and(|[x, y]| (x - here[0]).hypot(y - here[1]) < 1.5);
        if let Some([x, y]) = before.filter(|_| near) {
            let class = if alignment > 0.7 {
                0
            } else {
                usize::from(alignment <= 0.45) + 1
            };
            paths[class].push_str(&format!("M{x:.2} {:.2}L{:.2} {:.2}", -y, here[0], -here[1]));
        }
        before = Some(here);
    }
    let [x0, y0, x1, y1] = extent;
    let margin = 0.3;
    let cell = map.resolution;
    let paths = ["good", "warn", "bad"]
        .iter()
        .zip(&paths)
        .map(|(class, path)| format!(r#"<path class="{class}" stroke-width="0.06" d="{path}"/>"#))
        .collect::<Vec<_>>()
        .concat();
    Some(format!(
        r#"<svg class="track" viewBox="{:.2} {:.2} {:.2} {:.2}" role="img"><title>{}</title><path class="wall" stroke-width="{cell:.3}" d="{walls}"/>{paths}</svg>"#,
        x0 - margin,
        -y1 - margin,
        x1 - x0 + 2.0 * margin,
        y1 - y0 + 2.0 * margin,
        escape(&map.name),
    ))
}
