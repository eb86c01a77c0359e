//! What the pit wall knows of one car.

use std::collections::BTreeMap;
use std::sync::Arc;

use protocol::{
    CarInfo, CarName, Cloud, EventKind, Header, Health, LinkReport, Load, MapReply, Message, Params, Pose,
    ScanView, Shadow, State, Telemetry, Topic, Truth,
};
use serde::Serialize;

use super::history::{HealthHistory, HealthProfile, HealthSample, ProfileCell};
use super::laps::{Lap, LapTimer, TrackPose};
use super::stream_statistics::{Freshness, StreamStatistics, StreamView};

/// A car as the pit wall sees it.
#[derive(Debug, Clone)]
pub struct Car {
    /// Its name.
    pub name: CarName,
    /// True while its liveliness token is there.
    pub alive: bool,
    /// When it was first heard of [unix ns].
    pub first_seen: i64,
    /// When anything of it last arrived [unix ns].
    pub last_heard: i64,
    /// True once the log has said that the link is gone, until it is back.
    pub(crate) blind_said: bool,
    /// The newest pose.
    pub pose: Option<(Header, Pose)>,
    /// The newest cloud.
    pub cloud: Option<Cloud>,
    /// The newest end points.
    pub scan: Option<ScanView>,
    /// The newest health.
    pub health: Option<Health>,
    /// The newest load.
    pub load: Option<Load>,
    /// The set in force.
    pub params: Option<Params>,
    /// The set that runs in the shadow, and how it compares.
    pub shadow: Option<Shadow>,
    /// Where it really is, where that is known.
    pub truth: Option<Truth>,
    /// The map it localizes on, and the bytes that it came in.
    pub map: Option<(Arc<MapReply>, Arc<[u8]>)>,
    /// What runs on it.
    pub info: Option<CarInfo>,
    laps: LapTimer,
    history: HealthHistory,
    health_profile: HealthProfile,
    clock: Option<ClockEstimate>,
    streams: BTreeMap<Topic, StreamStatistics>,
}

/// How far the car's clock is ahead of the laptop's.
#[derive(Debug, Clone, Copy, PartialEq)]
struct ClockEstimate {
    offset: i64,
    round_trip: i64,
    at: i64,
}

impl ClockEstimate {
    /// An exchange of shorter round trip is believed over this one for so long [ns].
    const KEEP: i64 = 30_000_000_000;
}

impl Car {
    /// A car not heard of for this long is out of sight [ns].
    pub const BLIND_AFTER: i64 = 1_000_000_000;
    /// A car that is there and is heard again within this time is on a starved link, and not silent on purpose [s].
    const STARVED_AT_MOST: f64 = 10.0;

    /// A car first heard of at `at` [unix ns].
    pub fn new(name: CarName, at: i64) -> Self {
        Self {
            name,
            alive: false,
            first_seen: at,
            last_heard: at,
            blind_said: false,
            pose: None,
            cloud: None,
            scan: None,
            health: None,
            load: None,
            params: None,
            shadow: None,
            truth: None,
            map: None,
            info: None,
            laps: LapTimer::default(),
            history: HealthHistory::default(),
            health_profile: HealthProfile::default(),
            clock: None,
            streams: BTreeMap::new(),
        }
    }

    /// Takes in a message that arrived at `at` [unix ns]. True when it was news: the newest of its stream, or an event that
    /// has not come before.
    pub(crate) fn take(&mut self, topic: Topic, header: &Header, telemetry: &Telemetry, at: i64) -> bool {
        self.last_heard = self.last_heard.max(at);
        let news = match self.streams.entry(topic).or_default().arrive(header, at) {
            Freshness::Newest => true,
            // Better told late than never.
            Freshness::Older => topic == Topic::Event,
            Freshness::Duplicate => false,
        };
        if !news {
            return false;
        }
        match telemetry {
            // The full-rate pose is the same pose again, held back until gaps are filled: not for display.
            Telemetry::Pose(_) | Telemetry::Health(_) if topic.recorded() => {}
            Telemetry::Pose(pose) => {
                self.pose = Some((*header, *pose));
                if let (Some(track), Some(length)) = (pose.track, self.lap_length()) {
                    let here = TrackPose {
                        at: header.sensor,
                        s: track.s,
                        d: track.d,
                        lap: pose.lap,
                    };
                    self.laps.on_pose(here, length);
                }
            }
            Telemetry::Cloud(cloud) => self.cloud = Some(cloud.clone()),
            Telemetry::Scan(scan) => self.scan = Some(scan.clone()),
            Telemetry::Health(health) => {
                self.history.take(at, health);
                if let Some(metrics) = &health.metrics {
                    self.laps.on_metrics(metrics);
                }
                let s = self.pose.and_then(|(_, pose)| Some(pose.track?.s));
                if let (Some(s), Some(length)) = (s, self.lap_length()) {
                    self.health_profile.take(s, length, health);
                }
                self.health = Some(health.clone());
            }
            Telemetry::Load(load) => self.load = Some(load.clone()),
            Telemetry::Params(params) => self.params = Some(params.clone()),
            Telemetry::Shadow(shadow) => self.shadow = Some(shadow.clone()),
            Telemetry::Truth(truth) => self.truth = Some(*truth),
            Telemetry::Event(event) => {
                if let EventKind::Lap {
                    lap,
                    time: Some(time),
                    set,
                } = &event.kind
                {
                    self.laps.on_lap(*lap, *time, set);
                }
            }
            Telemetry::Odometry(_) | Telemetry::RecordedScan(_) => {}
        }
        true
    }

