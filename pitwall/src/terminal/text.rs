//! Cars and log entries as text.

use pitwall::{CarView, LogEntry, RecorderView};
use protocol::{Severity, Shadow};

/// A table with one line per car.
pub(crate) fn table(cars: &[CarView]) -> String {
    let mut text = format!(
        "{:<12} {:<13} {:<16} {:>7} {:>7} {:>8} {:>8} {:>7}  {}",
        "car", "state", "set", "pose/s", "age ms", "RTT ms", "missing", "lap s", "why"
    );
    for car in cars {
        let set = car
            .set
            .as_ref()
            .map_or("-".to_owned(), |set| format!("{} r{}", set.name, set.revision));
        let rate = car.streams.get("pose").map_or(0.0, |stream| stream.rate_hz);
        let missing = car.missing;
        let lines = format!(
            "\n{:<12} {:<13} {:<16} {:>7.1} {:>7} {:>8} {:>8} {:>7}  {}",
            car.car,
            car.state,
            set,
            rate,
            number(car.pose.as_ref().map(|pose| pose.age_s * 1e3), 0),
            number(car.round_trip_s.map(|s| s * 1e3), 1),
            missing,
            number(car.last_lap_s, 2),
            car.causes.first().map_or("", String::as_str),
        );
        text.push_str(&lines);
    }
    text
}

/// What the recorders of the pit walls do, on one line.
pub(crate) fn recorders(recorders: &[RecorderView]) -> String {
    let texts: Vec<_> = recorders.iter().map(ToString::to_string).collect();
    if texts.is_empty() {
        "nobody at the pit wall records".to_owned()
    } else {
        texts.join("; ")
    }
}

/// One car in detail, on about a dozen lines.
pub(crate) fn card(car: &CarView) -> String {
    let mut lines = vec![format!(
        "{}  {}{}",
        car.car,
        car.state,
        car.state_for_s
            .filter(|_| !car.blind)
            .map_or_else(String::new, |s| format!(" for {s:.0} s")),
    )];
    lines.extend(car.causes.iter().map(|cause| format!("  - {cause}")));
    if let Some(pose) = &car.pose {
        let (along, across) = (
            pose.covariance.xx.max(0.0).sqrt(),
            pose.covariance.yy.max(0.0).sqrt(),
        );
        lines.push(format!(
            "pose    x {:8.3} m  y {:8.3} m  heading {:6.1} deg  {:5.2} m/s  sigma {along:.3} x {across:.3} m",
            pose.x_m,
            pose.y_m,
            pose.heading_rad.to_degrees(),
            pose.speed_mps,
        ));
        lines.push(format!(
            "track   s {:>8} m  d {:>8} m  lap {}  last {} s  best {} s",
            number(pose.s_m, 2),
            number(pose.d_m, 3),
            pose.lap,
            number(car.last_lap_s, 3),
            number(car.best_lap_s, 3),
        ));
    }
    if let Some(metrics) = car.health.as_ref().and_then(|health| health.metrics) {
        lines.push(format!(
            "health  alignment {:.2}  residual {:.3} m  short {:.2}  long {:.2}  ESS {:.2}  slip {:+.2}  particles {}",
            metrics.alignment,
            metrics.residual,
            metrics.short_beams,
            metrics.long_beams,
            metrics.ess_ratio,
            metrics.slip,
            metrics.particles,
        ));
    }
    if let Some(set) = &car.set {
        let revert = match (&set.reverts_to, set.reverts_in_s) {
            (Some(to), Some(s)) => format!("  falls back to {to} in {s:.0} s"),
            _ => String::new(),
        };
        lines.push(format!(
            "set     {} revision {} by {}{revert}  (on the car: {})",
            set.name,
            set.revision,
            set.who,
            set.available.join(", "),
        ));
    }
    let rate = |topic: &str| car.streams.get(topic).map_or(0.0, |stream| stream.rate_hz);
    let missing = car.missing;
    let recovered: u64 = car.streams.values().map(|stream| stream.filled_late).sum();
    lines.push(format!(
        "link    pose {:.1}/s  cloud {:.1}/s  health {:.1}/s  age {} ms  RTT {} ms  clock {} +/- {} ms  missing {missing}  recovered {recovered}",
        rate("pose"),
        rate("cloud"),
        rate("health"),
        number(car.pose.as_ref().map(|pose| pose.age_s * 1e3), 0),
        number(car.round_trip_s.map(|s| s * 1e3), 1),
        number(car.clock_offset_s.map(|s| s * 1e3), 1),
        number(car.clock_uncertainty_s.map(|s| s * 1e3), 1),
    ));
    if let Some(load) = &car.load {
        lines.push(format!(
            "load    cpu {:.2} cores  update {:.2}/{:.2} ms  scans {:.1}/s  odometry {:.1}/s  dropped {}  memory {} MB{}",
            load.cpu_process,
            load.update_us.p50 / 1e3,
            load.update_us.p99 / 1e3,
            load.scan_rate,
            load.odometry_rate,
            load.drops.total(),
            load.memory_process / 1_000_000,
            load.temperature.map_or_else(String::new, |t| format!("  {t:.0} C")),
        ));
        if let Some(recorder) = &load.recorder {
            lines.push(format!("on car  {recorder}"));
        }
    }
    lines.join("\n")
}

/// A number, or a dash.
pub(crate) fn number(value: Option<f64>, decimals: usize) -> String {
    value.map_or("-".to_owned(), |value| format!("{value:.decimals$}"))
}

/// `12:03:04.250 WARNING  car-1 set: ... [ana]`, in UTC.
pub(crate) fn log_line(entry: &LogEntry) -> String {
    let LogEntry {
        at,
        car,
        severity,
        text,
        who,
        ..
    } = entry;
    let severity = match severity {
        Severity::Info => "",
        Severity::Warning => "WARNING ",
        Severity::Critical => "CRITICAL ",
    };
    let car = car.as_ref().map_or_else(String::new, |car| format!("{car} "));
    let who = who.as_ref().map_or_else(String::new, |who| format!(" [{who}]"));
    format!("{} {severity}{car}{text}{who}", clock(*at))
}

/// Time of day, UTC.
fn clock(unix_ns: i64) -> String {
    let millis = unix_ns.rem_euclid(86_400_000_000_000) / 1_000_000;
    let (seconds, millis) = (millis / 1000, millis % 1000);
    format!(
        "{:02}:{:02}:{:02}.{millis:03}",
        seconds / 3600,
        seconds / 60 % 60,
        seconds % 60
    )
}

/// How a shadow set compares with the one in force, on one line.
pub(crate) fn comparison(shadow: &Shadow) -> String {
    match (&shadow.set, &shadow.comparison) {
        (Some(set), Some(c)) => format!(
            "shadow  {set} fits better on {:.0} % of {} scans, {} on {:.0} %; poses {:.3} m apart",
            c.shadow_better * 100.0,
            c.scans,
            c.in_force.name,
            c.force_better * 100.0,
            c.distance,
        ),
        (Some(set), None) => format!("shadow  {set}; nothing to compare yet"),
        (None, _) => "shadow  none".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::CarName;

    #[test]
    fn a_log_line_has_time_severity_text_and_operator() {
        let entry = LogEntry {
            number: 1,
            at: 1_700_000_000_250_000_000,
            car: CarName::new("car-1").ok(),
            severity: Severity::Warning,
            kind: "set",
            text: "set lq".into(),
            who: Some("ana".into()),
        };
        assert_eq!(log_line(&entry), "22:13:20.250 WARNING car-1 set lq [ana]");
    }
}
