//! What happened when on one car: states, alarms, switches, link and load, second by second.

use std::collections::BTreeMap;

use protocol::{EventKind, Severity, Telemetry, Topic};
use serde::Serialize;

use crate::event::{EventPayload, FleetEvent};
use crate::fleet::{Car, LogEntry};

/// An alarm with its time and place.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Alarm {
    /// Time since the recording's start \[s\].
    pub at_s: f64,
    /// Arc length on the raceline \[m\]; None where it is not known.
    pub s_m: Option<f64>,
    /// Laps begun by then; None before the first pose.
    pub lap: Option<u32>,
    /// What happened.
    pub text: String,
}

/// One second.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Second {
    /// Poses that arrived.
    pub(super) poses: u32,
    /// Age of the poses that arrived, greatest and sum \[s\].
    pub(super) age_max: f64,
    pub(super) age_sum: f64,
    /// Alignment, lowest and sum, over so many messages.
    pub(super) alignment_low: f64,
    pub(super) alignment_sum: f64,
    pub(super) healths: u32,
}

/// Everything over time.
#[derive(Debug, Clone, Default)]
pub(super) struct Timeline {
    /// By the second since the recording's start.
    pub(super) seconds: BTreeMap<u32, Second>,
    /// Each state with its first cause, and since when \[s\].
    pub(super) states: Vec<(f64, String, String)>,
    /// Sets that came into force, and when \[s\].
    pub(super) switches: Vec<(f64, String)>,
    pub(super) alarms: Vec<Alarm>,
}

impl Timeline {
    /// Most states, switches and alarms.
    const MOST: usize = 20_000;

    /// Adds an event of this car after it was applied.
    pub(super) fn add(&mut self, event: &FleetEvent, car: &Car, at_s: f64) {
        let EventPayload::Message {
            topic,
            header,
            telemetry,
            ..
        } = &event.payload
        else {
            return;
        };
        let second = self.seconds.entry(at_s.max(0.0) as u32).or_default();
        match (&**telemetry, topic) {
            (Telemetry::Pose(_), Topic::Pose) => {
                let age = (event.at + car.clock_offset() - header.sensor) as f64 * 1e-9;
                second.poses += 1;
                second.age_max = second.age_max.max(age);
                second.age_sum += age;
            }
            (Telemetry::Health(health), Topic::Health) => {
                if let Some(metrics) = &health.metrics {
                    let alignment = f64::from(metrics.alignment);
                    let low = if second.healths == 0 {
                        alignment
                    } else {
                        second.alignment_low
                    };
                    second.alignment_low = low.min(alignment);
                    second.alignment_sum += alignment;
                    second.healths += 1;
                }
                self.note_state(car, event.at, at_s);
            }
            (Telemetry::Event(event), _) => {
                let set = match &event.kind {
                    EventKind::ParametersChanged { to, .. } => Some(to.name.clone()),
                    EventKind::ParametersFellBack { to, .. } => Some(format!("{} (fell back)", to.name)),
                    _ => None,
                };
                if let Some(set) = set.filter(|_| self.switches.len() < Self::MOST) {
                    self.switches.push((at_s, set));
                }
            }
            _ => {}
        }
    }

    /// Notes the state of the car at `now` \[unix ns\], if it is another one.
    pub(super) fn note_state(&mut self, car: &Car, now: i64, at_s: f64) {
        let (state, cause) = if car.blind(now) {
            ("BLIND".to_owned(), String::new())
        } else if let Some(health) = &car.health {
            let cause = health.causes.first();
            (
                health.state.to_string(),
                cause.map_or_else(String::new, |cause| cause.kind.words().to_owned()),
            )
        } else {
            return;
        };
        let last = self.states.last();
        if last.is_none_or(|(_, before, _)| *before != state) && self.states.len() < Self::MOST {
            self.states.push((at_s, state, cause));
        }
    }

    /// Adds an entry of the log if it is an alarm of this car.
    pub(super) fn note_entry(&mut self, entry: &LogEntry, car: &Car, at_s: f64) {
        if entry.severity == Severity::Critical && self.alarms.len() < Self::MOST {
            self.alarms.push(Alarm {
                at_s,
                s_m: car.book().s(),
                lap: car.pose.map(|(_, pose)| pose.lap),
                text: entry.text.clone(),
            });
        }
    }

    /// Each state with its begin and end \[s\].
    pub(super) fn spans(&self, end_s: f64) -> impl Iterator<Item = (&str, [f64; 2], &str)> {
        self.states
            .iter()
            .enumerate()
            .map(move |(i, (from, state, cause))| {
                let to = self.states.get(i + 1).map_or(end_s, |(to, ..)| *to);
                (state.as_str(), [*from, to], cause.as_str())
            })
    }
}
