//! The figures of one car.

use std::collections::BTreeSet;

use super::svg::{Plot, WIDTH, escape};
use super::timeline::Second;
use super::{CarReport, error_of};
use crate::analysis::{Channel, LapKind};

/// A figure with its caption.
pub(super) struct Figure {
    pub(super) title: &'static str,
    pub(super) svg: String,
    /// The same as a table; empty for a map.
    pub(super) csv: String,
}

/// The figures for which the recording has data.
pub(super) fn of(car: &CarReport, duration_s: f64) -> Vec<Figure> {
    let figure = |title, drawn: Option<(String, String)>| drawn.map(|(svg, csv)| Figure { title, svg, csv });
    [
        figure(
            "The track and where the car was, coloured by alignment",
            track(car),
        ),
        figure(
            "Lap times: the fastest is green, those that do not count are hollow",
            laps(car),
        ),
        figure(
            "States, alignment, sets put in force and alarms (red) over time",
            states(car, duration_s),
        ),
        figure(
            "Alignment over the lap: mean and lowest of the laps",
            along(car, Channel::Alignment, Some([0.0, 1.0]), f64::min),
        ),
        figure(
            "Slip over the lap, without its sign: mean and highest of the laps",
            along(car, Channel::Slip, None, f64::max),
        ),
        figure(
            "Distance from the raceline over the lap: mean and greatest of the laps",
            along(car, Channel::Lateral, None, f64::max),
        ),
        figure("Error against the truth over time", error(car)),
        figure(
            "Age of the poses when they arrived: mean and greatest of each second",
            ages(car, duration_s),
        ),
        figure("Poses that arrived, second by second", poses(car, duration_s)),
        figure(
            "Share of the messages sent that are in the recording, over time",
            coverage(car, duration_s),
        ),
        figure("CPU of the node over time", load(car, duration_s)),
    ]
    .into_iter()
    .flatten()
    .collect()
}

/// Mean and worst of a channel at each place, over the whole laps.
fn along(
    car: &CarReport,
    channel: Channel,
    range: Option<[f64; 2]>,
    worst: impl Fn(f64, f64) -> f64,
) -> Option<(String, String)> {
    let info = channel.info();
    let line = car.book.line()?;
    let mut places = vec![(0.0, 0_u32, f64::NAN); line.cells];
    let whole = |kind: LapKind| matches!(kind, LapKind::Flying | LapKind::Invalid(_));
    for lap in car
        .book
        .laps()
        .filter(|lap| whole(lap.kind) && lap.line.key == line.key)
    {
        for ((sum, count, extreme), value) in places.iter_mut().zip(lap.channel(channel)) {
            let value = f64::from(*value).abs() * info.factor;
            if value.is_finite() {
                *sum += value;
                *count += 1;
                // Any number replaces NaN.
                *extreme = worst(*extreme, value);
            }
        }
    }
    let most = places.iter().map(|place| place.2).fold(f64::NAN, f64::max);
    if !most.is_finite() {
        return None;
    }
    let least = 1.2 * info.limits.first().copied().unwrap_or(0.0) * info.factor;
    let range = range.map_or([0.0, most.max(least) * 1.05], |range| {
        range.map(|v| v * info.factor)
    });
    let title = format!("{} [{}]", info.label, info.unit);
    let mut plot = Plot::new([0.0, line.length], range, ["along the raceline [m]", &title]);
    for limit in info.limits {
        plot.limit(limit * info.factor);
    }
    let at = |i: usize| (i as f64 + 0.5) * line.cell();
    let points = |value: &dyn Fn(&(f64, u32, f64)) -> f64| -> Vec<[f64; 2]> {
        places
            .iter()
            .enumerate()
            .map(|(i, place)| [at(i), value(place)])
            .collect()
    };
    plot.line("faint", &format!("worst {title}"), points(&|place| place.2));
    plot.line(
        "main",
        &format!("mean {title}"),
        points(&|place| place.0 / f64::from(place.1)),
    );
    Some(plot.finish())
}

