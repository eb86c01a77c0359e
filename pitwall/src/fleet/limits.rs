//! Alarm limits of the engineer: for each metric a value from which on an alarm is raised, on one track.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::analysis::{Channel, Worse};

/// The limit of each metric, by the channel's name, in the channel's own unit.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Limits(BTreeMap<String, f64>);

impl Limits {
    /// Checks the limits; what is wrong as `Err`.
    pub fn new(limits: BTreeMap<String, f64>) -> Result<Self, String> {
        for (name, limit) in &limits {
            match Channel::named(name) {
                None => return Err(format!("no metric {name}")),
                Some(_) if !limit.is_finite() => return Err(format!("{name}: {limit} is no limit")),
                Some(_) => {}
            }
        }
        Ok(Self(limits))
    }

    /// The limits by the channels' names.
    pub fn to_map(&self) -> BTreeMap<String, f64> {
        self.0.clone()
    }

    /// Start of a note that has the limits.
    const NOTE: &str = "alarm limits: ";

    /// The limits as a note in the recording: `alarm limits: alignment 95 %, slip 8 %`.
    pub(crate) fn to_note(&self) -> String {
        let parts: Vec<String> = self
            .iter()
            .map(|(channel, limit)| {
                let info = channel.info();
                let shown = (limit * info.factor * 1e6).round() / 1e6;
                format!("{} {shown} {}", info.label, info.unit)
                    .trim_end()
                    .to_owned()
            })
            .collect();
        let list = if parts.is_empty() {
            "none".to_owned()
        } else {
            parts.join(", ")
        };
        format!("{}{list}", Self::NOTE)
    }

    /// The limits of a note; None for any other note, and for one that cannot be read.
    pub(crate) fn of_note(note: &str) -> Option<Self> {
        let list = note.strip_prefix(Self::NOTE)?;
        let mut limits = BTreeMap::new();
        for part in list.split(", ").filter(|part| *part != "none") {
            let (channel, rest) = Channel::ALL.into_iter().find_map(|channel| {
                Some((
                    channel,
                    part.strip_prefix(channel.info().label)?.strip_prefix(' ')?,
                ))
            })?;
            let shown: f64 = rest.split(' ').next()?.parse().ok()?;
            let info = channel.info();
            limits.insert(info.name.to_owned(), shown / info.factor);
        }
        Self::new(limits).ok()
    }

    /// Each metric with its limit.
    pub fn iter(&self) -> impl Iterator<Item = (Channel, f64)> + '_ {
        self.0
            .iter()
            .filter_map(|(name, limit)| Some((Channel::named(name)?, *limit)))
    }
}

/// Which limits a car is beyond, and since when.
#[derive(Debug, Clone, Default)]
pub(crate) struct LimitWatch(BTreeMap<Channel, Beyond>);

#[derive(Debug, Clone, Copy)]
struct Beyond {
    since: i64,
    last: i64,
    raised: bool,
}

impl LimitWatch {
    /// A value must be beyond its limit for this long \[ns\].
    const LASTS: i64 = 300_000_000;
    /// It is over when the value was good for this long \[ns\].
    const REST: i64 = 1_000_000_000;

    /// Checks a car's values at `at` \[ns\]; the metrics that have just raised an alarm, with value and limit.
    pub(crate) fn check(
        &mut self,
        limits: &Limits,
        at: i64,
        value: impl Fn(Channel) -> Option<f64>,
    ) -> Vec<(Channel, f64, f64)> {
        let mut raised = Vec::new();
        for (channel, limit) in limits.iter() {
            let Some(value) = value(channel) else { continue };
            let beyond = match channel.info().worse {
                Worse::Low => value < limit,
                Worse::Far => value.abs() > limit.abs(),
                Worse::High | Worse::Neither => value > limit,
            };
            if beyond {
                let state = self.0.entry(channel).or_insert(Beyond {
                    since: at,
                    last: at,
                    raised: false,
                });
                state.last = at;
                if !state.raised && at - state.since >= Self::LASTS {
                    state.raised = true;
                    raised.push((channel, value, limit));
                }
            } else if let Some(state) = self.0.get(&channel)
                && (!state.raised || at - state.last >= Self::REST)
            {
                self.0.remove(&channel);
            }
        }
        raised
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_alarm_is_raised_once_until_the_value_was_good_for_a_second() {
        let limits = Limits::new(BTreeMap::from([
            ("slip".to_owned(), 0.2),
            ("alignment".to_owned(), 0.8),
        ]))
        .expect("good");
        let mut watch = LimitWatch::default();
        let mut raised = Vec::new();
        for i in 0..100_i64 {
            // Beyond from 1 s to 2 s, from 2.5 s to 3 s and from 6 s on; one outlier at 0.5 s.
            let slips = (10..20).contains(&i) || (25..30).contains(&i) || i >= 60 || i == 5;
            let value = |channel| match channel {
                Channel::Slip => Some(if slips { -0.3 } else { 0.0 }),
                Channel::Alignment => Some(0.9),
                _ => None,
            };
            for (channel, ..) in watch.check(&limits, i * 100_000_000, value) {
                raised.push((channel, i));
            }
        }
        assert_eq!(raised, [(Channel::Slip, 13), (Channel::Slip, 63)]);
    }

    #[test]
    fn a_note_has_every_limit() {
        let all = Channel::ALL.into_iter().zip(1..);
        let all: BTreeMap<String, f64> = all
            .map(|(channel, i)| (channel.name().to_owned(), f64::from(i) * 0.031))
            .collect();
        for limits in [all, BTreeMap::new()] {
            let limits = Limits::new(limits).expect("good");
            let read = Limits::of_note(&limits.to_note()).expect("a note of limits");
            assert_eq!(read.iter().count(), limits.iter().count());
            for ((channel, limit), (_, read)) in limits.iter().zip(read.iter()) {
                assert!((limit - read).abs() < 1e-6 * limit, "{channel:?}: {limit} {read}");
            }
        }
        let two = BTreeMap::from([("slip".to_owned(), 0.08), ("alignment".to_owned(), 0.955)]);
        let note = Limits::new(two).expect("good").to_note();
        assert_eq!(note, "alarm limits: alignment 95.5 %, slip 8 %");
        for other in [
            "rain",
            "alarm limits: speeed 3 m/s",
            "alarm limits: slip NaN %",
            "alarm limits: slip",
        ] {
            assert_eq!(Limits::of_note(other), None, "{other}");
        }
    }

    #[test]
    fn faulty_limits_are_named() {
        for (name, limit, fault) in [
            ("speeed", 1.0, "no metric speeed"),
            ("slip", f64::NAN, "slip: NaN is no limit"),
        ] {
            assert_eq!(
                Limits::new(BTreeMap::from([(name.to_owned(), limit)])),
                Err(fault.to_owned())
            );
        }
    }
}
