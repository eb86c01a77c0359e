//! The state of one car.

use std::collections::BTreeMap;
use std::sync::Arc;

use protocol::{
    CarInfo, CarName, Cloud, EventKind, Header, Health, LinkReport, Load, MapReply, Message, Params, Pose,
    ScanView, Severity, Shadow, State, Telemetry, Topic, Truth,
};

use crate::analysis::{LapBook, MapCheck, PoseSample, TrackLine};
use crate::event::Rejection;
use crate::recording::missing_content;

use super::clock_estimate::ClockEstimate;
use super::history::{HealthHistory, HealthProfile, HealthSample, ProfileCell};
use super::laps::{Lap, LapTimer};
use super::limits::{LimitWatch, Limits};
use super::log::LogEntry;
use super::stream_statistics::{Freshness, StreamStatistics};

/// A car, as the pit wall knows it.
#[derive(Debug, Clone)]
#[expect(
    clippy::struct_excessive_bools,
    reason = "two are for the log, and each is a state of its own"
)]
pub struct Car {
    /// Its name.
    pub name: CarName,
    /// True while its liveliness token is there.
    pub alive: bool,
    /// When the first event about it arrived \[unix ns\].
    pub first_seen: i64,
    /// When the last message from it arrived \[unix ns\].
    pub last_heard: i64,
    /// True when the log has an entry that the link is lost, until it is back.
    pub(crate) blind_logged: bool,
    /// True while an operator has hidden it, because it is gone.
    pub(crate) dismissed: bool,
    /// The run sheet of its heat: operator and text.
    pub run_sheet: Option<(Arc<str>, Arc<str>)>,
    /// True when the log has an entry that health messages no longer come, until they do.
    pub(crate) stale_logged: bool,
    /// When it was last back after it had been BLIND \[unix ns\].
    pub(crate) back_at: i64,
    /// When a message of a second sender of this name was last dropped \[unix ns\].
    pub(crate) two_senders: Option<i64>,
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
    /// The shadow set, and how it compares.
    pub shadow: Option<Shadow>,
    /// The true pose, where it is known.
    pub truth: Option<Truth>,
    /// The map it localizes on, and its encoded bytes.
    pub map: Option<(Arc<MapReply>, Arc<[u8]>)>,
    /// The software on it.
    pub info: Option<CarInfo>,
    /// True when only the newest messages are kept, see [`Fleet::keep_only_newest`](super::Fleet::keep_only_newest).
    pub(super) only_newest: bool,
    /// Whether the full-rate poses and the full-rate health messages are shown in place of the live ones.
    complete: [bool; 2],
    /// When the recording of each run begins, by the car's clock \[unix ns\]. Laps that ended before it are left out.
    laps_since: BTreeMap<u64, i64>,
    laps: LapTimer,
    book: LapBook,
    map_check: Option<MapCheck>,
    limit_watch: LimitWatch,
    history: HealthHistory,
    health_profile: HealthProfile,
    clock: Option<ClockEstimate>,
    pub(super) streams: BTreeMap<Topic, StreamStatistics>,
    /// True when a readable message has come: there is more to it than a name.
    pub(super) heard: bool,
}

impl Car {
    /// A car that sends nothing for this long is BLIND \[ns\].
    pub const BLIND_AFTER: i64 = 1_000_000_000;
    /// A car without a health message for this long is STALE, and for longer if its messages are rare \[ns\].
    pub const STALE_AFTER: i64 = 1_500_000_000;
    /// A car of which no second sender is noticed for this long is the only one \[ns\].
    const ALONE_AFTER: i64 = 3_000_000_000;
    /// Start of a marker that is a run sheet.
    pub const RUN_SHEET: &str = "run sheet: ";
    /// A connected car that is silent for less than this has a starved link. After that, it is silent on purpose \[s\].
    const STARVED_AT_MOST: f64 = 10.0;