fn laps(car: &CarReport) -> Option<(String, String)> {
    let good: Vec<f64> = (car.laps.iter())
        .filter(|lap| lap.void.is_none())
        .map(|lap| lap.time_s)
        .collect();
    let all: Vec<f64> = car.laps.iter().map(|lap| lap.time_s).collect();
    let mut times = if good.is_empty() { all } else { good };
    times.sort_by(f64::total_cmp);
    let (best, median) = (*times.first()?, times[times.len() / 2]);
    // Slow laps are drawn at the upper end, so that the others can be told apart.
    let high = (median + 2.5 * (median - best))
        .max(median * 1.03)
        .min(*times.last()? + 0.1 * median);
    let low = best - 0.15 * (high - best).max(0.02 * best);
    let mut plot = Plot::new(
        [0.5, car.laps.len() as f64 + 0.5],
        [low, high],
        ["laps in the order driven", "lap time [s]"],
    );
    plot.limit(median);
    // A car that starts again counts its laps from the beginning.
    let heats = car
        .laps
        .windows(2)
        .enumerate()
        .filter(|(_, pair)| pair[1].lap <= pair[0].lap);
    plot.marks(
        "switch",
        heats.map(|(i, pair)| {
            let text = format!("new run, {}", pair[1].set);
            (i as f64 + 1.5, text)
        }),
    );
    plot.dots(
        "lap time [s]",
        (1..).zip(&car.laps).map(|(number, lap)| {
            let class = match lap.void {
                Some(_) => "hollow",
                None if lap.time_s <= best => "best",
                None => "main-dot",
            };
            let why = lap
                .void
                .map_or_else(String::new, |reason| format!(", does not count: {reason}"));
            let title = format!("lap {}: {:.3} s on {}{why}", lap.lap, lap.time_s, lap.set);
            (class, [f64::from(number), lap.time_s], title)
        }),
    );
    Some(plot.finish())
}

/// Colour class of a state.
fn class_of(state: &str) -> &'static str {
    match state {
        "LOCALIZED" => "fill-good",
        "DEGRADED" => "fill-warn",
        "LOST" | "STALE" => "fill-bad",
        "BLIND" => "fill-none",
        _ => "fill-busy",
    }
}

fn states(car: &CarReport, duration_s: f64) -> Option<(String, String)> {
    let timeline = &car.timeline;
    if timeline.states.is_empty() {
        return None;
    }
    let mut plot = Plot::new(
        [0.0, duration_s],
        [-0.16, 1.0],
        ["time [s]", "alignment, lowest of each second"],
    );
    plot.bands(timeline.spans(duration_s).map(|(state, span, cause)| {
        let cause = if cause.is_empty() {
            String::new()
        } else {
            format!(", {cause}")
        };
        (
            class_of(state),
            span,
            format!("{state} {:.1} to {:.1} s{cause}", span[0], span[1]),
        )
    }));
    plot.line(
        "main",
        "alignment, lowest of the second",
        over_time(car, |second| (second.healths > 0).then_some(second.alignment_low)),
    );
    plot.marks("switch", timeline.switches.clone());
    plot.marks(
        "alarm",
        timeline
            .alarms
            .iter()
            .map(|alarm| (alarm.at_s, alarm.text.clone())),
    );
    Some(plot.finish())
}

/// A value of each second. Where the recording has none for more than 2 s, the line is interrupted.
fn over_time(car: &CarReport, value: impl Fn(&Second) -> Option<f64>) -> Vec<[f64; 2]> {
    let seconds = &car.timeline.seconds;
    // A point for each pixel is enough; the worst of each would need to know which value is worse.
    let step = seconds.len() / (2 * WIDTH as usize) + 1;
    let mut points: Vec<[f64; 2]> = Vec::new();
    for (at, second) in seconds
        .iter()
        .filter(|(at, _)| (**at as usize).is_multiple_of(step))
    {
        let Some(value) = value(second) else { continue };
        let at = f64::from(*at) + 0.5;
        if points.last().is_some_and(|last| at - last[0] > 2.5 * step as f64) {
            points.push([at - 0.5, f64::NAN]);
        }
        points.push([at, value]);
    }
    points
}

