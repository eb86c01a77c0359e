//! Laps, tracks and findings as the page and the report draw them.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::sync::Arc;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use protocol::CarName;
use serde::Serialize;

use super::advice::{Advice, advise};
use super::channel::ChannelInfo;
use super::{Channel, LapBook, LapKind, LapTrace, MapCheck, MapFinding, Sectors, TrackLine, ideal_lap};
use crate::fleet::SECTORS;

/// Everything but the laps' data.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct AnalysisView {
    pub(crate) channels: Vec<ChannelInfo>,
    pub(crate) tracks: Vec<TrackView>,
    pub(crate) laps: Vec<LapHead>,
    pub(crate) findings: Vec<MapFinding>,
    pub(crate) advice: Vec<AdviceView>,
}

/// What limited a lap, with its evidence.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct AdviceView {
    car: CarName,
    lap: u32,
    /// The lap's id, and that of the lap it is compared with.
    id: String,
    reference: String,
    #[serde(flatten)]
    advice: Advice,
}

/// The laps of one car in one session.
#[derive(Debug, Clone, Copy)]
pub(crate) struct CarLaps<'a> {
    /// The session's name.
    pub(crate) session: &'a str,
    pub(crate) car: &'a CarName,
    pub(crate) book: &'a LapBook,
    pub(crate) check: Option<&'a MapCheck>,
}

/// A track to draw.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct TrackView {
    key: String,
    name: String,
    length: f64,
    cells: usize,
    /// The line at the begin of each cell, and at the end \[m\].
    line: Vec<[f64; 2]>,
    /// The walls as an SVG path, y down \[m\].
    walls: String,
    /// Width of a wall \[m\].
    width: f64,
    /// Borders between sectors \[m\].
    sectors: Vec<f64>,
    /// Best time of each sector among the laps that count \[s\]; None without such a lap.
    ideal: Option<Vec<f64>>,
}

/// A lap in a list.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct LapHead {
    /// Identifies the lap among all that are shown.
    pub(crate) id: String,
    pub(crate) session: String,
    pub(crate) car: CarName,
    pub(crate) lap: u32,
    pub(crate) track: String,
    /// By the car's clock \[unix ns\].
    pub(crate) begun: i64,
    pub(crate) time_s: Option<f64>,
    pub(crate) set: Option<String>,
    pub(crate) kind: &'static str,
    /// Why it does not count.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) reason: Option<&'static str>,
    /// Time of each sector \[s\].
    pub(crate) sectors: Vec<Option<f64>>,
}

/// The data of a lap, packed: base64 of little-endian numbers.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct LapData {
    /// Time since the begin at each edge of a cell, `i32`, in tenths of a millisecond; the least number for none.
    edges: String,
    /// Each channel with a value, `i16` in its steps; the least number for none.
    channels: BTreeMap<&'static str, String>,
    /// Stretches with causes: first cell, last cell, causes in words.
    causes: Vec<(usize, usize, String)>,
    /// Stretches in one state: first cell, last cell, state.
    states: Vec<(usize, usize, String)>,
}