    /// A car of which the first event arrived at `at` \[unix ns\].
    pub fn new(name: CarName, at: i64) -> Self {
        Self {
            name,
            alive: false,
            first_seen: at,
            last_heard: at,
            blind_logged: false,
            dismissed: false,
            run_sheet: None,
            stale_logged: false,
            back_at: i64::MIN,
            two_senders: None,
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
            only_newest: false,
            complete: [false; 2],
            laps_since: BTreeMap::new(),
            laps: LapTimer::default(),
            book: LapBook::default(),
            map_check: None,
            limit_watch: LimitWatch::default(),
            history: HealthHistory::default(),
            health_profile: HealthProfile::default(),
            clock: None,
            streams: BTreeMap::new(),
            heard: false,
        }
    }

    /// Applies a message that arrived at `at` \[unix ns\]. True when it is the newest of its stream, or an event that has not
    /// arrived before.
    pub(crate) fn apply(&mut self, topic: Topic, header: &Header, telemetry: &Telemetry, at: i64) -> bool {
        self.last_heard = self.last_heard.max(at);
        let is_new = match self.streams.entry(topic).or_default().arrive(header, at) {
            Freshness::Newest => true,
            // An event is logged even when it is late.
            Freshness::Older => topic == Topic::Event,
            Freshness::Duplicate => false,
        };
        if !is_new {
            return false;
        }
        // Live, the full-rate pose is the same pose again, held back until gaps are filled: not for display.
        if matches!(telemetry, Telemetry::Pose(_) | Telemetry::Health(_)) && !self.shows(topic) {
            return true;
        }
        if !self.only_newest {
            self.analyse(header, telemetry, at);
        }
        self.keep(header, telemetry);
        true
    }

    /// Keeps the newest message of each kind.
    fn keep(&mut self, header: &Header, telemetry: &Telemetry) {
        match telemetry {
            Telemetry::Pose(pose) => self.pose = Some((*header, *pose)),
            Telemetry::Cloud(cloud) => self.cloud = Some(cloud.clone()),
            Telemetry::Scan(scan) => self.scan = Some(scan.clone()),
            Telemetry::Health(health) => self.health = Some(health.clone()),
            Telemetry::Load(load) => self.load = Some(load.clone()),
            Telemetry::Params(params) => self.params = Some(params.clone()),
            Telemetry::Shadow(shadow) => self.shadow = Some(shadow.clone()),
            Telemetry::Truth(truth) => self.truth = Some(*truth),
            Telemetry::Event(_) | Telemetry::Odometry(_) | Telemetry::RecordedScan(_) => {}
        }
    }

    /// Adds a message that arrived at `at` \[unix ns\] to the laps, the history and the map check.
    fn analyse(&mut self, header: &Header, telemetry: &Telemetry, at: i64) {
        match telemetry {
            Telemetry::Pose(pose) => {
                if let Some(sample) = PoseSample::of(header, pose) {
                    if let Some(length) = self.lap_length() {
                        self.laps.on_pose(&sample, length);
                    }
                    self.book.on_pose(&sample);
                    if let Some(check) = &mut self.map_check {
                        check.on_pose(sample.s, header.sensor);
                    }
                }
            }
            Telemetry::Scan(scan) => {
                let trusted = |health: &Health| matches!(health.state, State::Localized | State::Degraded);
                if let Some(check) = &mut self.map_check
                    && self.health.as_ref().is_some_and(trusted)
                {
                    check.on_scan(scan);
                }
            }
            Telemetry::Health(health) => {
                self.history.add(at, health);
                self.book.on_health(header.sensor, health);
                self.laps.on_health(health);
                let s = self.pose.and_then(|(_, pose)| Some(pose.track?.s));
                if let (Some(s), Some(length)) = (s, self.lap_length()) {
                    self.health_profile.add(s, length, health);
                }
            }
            Telemetry::Load(load) => self.book.on_load(load),
            Telemetry::Event(event) => {
                let since = self.laps_since.get(&header.run_id);
                let ended_before = matches!(event.kind, EventKind::Lap { .. })
                    && since.is_some_and(|since| header.sensor < *since);
                if !ended_before {
                    self.book.on_event(event);
                    self.laps.on_event(&event.kind);
                }
            }
            _ => {}
        }
    }