    /// Laps driven, the last 500.
    pub fn laps(&self) -> &[Lap] {
        self.laps.laps()
    }

    /// The last two minutes of health, the oldest first.
    pub fn history(&self) -> impl Iterator<Item = &HealthSample> {
        self.history.samples()
    }

    /// Health along the lap, the last time the car was there: cells of equal length from the start line on. Empty
    /// without a raceline.
    pub fn health_profile(&self) -> &[Option<ProfileCell>] {
        self.health_profile.cells()
    }

    /// Length of a lap [m]; None without a raceline.
    pub fn lap_length(&self) -> Option<f64> {
        let map = self.map.as_ref().and_then(|(map, _)| map.raceline.as_ref());
        map.map(|raceline| raceline.length)
            .or_else(|| self.info.as_ref().and_then(|info| info.lap_length))
            .filter(|length| *length > 0.0)
    }

    /// Takes note of bytes that could not be read, and of the header before them, if there was one, which arrived at `at`
    /// [unix ns]. True for the first of their topic.
    pub(crate) fn refuse(&mut self, topic: Topic, header: Option<&Header>, at: i64) -> bool {
        if header.is_some() {
            self.last_heard = self.last_heard.max(at);
        }
        self.streams.entry(topic).or_default().refuse(header) == 1
    }

    /// Why the car's state is not known although it tells it; None when it does not, or the state is known.
    fn not_understood(&self) -> Option<String> {
        let stream = self.streams.get(&Topic::Health)?;
        let (version, known) = (stream.refused()?.version, Health::VERSION);
        if version > known {
            Some(format!(
                "this pit wall is too old for the car: its health messages are of version {version}, and {known} is the \
                 newest known here; update pitwall"
            ))
        } else {
            // One that was damaged on its way is followed by the next.
            let unreadable = stream.unreadable();
            let none = self.health.is_none();
            none.then(|| format!("no health message that can be read, of {unreadable} that came"))
        }
    }

    /// Takes note of a comparison of clocks.
    pub(crate) fn set_clock(&mut self, offset: i64, round_trip: i64, at: i64) {
        let better = self
            .clock
            .is_none_or(|old| round_trip <= old.round_trip || at - old.at > ClockEstimate::KEEP);
        if better {
            self.clock = Some(ClockEstimate {
                offset,
                round_trip,
                at,
            });
        }
    }

    /// What must be added to the laptop's clock to get the car's, and the round-trip time [ns, ns]; None until they
    /// were compared.
    pub fn clock(&self) -> Option<(i64, i64)> {
        self.clock.map(|clock| (clock.offset, clock.round_trip))
    }

    /// What must be added to the laptop's clock to get the car's [ns]; 0 until they were compared.
    pub fn clock_offset(&self) -> i64 {
        self.clock.map_or(0, |clock| clock.offset)
    }

    /// What this pit wall has to tell the car of its link at `now` [unix ns]; None while clocks are not compared, and when
    /// nothing has come for long, as on purpose.
    pub fn link_report(&self, now: i64) -> Option<LinkReport> {
        let clock = self.clock?;
        let streams = || {
            [Topic::Pose, Topic::Health]
                .into_iter()
                .filter_map(|topic| self.streams.get(&topic))
        };
        let (late, poses) = streams().find_map(|stream| stream.transit(now)).or_else(|| {
            // Nothing comes, but for signs of life: at least that late is what will.
            let newest = streams()
                .filter_map(StreamStatistics::newest)
                .map(|header| header.published)
                .max()?;
            let late = (now - newest) as f64 * 1e-9;
            (self.alive && late < Self::STARVED_AT_MOST).then_some((late, 0))
        })?;
        Some(LinkReport {
            transit: (late + clock.offset as f64 * 1e-9) as f32,
            uncertainty: (clock.round_trip as f64 * 0.5e-9) as f32,
            poses: u32::try_from(poses).unwrap_or(u32::MAX),
        })
    }

    /// True when nothing comes from the car at `now` [unix ns].
    pub fn blind(&self, now: i64) -> bool {
        !self.alive || now - self.last_heard > Self::BLIND_AFTER
    }

