//! What limited a lap, in one line, with the evidence.

use protocol::{CarName, State};
use serde::Serialize;

use super::{Channel, LapBook, LapKind, LapTrace, MapFinding, Sectors};

/// What limited a lap.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct Advice {
    /// In one line.
    pub(crate) text: String,
    /// The channel that shows it; None where none does.
    pub(crate) channel: Option<Channel>,
    /// Where it shows \[m\].
    pub(crate) from_s: f64,
    /// Where it shows \[m\].
    pub(crate) to_s: f64,
}

/// A lap that loses less than this share of its time loses nothing.
const NOTHING: f64 = 0.01;
/// Slip above which wheels slip, and by how much it must exceed that of the reference.
const SLIPS: [f64; 2] = [0.08, 0.03];
/// Share of blocked beams above which the view is blocked, and by how much it must exceed that of the reference.
const BLOCKED: [f64; 2] = [0.15, 0.05];
/// Alignment below that of the reference by this is worse.
const WORSE_ALIGNMENT: f64 = 0.05;
/// An update that takes longer comes late \[ms\].
const SLOW_UPDATE: f64 = 20.0;
/// Poses that are older than those of the reference by this come late \[ms\].
const OLDER: f64 = 20.0;
/// Cars are in view up to this distance ahead \[m\].
const AHEAD: f64 = 6.0;

/// Compares a lap with the best one of the same car. `others` are the cars that drove at the same time.
pub(crate) fn advise(
    lap: &LapTrace,
    reference: &LapTrace,
    sectors: &Sectors,
    findings: &[MapFinding],
    others: &[(&CarName, &LapBook)],
) -> Advice {
    let length = lap.line.length;
    let whole = |text: String| Advice {
        text,
        channel: None,
        from_s: 0.0,
        to_s: length,
    };
    if lap.id == reference.id {
        return whole("the best lap".to_owned());
    }
    let (Some(time), Some(best)) = (lap.time_s, reference.time_s) else {
        return whole("no time".to_owned());
    };
    let lost = time - best;
    if lost < NOTHING * best {
        return whole(format!(
            "{lost:+.3} s to lap {}: nothing limited it",
            reference.lap
        ));
    }
    let losses = sectors.spans(length).enumerate().filter_map(|(i, [from, to])| {
        let loss = lap.time_between(from, to)? - reference.time_between(from, to)?;
        Some((i + 1, from, to, loss))
    });
    let worst = losses.max_by(|a, b| a.3.total_cmp(&b.3));
    let invalid = match lap.kind {
        LapKind::Invalid(reason) => format!("{}; ", reason.words()),
        _ => String::new(),
    };
    let Some((sector, from_s, to_s, loss)) = worst else {
        return whole(format!(
            "{lost:+.3} s to lap {}: {invalid}sectors not known",
            reference.lap
        ));
    };
    let (why, channel) = reason(lap, reference, [from_s, to_s], findings, others);
    Advice {
        text: format!(
            "{lost:+.3} s to lap {}, {loss:+.3} s of it in sector {sector}: {invalid}{why}",
            reference.lap
        ),
        channel: Some(channel),
        from_s,
        to_s,
    }
}

/// What differs in a stretch, the most serious first.
fn reason(
    lap: &LapTrace,
    reference: &LapTrace,
    [from, to]: [f64; 2],
    findings: &[MapFinding],
    others: &[(&CarName, &LapBook)],
) -> (String, Channel) {
    let mean = |lap: &LapTrace, channel, of: fn(f64) -> f64| {
        let (mut sum, mut count) = (0.0, 0.0);
        for value in lap.between(channel, from, to) {
            sum += of(value);
            count += 1.0;
        }
        if count > 0.0 { sum / count } else { f64::NAN }
    };
    let both = |channel, of: fn(f64) -> f64| [mean(lap, channel, of), mean(reference, channel, of)];
    let percent = |[here, best]: [f64; 2]| format!("{:.0} % (best lap {:.0} %)", here * 100.0, best * 100.0);
    let worse = |[here, best]: [f64; 2], [limit, more]: [f64; 2]| here > limit && here > best + more;

    let alignment = both(Channel::Alignment, |v| v);
    let fits_worse = alignment[0] < alignment[1] - WORSE_ALIGNMENT;
    let on_way = |finding: &&MapFinding| {
        finding.track == lap.line.key
            && finding.from_s < to
            && (finding.to_s > from || finding.to_s < finding.from_s)
    };
    if fits_worse && let Some(finding) = findings.iter().find(on_way) {
        let text = format!(
            "the map is wrong at s = {:.1} m; alignment {}",
            finding.from_s,
            percent(alignment)
        );
        return (text, Channel::Alignment);
    }
    let blocked = both(Channel::ShortBeams, |v| v);
    if worse(blocked, BLOCKED) {
        let by = ahead(lap, [from, to], others).map_or_else(String::new, |car| format!(" by {car}"));
        return (
            format!(
                "the laser is blocked{by}: {} of the beams too short",
                percent(blocked)
            ),
            Channel::ShortBeams,
        );
    }
    let slip = both(Channel::Slip, f64::abs);
    if worse(slip, SLIPS) {
        return (format!("wheels slip: {}", percent(slip)), Channel::Slip);
    }
    let cell = lap.line.cell();
    let inside = |i: &usize| (from..to).contains(&((*i as f64 + 0.5) * cell));
    let bad = |state: &Option<State>| state.is_some_and(|state| state != State::Localized);
    if let Some(at) = (0..lap.line.cells).filter(inside).find(|i| bad(&lap.states[*i])) {
        let state = lap.states[at].map_or_else(String::new, |state| state.to_string());
        let causes: Vec<_> = lap.causes(at).map(protocol::CauseKind::words).collect();
        let causes = if causes.is_empty() {
            String::new()
        } else {
            format!(": {}", causes.join("; "))
        };
        return (
            format!("{state} at s = {:.1} m{causes}", at as f64 * cell),
            Channel::Alignment,
        );
    }
    if fits_worse {
        return (
            format!("scans fit worse: alignment {}", percent(alignment)),
            Channel::Alignment,
        );
    }
    let update = both(Channel::UpdateTime, |v| v);
    if worse(update, [SLOW_UPDATE, 0.0]) {
        return (
            format!(
                "CPU is short: an update takes {:.1} ms (best lap {:.1} ms)",
                update[0], update[1]
            ),
            Channel::UpdateTime,
        );
    }
    let age = both(Channel::Age, |v| v);
    if worse(age, [OLDER, OLDER]) {
        return (
            format!("poses come late: {:.0} ms (best lap {:.0} ms)", age[0], age[1]),
            Channel::Age,
        );
    }
    let lateral = both(Channel::Lateral, f64::abs);
    (
        format!(
            "driving, not localization: {:.1} cm off the line (best lap {:.1} cm), alignment {:.0} %, slip {:.0} %",
            lateral[0] * 100.0,
            lateral[1] * 100.0,
            alignment[0] * 100.0,
            slip[0] * 100.0
        ),
        Channel::Lateral,
    )
}