    /// True when the messages of a topic are shown: for poses and health, the live or the full-rate ones.
    pub(crate) fn shows(&self, topic: Topic) -> bool {
        let [poses, healths] = self.complete;
        let health = matches!(topic, Topic::Health | Topic::RecordedHealth);
        topic.recorded() == if health { healths } else { poses }
    }

    /// Sets the map that it localizes on, with its encoded bytes.
    pub(crate) fn set_map(&mut self, map: Arc<MapReply>, bytes: Arc<[u8]>) {
        if let Some(line) = TrackLine::of(&map).map(Arc::new) {
            self.book.set_line(line.clone());
            self.map_check = Some(MapCheck::new(line));
        }
        self.map = Some((map, bytes));
    }

    /// The metrics that have just gone beyond the engineer's limits, in words. `at` is the sensor's time \[ns\].
    pub(super) fn beyond_limits(&mut self, limits: &BTreeMap<String, Limits>, at: i64) -> Vec<String> {
        let Some(limits) = self.book.line().and_then(|line| limits.get(&line.key)) else {
            return Vec::new();
        };
        let mut watch = std::mem::take(&mut self.limit_watch);
        let raised = watch.check(limits, at, |channel| self.book.newest(channel));
        self.limit_watch = watch;
        let place = self
            .book
            .s()
            .map_or_else(String::new, |s| format!(" at s = {s:.1} m"));
        raised
            .into_iter()
            .map(|(channel, value, limit)| {
                let info = channel.info();
                let show = |v: f64| format!("{:.*} {}", usize::from(info.digits), v * info.factor, info.unit);
                format!(
                    "{} {} beyond the limit of {}{place}",
                    info.label,
                    show(value),
                    show(limit)
                )
            })
            .collect()
    }

    /// The run sheet of its heat, without its mark.
    pub(super) fn run_sheet_text(&self) -> Option<String> {
        let (_, text) = self.run_sheet.as_ref()?;
        Some(text.trim_start_matches(Self::RUN_SHEET).to_owned())
    }

    /// Its laps over the track.
    pub fn book(&self) -> &LapBook {
        &self.book
    }

    /// Its scans compared with the map; None without a raceline.
    pub fn map_check(&self) -> Option<&MapCheck> {
        self.map_check.as_ref()
    }

    /// The best lap \[s\]. Void laps do not count.
    pub fn best_lap(&self) -> Option<f64> {
        LapTimer::best(self.laps())
    }

    /// Laps driven, the last 500.
    pub fn laps(&self) -> &[Lap] {
        self.laps.laps()
    }

