//! A car, ready to be shown or written as JSON.

use std::collections::BTreeMap;

use protocol::{CarInfo, CarName, Health, Load, Shadow, State, plain_text};
use serde::Serialize;

use super::car::Car;
use super::stream_statistics::StreamView;
use crate::event::Rejection;

/// A car, ready to be shown or written as JSON.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CarView {
    /// Its name.
    pub car: CarName,
    /// The state in capitals: one of the car's own, `BLIND` when nothing arrives from it, or `UNKNOWN` when its health
    /// messages cannot be decoded here.
    pub state: String,
    /// The causes in words, the worst first.
    pub causes: Vec<String>,
    /// How long the car's own state has lasted \[s\].
    pub state_for_s: Option<f64>,
    /// True when nothing arrives from the car: everything below is old.
    pub blind: bool,
    /// True while the car's node runs and is connected.
    pub alive: bool,
    /// Time since anything arrived \[s\].
    pub quiet_s: f64,
    /// The newest pose.
    pub pose: Option<PoseView>,
    /// The parameter set in force.
    pub set: Option<SetView>,
    /// The shadow set and how it compares; None without one.
    pub shadow: Option<Shadow>,
    /// The newest health message.
    pub health: Option<Health>,
    /// The newest load message.
    pub load: Option<Load>,
    /// Round-trip time to the car \[s\].
    pub round_trip_s: Option<f64>,
    /// The car's clock minus this one \[s\].
    pub clock_offset_s: Option<f64>,
    /// Maximum error of the offset: half the round-trip time \[s\].
    pub clock_uncertainty_s: Option<f64>,
    /// Every stream by topic.
    pub streams: BTreeMap<&'static str, StreamView>,
    /// Messages whose content was sent and has not arrived, counted per content.
    pub missing: u64,
    /// Share of the messages sent, of the streams that must be complete, that are here, in `[0, 1]`; None before the first.
    pub coverage: Option<f64>,
    /// The last lap \[s\].
    pub last_lap_s: Option<f64>,
    /// The best lap \[s\].
    pub best_lap_s: Option<f64>,
    /// The run sheet of its heat.
    pub run_sheet: Option<String>,
    /// The software on the car.
    pub info: Option<CarInfo>,
}

impl Car {
    /// The car at `now` \[unix ns\].
    pub fn view(&self, now: i64) -> CarView {
        let seconds = |ns: i64| ns as f64 * 1e-9;
        let offset = self.clock_offset();
        let blind = self.blind(now);
        let quiet_s = seconds(now - self.last_heard).max(0.0);
        let why_unknown = self.why_unknown();
        // The last health message that can be decoded may be old.
        let health = self.health.as_ref().filter(|_| why_unknown.is_none());
        let stale = self.stale_for(now);
        let (state, mut causes) = match health {
            _ if blind => {
                let gone = if self.alive {
                    ""
                } else {
                    "the car's node or its link has gone; "
                };
                (
                    "BLIND".to_owned(),
                    vec![format!("{gone}nothing heard for {quiet_s:.1} s")],
                )
            }
            Some(_) if stale.is_some() => {
                let silent = seconds(stale.unwrap_or_default());
                let text = format!("no health message for {silent:.1} s");
                (State::Stale.to_string(), vec![text])
            }
            None => match why_unknown {
                Some(why) => ("UNKNOWN".to_owned(), vec![why]),
                None => (State::Init.to_string(), vec!["no health message yet".to_owned()]),
            },
            Some(health) => (
                health.state.to_string(),
                health.causes.iter().map(ToString::to_string).collect(),
            ),
        };
        if self.two_senders(now) {
            causes.insert(0, Rejection::TwoSenders.to_string());
        }
        let causes = causes.iter().map(|cause| plain(cause)).collect();
        let best = self.best_lap();
        let (missing, coverage) = self.coverage();
        CarView {
            car: self.name.clone(),
            state,
            causes,
            state_for_s: health
                .filter(|_| stale.is_none())
                .map(|health| seconds(now + offset - health.since).max(0.0)),
            blind,
            alive: self.alive,
            quiet_s,
            pose: self.pose.map(|(header, pose)| PoseView {
                x_m: pose.pose.x,
                y_m: pose.pose.y,
                heading_rad: pose.pose.heading,
                speed_mps: pose.twist.linear_x.hypot(pose.twist.linear_y),
                covariance: pose.covariance,
                s_m: pose.track.map(|track| track.s),
                d_m: pose.track.map(|track| track.d),
                lap: pose.lap,
                update: pose.update,
                age_s: seconds(now + offset - header.sensor),
            }),
            set: self.params.as_ref().map(|params| SetView {
                name: plain(&params.set.name),
                revision: params.revision,
                who: plain(&params.who),
                when: params.when,
                available: params.available.iter().map(|set| plain(set)).collect(),
                reverts_to: params.pending_revert.as_ref().map(|revert| plain(&revert.to)),
                reverts_in_s: params
                    .pending_revert
                    .as_ref()
                    .map(|revert| seconds(revert.at - now - offset).max(0.0)),
            }),
            shadow: self.shadow.clone().filter(|shadow| shadow.set.is_some()),
            health: health.cloned(),
            load: self.load.clone(),
            round_trip_s: self.clock().map(|(_, round_trip)| seconds(round_trip)),
            clock_offset_s: self.clock().map(|(offset, _)| seconds(offset)),
            clock_uncertainty_s: self.clock().map(|(_, round_trip)| 0.5 * seconds(round_trip)),
            streams: self
                .streams
                .iter()
                .map(|(topic, stream)| (topic.as_str(), stream.view(now, offset)))
                .collect(),
            missing,
            coverage,
            last_lap_s: self.laps().last().map(|lap| lap.time_s),
            best_lap_s: best,
            run_sheet: self.run_sheet_text().as_deref().map(plain),
            info: self.info.as_ref().map(|info| CarInfo {
                version: plain(&info.version),
                source: plain(&info.source),
                map: plain(&info.map),
                host: plain(&info.host),
                ..info.clone()
            }),
        }
    }
}

/// Text of the car, made safe to show.
fn plain(text: &str) -> String {
    plain_text(text).into_owned()
}

/// A pose, ready to be shown.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PoseView {
    /// Position in `map` \[m\].
    pub x_m: f64,
    /// Position in `map` \[m\].
    pub y_m: f64,
    /// Heading \[rad\].
    pub heading_rad: f64,
    /// Speed over ground \[m/s\].
    pub speed_mps: f64,
    /// Uncertainty.
    pub covariance: protocol::Covariance,
    /// Arc length on the raceline \[m\].
    pub s_m: Option<f64>,
    /// Distance from the raceline, left positive \[m\].
    pub d_m: Option<f64>,
    /// Laps begun.
    pub lap: u32,
    /// The filter update.
    pub update: u64,
    /// Age \[s\].
    pub age_s: f64,
}

/// The set in force, ready to be shown.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SetView {
    /// Its name.
    pub name: String,
    /// Its revision.
    pub revision: u64,
    /// The operator who put it in force.
    pub who: String,
    /// When \[unix ns, the car's clock\].
    pub when: i64,
    /// All sets on the car.
    pub available: Vec<String>,
    /// The set that the car falls back to unless this one is confirmed.
    pub reverts_to: Option<String>,
    /// Time until then \[s from now\].
    pub reverts_in_s: Option<f64>,
}