/// The car that was closest ahead at the middle of a stretch. Clocks of cars are taken as equal.
fn ahead<'a>(
    lap: &LapTrace,
    [from, to]: [f64; 2],
    others: &[(&'a CarName, &LapBook)],
) -> Option<&'a CarName> {
    let s = f64::midpoint(from, to);
    let at = lap.begun + (lap.time_at(s)? * 1e9) as i64;
    let gap = |book: &LapBook| {
        let covers = |other: &&std::sync::Arc<LapTrace>| {
            other.begun <= at
                && other
                    .time_s
                    .is_some_and(|time| at < other.begun + (time * 1e9) as i64)
        };
        let other = book.laps().rev().find(covers)?;
        let since = (at - other.begun) as f64 * 1e-9;
        let cell = other.edges.partition_point(|edge| f64::from(*edge) <= since);
        Some((cell as f64 * other.line.cell() - s).rem_euclid(lap.line.length))
    };
    others
        .iter()
        .filter_map(|(car, book)| Some((*car, gap(book)?)))
        .filter(|(_, gap)| *gap < AHEAD)
        .min_by(|a, b| a.1.total_cmp(&b.1))
        .map(|(car, _)| car)
}

#[cfg(test)]
mod tests {
    use super::super::lap_book::tests::drive;
    use super::*;
    use std::sync::Arc;

    const LENGTH: f64 = 3.0 * std::f64::consts::TAU;

    /// Two laps, the second slower in its last third, where `change` is applied to each cell.
    fn slow(change: impl Fn(&mut LapTrace, usize)) -> (Arc<LapTrace>, LapTrace) {
        let book = drive(2, |lap, s| {
            if lap == 2 && s > LENGTH * 2.0 / 3.0 {
                3.0
            } else {
                4.0
            }
        });
        let laps: Vec<_> = book.laps().filter(|lap| lap.counts()).cloned().collect();
        let mut lap = LapTrace::clone(&laps[1]);
        for cell in lap.line.cells * 2 / 3..lap.line.cells {
            change(&mut lap, cell);
        }
        (laps[0].clone(), lap)
    }

    #[test]
    fn a_slow_lap_names_its_sector_and_what_differs_there() {
        let sectors = Sectors::equal(3, LENGTH);
        let said = |change: &dyn Fn(&mut LapTrace, usize)| {
            let (best, lap) = slow(change);
            advise(&lap, &best, &sectors, &[], &[])
        };
        for (channel, value, text) in [
            (Channel::Slip, -0.2, "wheels slip: 20 % (best lap 0 %)"),
            (
                Channel::ShortBeams,
                0.4,
                "the laser is blocked: 40 % (best lap 0 %)",
            ),
            (Channel::Alignment, 0.1, "scans fit worse: alignment 10 %"),
            (Channel::Age, 90.0, "poses come late: 90 ms"),
        ] {
            let advice = said(&|lap, cell| lap.set_value(channel, cell, value));
            assert!(
                advice.text.contains("in sector 3") && advice.text.contains(text),
                "{advice:?}"
            );
            assert_eq!(advice.channel, Some(channel));
            assert!((advice.from_s - LENGTH * 2.0 / 3.0).abs() < 1e-9);
        }
        let driving = said(&|_, _| {});
        assert!(driving.text.contains("driving, not localization"), "{driving:?}");
        let (best, _) = slow(|_, _| {});
        assert_eq!(advise(&best, &best, &sectors, &[], &[]).text, "the best lap");
    }

    #[test]
    fn the_car_ahead_is_named() {
        let sectors = Sectors::equal(3, LENGTH);
        let (best, lap) = slow(|lap, cell| lap.set_value(Channel::ShortBeams, cell, 0.4));
        // The other car is on the same lap, a second earlier.
        let mut other = LapTrace::clone(&lap);
        other.begun -= 1_000_000_000;
        let book = LapBook::of_lap(other);
        let name: CarName = "car-3".parse().expect("a name");
        let advice = advise(&lap, &best, &sectors, &[], &[(&name, &book)]);
        assert!(advice.text.contains("blocked by car-3"), "{advice:?}");
    }
}