fn ages(car: &CarReport, duration_s: f64) -> Option<(String, String)> {
    let ms = |age: f64| age * 1e3;
    let greatest = over_time(car, |second| (second.poses > 0).then(|| ms(second.age_max)));
    let mean = over_time(car, |second| {
        (second.poses > 0).then(|| ms(second.age_sum) / f64::from(second.poses))
    });
    let mut sorted: Vec<f64> = greatest.iter().map(|p| p[1]).filter(|v| v.is_finite()).collect();
    sorted.sort_by(f64::total_cmp);
    let most = sorted.get(sorted.len().saturating_sub(1) * 995 / 1000)?.max(50.0) * 1.1;
    let mut plot = Plot::new(
        [0.0, duration_s],
        [0.0, most],
        ["time [s]", "age of the poses [ms]"],
    );
    plot.line("faint", "greatest age [ms]", greatest);
    plot.line("main", "mean age [ms]", mean);
    plot.marks(
        "alarm",
        car.timeline
            .alarms
            .iter()
            .map(|alarm| (alarm.at_s, alarm.text.clone())),
    );
    Some(plot.finish())
}

fn poses(car: &CarReport, duration_s: f64) -> Option<(String, String)> {
    let end = duration_s as u32;
    // A second without any message has no entry, and no pose.
    let step = (end as usize / (2 * WIDTH as usize) + 1) as u32;
    let count = |at: u32| car.timeline.seconds.get(&at).map_or(0, |second| second.poses);
    let points: Vec<[f64; 2]> = (0..end.min(1_000_000))
        .step_by(step as usize)
        .map(|at| [f64::from(at) + 0.5, f64::from(count(at))])
        .collect();
    let most = points.iter().map(|p| p[1]).fold(1.0, f64::max);
    let mut plot = Plot::new(
        [0.0, duration_s],
        [0.0, most * 1.1],
        ["time [s]", "poses per second"],
    );
    plot.line("main", "poses per second", points);
    (most > 1.0).then(|| plot.finish())
}

fn error(car: &CarReport) -> Option<(String, String)> {
    let (poses, truths) = (&car.series.poses, &car.series.truths);
    let first = poses.first()?.sensor;
    let last = poses.last()?.sensor;
    let seconds = |at: i64| (at - first) as f64 * 1e-9;
    // One point per pixel, each the worst of its interval.
    let slots = WIDTH as usize;
    let slot = |at: i64| {
        let slot = (at - first) as f64 / (last - first + 1) as f64 * slots as f64;
        (slot as usize).min(slots - 1)
    };
    let mut worst = vec![f64::NAN; slots];
    for spot in poses {
        if let Some([distance, ..]) = error_of(spot, truths) {
            let slot = &mut worst[slot(spot.sensor)];
            *slot = slot.max(distance * 100.0);
        }
    }
    // A pixel without a pose is no gap, a second is.
    let pauses = poses
        .windows(2)
        .filter(|pair| pair[1].sensor - pair[0].sensor > 1_000_000_000);
    let gaps: BTreeSet<usize> = pauses
        .flat_map(|pair| slot(pair[0].sensor) + 1..slot(pair[1].sensor))
        .collect();
    let most = worst
        .iter()
        .copied()
        .filter(|e| e.is_finite())
        .fold(2.0, f64::max);
    car.truth?;
    let mut plot = Plot::new(
        [0.0, seconds(last)],
        [0.0, most * 1.05],
        ["time since the first pose [s]", "distance from the truth [cm]"],
    );
    let step = seconds(last) / slots as f64;
    let points = worst
        .iter()
        .enumerate()
        .filter(|(i, e)| e.is_finite() || gaps.contains(i));
    plot.line(
        "main",
        "distance from the truth [cm]",
        points.map(|(i, e)| [i as f64 * step, *e]),
    );
    Some(plot.finish())
}