impl AnalysisView {
    /// All laps of these cars. `sectors` are those kept with a track; None for the usual ones.
    pub(crate) fn of(cars: &[CarLaps<'_>], sectors: impl Fn(&TrackLine) -> Option<Sectors>) -> Self {
        let mut lines: Vec<&Arc<TrackLine>> = Vec::new();
        let all = || cars.iter().flat_map(|car| car.book.laps());
        let known = cars.iter().filter_map(|car| car.book.line());
        for line in known.chain(all().map(|lap| &lap.line)) {
            if !lines.iter().any(|other| other.key == line.key) {
                lines.push(line);
            }
        }
        let of_line: BTreeMap<&str, Sectors> = lines
            .iter()
            .map(|line| {
                let usual = || Sectors::equal(SECTORS, line.length);
                (line.key.as_str(), sectors(line).unwrap_or_else(usual))
            })
            .collect();
        let findings = MapCheck::findings(cars.iter().filter_map(|car| car.check));
        let mut laps = Vec::new();
        let mut advice = Vec::new();
        for car in cars {
            for lap in car.book.laps() {
                if let Some(sectors) = of_line.get(lap.line.key.as_str()) {
                    laps.push(LapHead::of(car.session, car.car, lap, sectors));
                }
            }
            advice.extend(advice_for(car, cars, &of_line, &findings));
        }
        advice.sort_by_key(|(begun, _)| *begun);
        Self {
            channels: Channel::ALL.into_iter().map(Channel::info).collect(),
            tracks: lines
                .iter()
                .filter_map(|line| Some(TrackView::of(line, of_line.get(line.key.as_str())?, all())))
                .collect(),
            laps,
            findings,
            advice: advice.into_iter().map(|(_, advice)| advice).collect(),
        }
    }

    /// The data of a lap of these cars.
    pub(crate) fn data(cars: &[CarLaps<'_>], id: &str) -> Option<LapData> {
        cars.iter().find_map(|car| {
            let mut laps = car.book.laps();
            let lap = laps.find(|lap| lap_id(car.session, car.car, lap.id) == id)?;
            Some(LapData::of(lap))
        })
    }
}

/// What limited each lap of a car, with the lap's begin.
fn advice_for(
    car: &CarLaps<'_>,
    cars: &[CarLaps<'_>],
    sectors: &BTreeMap<&str, Sectors>,
    findings: &[MapFinding],
) -> Vec<(i64, AdviceView)> {
    let timed = || car.book.laps().filter(|lap| lap.time_s.is_some());
    let best = |key: &str| {
        timed()
            .filter(|lap| lap.counts() && lap.line.key == key)
            .min_by(|a, b| {
                a.time_s
                    .unwrap_or(f64::MAX)
                    .total_cmp(&b.time_s.unwrap_or(f64::MAX))
            })
    };
    let others: Vec<(&CarName, &LapBook)> = cars
        .iter()
        .filter(|other| other.session == car.session && other.car != car.car)
        .map(|other| (other.car, other.book))
        .collect();
    timed()
        .filter_map(|lap| {
            let reference = best(&lap.line.key)?;
            let sectors = sectors.get(lap.line.key.as_str())?;
            let id = |lap: &LapTrace| lap_id(car.session, car.car, lap.id);
            Some((
                lap.begun,
                AdviceView {
                    car: car.car.clone(),
                    lap: lap.lap,
                    id: id(lap),
                    reference: id(reference),
                    advice: advise(lap, reference, sectors, findings, &others),
                },
            ))
        })
        .collect()
}

fn lap_id(session: &str, car: &CarName, id: u64) -> String {
    format!("{session}/{car}/{id}")
}

impl TrackView {
    pub(crate) fn of<'a>(
        line: &TrackLine,
        sectors: &Sectors,
        laps: impl IntoIterator<Item = &'a Arc<LapTrace>>,
    ) -> Self {
        let (runs, width) = line.wall_runs();
        let mut walls = String::new();
        for [x0, y0, x1, y1] in runs {
            // Writing to a string cannot fail.
            write!(walls, "M{x0:.2} {:.2}L{x1:.2} {:.2}", -y0, -y1).ok();
        }
        let cell = line.cell();
        let round = |v: f64| (v * 1e3).round() / 1e3;
        let same = |lap: &&Arc<LapTrace>| lap.line.key == line.key;
        Self {
            key: line.key.clone(),
            name: line.name.clone(),
            length: line.length,
            cells: line.cells,
            line: (0..=line.cells)
                .map(|i| line.point((i % line.cells) as f64 * cell).map(round))
                .collect(),
            walls,
            width,
            sectors: sectors.borders().to_vec(),
            ideal: ideal_lap(sectors, laps.into_iter().filter(same)).map(|(best, _)| best),
        }
    }
}

impl LapHead {
    pub(crate) fn of(session: &str, car: &CarName, trace: &LapTrace, sectors: &Sectors) -> Self {
        let (kind, reason) = match trace.kind {
            LapKind::Flying => ("flying", None),
            LapKind::Out => ("out", None),
            LapKind::In => ("in", None),
            LapKind::Invalid(reason) => ("invalid", Some(reason.words())),
        };
        Self {
            id: lap_id(session, car, trace.id),
            session: session.to_owned(),
            car: car.clone(),
            lap: trace.lap,
            track: trace.line.key.clone(),
            begun: trace.begun,
            time_s: trace.time_s,
            set: trace.set.clone(),
            kind,
            reason,
            sectors: sectors.times(trace),
        }
    }
}

impl LapData {
    pub(crate) fn of(trace: &LapTrace) -> Self {
        let edges = trace.edges.iter().flat_map(|time| {
            let tenths = f64::from(*time) * 1e4;
            let packed = if tenths.is_finite() {
                tenths.round() as i32
            } else {
                i32::MIN
            };
            packed.to_le_bytes()
        });
        let channels = Channel::ALL
            .into_iter()
            .filter(|channel| trace.channel(*channel).iter().any(|value| value.is_finite()))
            .map(|channel| {
                let step = channel.info().step;
                let bytes: Vec<u8> = trace
                    .channel(channel)
                    .iter()
                    .flat_map(|value| pack(f64::from(*value), step).to_le_bytes())
                    .collect();
                (channel.name(), BASE64.encode(bytes))
            })
            .collect();
        Self {
            edges: BASE64.encode(edges.collect::<Vec<u8>>()),
            channels,
            causes: runs(&trace.causes, |cell| words(trace, cell)),
            states: runs(&trace.states, |cell| {
                trace.states[cell].map(|state| state.to_string())
            }),
        }
    }
}

/// A value in steps; the least number for one that is not known.
fn pack(value: f64, step: f64) -> i16 {
    if value.is_finite() {
        (value / step)
            .round()
            .clamp(f64::from(-i16::MAX), f64::from(i16::MAX)) as i16
    } else {
        i16::MIN
    }
}

/// Stretches of equal values that have a text.
fn runs<T: PartialEq>(values: &[T], text: impl Fn(usize) -> Option<String>) -> Vec<(usize, usize, String)> {
    let mut found = Vec::new();
    let mut from = 0;
    for to in 1..=values.len() {
        if to == values.len() || values[to] != values[from] {
            if let Some(text) = text(from) {
                found.push((from, to - 1, text));
            }
            from = to;
        }
    }
    found
}

/// The causes in a cell in words; None without one.
fn words(trace: &LapTrace, cell: usize) -> Option<String> {
    let named: Vec<_> = trace.causes(cell).map(protocol::CauseKind::words).collect();
    (!named.is_empty()).then(|| named.join("; "))
}

#[cfg(test)]
mod tests {
    use super::super::lap_book::tests::drive;
    use super::*;

    #[test]
    fn packed_channels_are_within_half_a_step() {
        let book = drive(1, |_, _| 4.0);
        let lap = book.laps().find(|lap| lap.counts()).expect("a lap");
        let data = LapData::of(lap);
        for channel in Channel::ALL {
            let Some(text) = data.channels.get(channel.name()) else {
                assert_eq!(channel, Channel::UpdateTime);
                continue;
            };
            let bytes = BASE64.decode(text).expect("base64");
            let step = channel.info().step;
            for (pair, value) in bytes.chunks(2).zip(lap.channel(channel)) {
                let packed = i16::from_le_bytes([pair[0], pair[1]]);
                assert!(
                    (f64::from(packed) * step - f64::from(*value)).abs() <= 0.51 * step,
                    "{channel:?}"
                );
            }
        }
        assert_eq!(data.causes.len(), 1);
        assert_eq!(data.causes[0].2, "wheels slip");
        assert_eq!(data.states, [(0, 74, "LOCALIZED".to_owned())]);
        assert_eq!(
            (pack(f64::NAN, 1.0), pack(1e9, 1.0), pack(-1e9, 1.0)),
            (i16::MIN, i16::MAX, -i16::MAX)
        );
    }
}