    /// The car at `now` [unix ns].
    pub fn view(&self, now: i64) -> CarView {
        let seconds = |ns: i64| ns as f64 * 1e-9;
        let offset = self.clock_offset();
        let blind = self.blind(now);
        let quiet_s = seconds(now - self.last_heard).max(0.0);
        let not_understood = self.not_understood();
        // What it last said that could be read may be of long ago.
        let health = self.health.as_ref().filter(|_| not_understood.is_none());
        let (state, causes) = match health {
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
            None => match not_understood {
                Some(why) => ("UNKNOWN".to_owned(), vec![why]),
                None => (State::Init.to_string(), vec!["no health message yet".to_owned()]),
            },
            Some(health) => (
                health.state.to_string(),
                health.causes.iter().map(ToString::to_string).collect(),
            ),
        };
        let best = self.laps().iter().map(|lap| lap.time_s).min_by(f64::total_cmp);
        CarView {
            car: self.name.clone(),
            state,
            causes,
            state_for_s: health.map(|health| seconds(now + offset - health.since).max(0.0)),
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
                name: params.set.name.clone(),
                revision: params.revision,
                who: params.who.clone(),
                when: params.when,
                available: params.available.clone(),
                reverts_to: params.pending_revert.as_ref().map(|revert| revert.to.clone()),
                reverts_in_s: params
                    .pending_revert
                    .as_ref()
                    .map(|revert| seconds(revert.at - now - offset).max(0.0)),
            }),
            shadow: self.shadow.clone().filter(|shadow| shadow.set.is_some()),
            health: health.cloned(),
            load: self.load.clone(),
            round_trip_s: self.clock.map(|clock| seconds(clock.round_trip)),
            clock_offset_s: self.clock.map(|clock| seconds(clock.offset)),
            clock_uncertainty_s: self.clock.map(|clock| 0.5 * seconds(clock.round_trip)),
            streams: self
                .streams
                .iter()
                .map(|(topic, stream)| (topic.as_str(), stream.view(now, offset)))
                .collect(),
            last_lap_s: self.laps().last().map(|lap| lap.time_s),
            best_lap_s: best,
            info: self.info.clone(),
        }
    }
}

/// A car, ready to be shown or written as JSON.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CarView {
    /// Its name.
    pub car: CarName,
    /// The state in capitals: one of the car's own, `BLIND` when nothing comes from it, or `UNKNOWN` when what it says of
    /// its state cannot be read here.
    pub state: String,
    /// Why, in words, the worst first.
    pub causes: Vec<String>,
    /// How long the car's own state has lasted [s].
    pub state_for_s: Option<f64>,
    /// True when nothing comes from the car: everything below is old.
    pub blind: bool,
    /// True while the car's node is known to run.
    pub alive: bool,
    /// Time since anything arrived [s].
    pub quiet_s: f64,
    /// The newest pose.
    pub pose: Option<PoseView>,
    /// The parameter set in force.
    pub set: Option<SetView>,
    /// The set in the shadow and how it compares; None without one.
    pub shadow: Option<Shadow>,
    /// The newest health message.
    pub health: Option<Health>,
    /// The newest load message.
    pub load: Option<Load>,
    /// Round-trip time to the car [s].
    pub round_trip_s: Option<f64>,
    /// How far the car's clock is ahead of this one [s].
    pub clock_offset_s: Option<f64>,
    /// How far that may be off: half the round-trip time, all of which may have been spent one way [s].
    pub clock_uncertainty_s: Option<f64>,
    /// Every stream by topic.
    pub streams: BTreeMap<&'static str, StreamView>,
    /// The last lap [s].
    pub last_lap_s: Option<f64>,
    /// The best lap [s].
    pub best_lap_s: Option<f64>,
    /// What runs on the car.
    pub info: Option<CarInfo>,
}

/// A pose, ready to be shown.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PoseView {
    /// Position in `map` [m].
    pub x_m: f64,
    /// Position in `map` [m].
    pub y_m: f64,
    /// Heading [rad].
    pub heading_rad: f64,
    /// Speed over ground [m/s].
    pub speed_mps: f64,
    /// Uncertainty.
    pub covariance: protocol::Covariance,
    /// Arc length on the raceline [m].
    pub s_m: Option<f64>,
    /// Distance from the raceline, left positive [m].
    pub d_m: Option<f64>,
    /// Laps begun.
    pub lap: u32,
    /// The filter update.
    pub update: u64,
    /// Time since it was true [s].
    pub age_s: f64,
}

/// The set in force, ready to be shown.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SetView {
    /// Its name.
    pub name: String,
    /// Its revision.
    pub revision: u64,
    /// Who put it in force.
    pub who: String,
    /// When [unix ns, the car's clock].
    pub when: i64,
    /// All sets on the car.
    pub available: Vec<String>,
    /// The set that the car falls back to unless this one is confirmed.
    pub reverts_to: Option<String>,
    /// When it does [s from now].
    pub reverts_in_s: Option<f64>,
}