fn coverage(car: &CarReport, duration_s: f64) -> Option<(String, String)> {
    let shares = &car.series.coverage.0;
    let mut plot = Plot::new([0.0, duration_s], [0.0, 1.02], ["time [s]", "share"]);
    plot.line("main", "share", shares.iter().copied());
    (shares.len() > 1).then(|| plot.finish())
}

fn load(car: &CarReport, duration_s: f64) -> Option<(String, String)> {
    let loads = &car.series.loads;
    let most = loads.iter().map(|load| load[1]).fold(0.1, f64::max);
    let mut plot = Plot::new(
        [0.0, duration_s],
        [0.0, most * 1.05],
        ["time [s]", "CPU of the node [cores]"],
    );
    let step = loads.len() / (2 * WIDTH as usize) + 1;
    plot.line(
        "main",
        "CPU [cores]",
        loads.iter().step_by(step).map(|load| [load[0], load[1]]),
    );
    (loads.len() > 1).then(|| plot.finish())
}

/// The map from above with the poses on it.
fn track(car: &CarReport) -> Option<(String, String)> {
    let series = &car.series;
    let map = series.map.as_ref()?;
    let line = car.book.line()?;
    let (runs, width) = line.wall_runs();
    let mut walls = String::new();
    let mut extent = [f64::INFINITY, f64::INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY];
    for [x0, y0, x1, y1] in runs.iter().map(|run| run.map(f64::from)) {
        extent = [
            extent[0].min(x0.min(x1)),
            extent[1].min(y0.min(y1)),
            extent[2].max(x0.max(x1)),
            extent[3].max(y0.max(y1)),
        ];
        walls.push_str(&format!("M{x0:.2} {:.2}L{x1:.2} {:.2}", -y0, -y1));
    }
    if !extent[0].is_finite() || series.poses.is_empty() {
        return None;
    }
    let mut paths = [String::new(), String::new(), String::new()];
    let mut health = series.healths.iter().peekable();
    let mut alignment = 1.0;
    let begin = series.poses[0].sensor;
    let first_health = series.healths.first().map_or(0.0, |v| v.at_s);
    let [good, bad] = [0, 1].map(|i| Channel::Alignment.info().limits[i]);
    let mut before: Option<[f64; 2]> = None;
    // A few thousand points are enough.
    for spot in series.poses.iter().step_by(series.poses.len() / 6000 + 1) {
        let at_s = (spot.sensor - begin) as f64 * 1e-9 + first_health;
        while let Some(vital) = health.next_if(|vital| vital.at_s <= at_s) {
            alignment = vital.alignment;
        }
        let here = [spot.pose.x, spot.pose.y];
        let near = before.is_some_and(|[x, y]| (x - here[0]).hypot(y - here[1]) < 3.0);
        if let Some([x, y]) = before.filter(|_| near) {
            let class = if alignment > good {
                0
            } else {
                usize::from(alignment <= bad) + 1
            };
            paths[class].push_str(&format!("M{x:.2} {:.2}L{:.2} {:.2}", -y, here[0], -here[1]));
        }
        before = Some(here);
    }
    let [x0, y0, x1, y1] = extent;
    let margin = 0.3;
    let paths = ["good", "warn", "bad"]
        .iter()
        .zip(&paths)
        .map(|(class, path)| format!(r#"<path class="{class}" stroke-width="0.06" d="{path}"/>"#))
        .collect::<Vec<_>>()
        .concat();
    let svg = format!(
        r#"<svg xmlns="http://www.w3.org/2000/svg" class="track" viewBox="{:.2} {:.2} {:.2} {:.2}" role="img"><title>{}</title><path class="wall" stroke-width="{width:.3}" d="{walls}"/>{paths}</svg>"#,
        x0 - margin,
        -y1 - margin,
        x1 - x0 + 2.0 * margin,
        y1 - y0 + 2.0 * margin,
        escape(&map.name),
    );
    Some((svg, String::new()))
}