    /// Changes whenever the laps do.
    pub(crate) fn lap_changes(&self) -> u64 {
        self.laps.changes()
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

    /// Prepares a car for being read from a recording: `complete` where its full-rate streams are to be used, and when the
    /// recording of each run begins, by the car's clock \[unix ns\].
    pub(crate) fn read_from(&mut self, complete: [bool; 2], laps_since: BTreeMap<u64, i64>) {
        self.complete = complete;
        self.laps_since = laps_since;
    }

    /// Length of a lap \[m\]; None without a raceline.
    pub fn lap_length(&self) -> Option<f64> {
        let map = self.map.as_ref().and_then(|(map, _)| map.raceline.as_ref());
        map.map(|raceline| raceline.length)
            .or_else(|| self.info.as_ref().and_then(|info| info.lap_length))
            .filter(|length| *length > 0.0)
    }

    /// Notes a message that arrived at `at` \[unix ns\] and cannot be decoded, with its header if that can be. True for the
    /// first one of its topic.
    pub(crate) fn note_unreadable(&mut self, topic: Topic, header: Option<&Header>, at: i64) -> bool {
        if header.is_some() {
            self.last_heard = self.last_heard.max(at);
        }
        self.streams.entry(topic).or_default().note_unreadable(header) == 1
    }

    /// Notes messages that were dropped at `at` \[unix ns\]. Returns the entry for the log, if there should be one.
    pub(crate) fn note_rejected(
        &mut self,
        topic: Topic,
        count: u64,
        reason: Rejection,
        at: i64,
    ) -> Option<LogEntry> {
        let is_first = self.streams.entry(topic).or_default().note_rejected(count) == count;
        let (severity, text) = if reason == Rejection::TwoSenders {
            let known = self.two_senders(at);
            self.two_senders = Some(at);
            (!known).then(|| (Severity::Critical, reason.to_string()))?
        } else {
            is_first.then(|| (Severity::Warning, format!("{topic}: dropped {count} of {reason}")))?
        };
        Some(LogEntry {
            number: 0,
            at,
            car: Some(self.name.clone()),
            severity,
            kind: "identity",
            text,
            who: None,
        })
    }

    /// Messages whose content is missing, and the share of the messages sent that are here; None before the first.
    pub(super) fn coverage(&self) -> (u64, Option<f64>) {
        let streams = self.streams.iter().map(|(topic, stream)| {
            let gaps = stream.gaps();
            (*topic, gaps.received(), gaps.missing())
        });
        let missing = missing_content(streams.clone());
        let sent = streams
            .filter(|(topic, ..)| topic.recovered())
            .fold(0_u64, |sum, (_, received, missing)| {
                sum.saturating_add(received).saturating_add(missing)
            });
        (
            missing,
            (sent > 0).then(|| 1.0 - (missing as f64 / sent as f64).min(1.0)),
        )
    }

    /// Why the state is unknown although health messages arrive; None when it is known or none arrive.
    pub(super) fn why_unknown(&self) -> Option<String> {
        let stream = self.streams.get(&Topic::Health)?;
        let (version, known) = (stream.newest_unreadable()?.version, Health::VERSION);
        if version > known {
            Some(format!(
                "this pit wall is too old for the car: its health messages are of version {version}, and {known} is the \
                 newest known here; update pitwall"
            ))
        } else {
            // One damaged message is followed by the next.
            let unreadable = stream.unreadable();
            let none = self.health.is_none();
            none.then(|| format!("{unreadable} health messages arrived and none can be decoded"))
        }
    }

    /// Notes the result of a clock comparison.
    pub(crate) fn set_clock(&mut self, offset: i64, round_trip: i64, at: i64) {
        let new = ClockEstimate {
            offset,
            round_trip,
            at,
        };
        if self.clock.is_none_or(|old| new.replaces(&old)) {
            self.clock = Some(new);
        }
    }

    /// The car's clock minus the laptop's, and the round-trip time \[ns, ns\]; None before the first comparison.
    pub fn clock(&self) -> Option<(i64, i64)> {
        self.clock.map(|clock| (clock.offset, clock.round_trip))
    }

    /// The car's clock minus the laptop's \[ns\]; 0 before the first comparison.
    pub fn clock_offset(&self) -> i64 {
        self.clock.map_or(0, |clock| clock.offset)
    }

    /// The link report for the car at `now` \[unix ns\]. None before the clocks are compared, and when the car has been silent
    /// for long.
    pub fn link_report(&self, now: i64) -> Option<LinkReport> {
        let clock = self.clock?;
        let streams = || {
            [Topic::Pose, Topic::Health]
                .into_iter()
                .filter_map(|topic| self.streams.get(&topic))
        };
        let (late, poses) = streams().find_map(|stream| stream.transit(now)).or_else(|| {
            // Nothing arrives although the car is connected: the next message is at least this late.
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

    /// Time since the last health message at `now` \[ns\], if the messages have stopped; None while they come, and before the
    /// first.
    pub fn stale_for(&self, now: i64) -> Option<i64> {
        let stream = self.streams.get(&Topic::Health)?;
        // After a cut, the first health message comes a little later than the first of all.
        let silent = now - stream.last_arrival()?.max(self.back_at);
        let usual = stream
            .interval()
            .map_or(0, |interval| (3e9 * interval.min(10.0)) as i64);
        (self.alive && silent > Self::STALE_AFTER.max(usual)).then_some(silent)
    }

    /// True when two cars of this name send at `now` \[unix ns\].
    pub fn two_senders(&self, now: i64) -> bool {
        self.two_senders.is_some_and(|at| now - at < Self::ALONE_AFTER)
    }

    /// True when nothing arrives from the car at `now` \[unix ns\].
    pub fn blind(&self, now: i64) -> bool {
        !self.alive || now - self.last_heard > Self::BLIND_AFTER
    }
}
