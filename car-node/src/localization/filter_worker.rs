//! The thread that owns the localizer. It waits for sensor data and commands only. What it publishes goes into the
//! [`TelemetryQueue`](crate::telemetry::queue::TelemetryQueue), which never blocks.

use std::sync::{Arc, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, select};
use maps::{Pose, Raceline};
use protocol::{Cause, CauseKind, EventKind, Rates, SetRef, Severity};
use synpf::{Dropped, ExternalPose, Hypothesis, Localizer, Odometry, Scan, Stamp, TrackMap, Update};

use super::filter_command::{FilterCommand, LocalizerChange};
use super::job_worker::JobWorker;
use super::lap_counter::LapCounter;
use super::map_watch::MapWatch;
use super::pace::Pace;
use super::ros_feed::RosFeed;
use super::shadow_channel::{ShadowInput, ShadowScan, ShadowSender};
use super::table_worker::TableWorker;
use super::views;
use crate::health::{Monitor, Proposal, SetRecommender, SlipEvent, SlipTracker, State};
use crate::ros2::output::RosSink;
use crate::sensors::bag::SensorEvent;
use crate::sensors::clock::SensorClock;
use crate::sensors::{Feed, PoseEstimate};
use crate::telemetry::queue::{HealthReport, PoseReport, Record};
use crate::telemetry::shared_state::SharedState;
use crate::wire;

/// Everything that the thread owns from its start.
#[derive(Debug)]
pub struct FilterConfig {
    /// The localizer.
    pub localizer: Box<dyn Localizer>,
    /// The map that it localizes on.
    pub map: Arc<TrackMap>,
    /// Sets the health state after every update.
    pub monitor: Monitor,
    /// Pose of the laser on the car.
    pub base_link_from_laser: Pose,
    /// The line to measure progress and count laps on.
    pub raceline: Option<Arc<Raceline>>,
    /// The sensors' clock.
    pub clock: SensorClock,
    /// The set in force.
    pub set: SetRef,
    /// True to publish a predicted pose with every odometry message, and not only with every scan.
    pub predict: bool,
    /// State shared with the other threads.
    pub shared: Arc<SharedState>,
    /// Receives a copy of the sensor data while a shadow set runs.
    pub shadow: ShadowSender,
    /// Receives poses, health and messages for the car's own nodes.
    pub ros: Option<RosSink>,
}

/// One pace for each topic that has its own rate.
#[derive(Debug, Default)]
struct Paces {
    pose: Pace,
    cloud: Pace,
    scan: Pace,
    health: Pace,
}

/// The candidates that were last listed, with odometry's pose at that time: the car drives on while an operator chooses.
#[derive(Debug, Default)]
struct Listed {
    candidates: Vec<Hypothesis>,
    odometry: Option<Pose>,
}

/// The thread's state.
struct FilterWorker {
    config: FilterConfig,
    paces: Paces,
    laps: LapCounter,
    slip: SlipTracker,
    set_recommender: SetRecommender,
    last_update: Option<Update>,
    last_state: State,
    last_odometry: Option<Pose>,
    /// The newest pose of another localizer, for one that starts to follow it.
    last_external: Option<ExternalPose>,
    listed: Listed,
    /// Faults of sensors that an event was sent for.
    announced: Vec<CauseKind>,
    map_watch: MapWatch,
    tables: TableWorker,
    jobs: JobWorker,
    ros: RosFeed,
}

/// Health is checked at least this often, sensor data or not.
const TICK: Duration = Duration::from_millis(20);

/// Starts the thread. It ends when `feed` and `commands` have no sender left.
pub fn start(
    config: FilterConfig,
    feed: Receiver<Feed>,
    commands: Receiver<FilterCommand>,
) -> std::io::Result<JoinHandle<()>> {
    let tables = TableWorker::start(Arc::clone(&config.map))?;
    let jobs = JobWorker::start()?;
    thread::Builder::new().name("filter".into()).spawn(move || {
        let last_state = config.monitor.verdict().state;
        let ros = RosFeed::new(config.ros.clone());
        FilterWorker {
            config,
            paces: Paces::default(),
            laps: LapCounter::default(),
            slip: SlipTracker::default(),
            set_recommender: SetRecommender::default(),
            last_update: None,
            last_state,
            last_odometry: None,
            last_external: None,
            listed: Listed::default(),
            announced: Vec::new(),
            map_watch: MapWatch::default(),
            tables,
            jobs,
            ros,
        }
        .run(feed, &commands);
    })
}

impl FilterWorker {
    fn run(mut self, mut feed: Receiver<Feed>, commands: &Receiver<FilterCommand>) {
        let silence = crossbeam_channel::never::<Feed>();
        loop {
            select! {
                recv(commands) -> command => match command {
                    Ok(command) => self.execute(command),
                    Err(_) => return,
                },
                recv(feed) -> message => if let Ok(message) = message {
                    self.handle(message, feed.len());
                } else {
                    self.event(EventKind::SourceEnded);
                    feed = silence.clone();
                },
                default(TICK) => {}
            }
            self.tick();
        }
    }

    fn now(&self) -> Stamp {
        self.config.clock.now()
    }

    fn update_number(&self) -> u64 {
        self.last_update.as_ref().map_or(0, |update| update.number)
    }

    fn event(&self, kind: EventKind) {
        self.config
            .shared
            .event(self.now(), self.update_number(), kind, None, None);
    }

    /// Queues an event that the source of the sensor data caused.
    fn event_by(&self, kind: EventKind, by: &str) {
        self.config
            .shared
            .event(self.now(), self.update_number(), kind, Some(by), None);
    }

    /// The configured rates, lowered by the throttle.
    fn rates(&self) -> Rates {
        let shared = &self.config.shared;
        let wanted = *shared.rates.lock().unwrap_or_else(PoisonError::into_inner);
        let throttle = shared.throttle.lock().unwrap_or_else(PoisonError::into_inner);
        throttle.rates(wanted)
    }

    /// True when the full-rate streams are wanted: by the operator, or by the recorder on the car.
    fn records(&self) -> bool {
        self.rates().recorded || self.config.shared.recording()
    }

    /// Executes a command. A reply that nobody waits for any more is discarded.
    fn execute(&mut self, command: FilterCommand) {
        let next = self.update_number() + 1;
        match command {
            FilterCommand::SetParameters { set, change, reply } => {
                let changed = self.change_localizer(change);
                if changed.is_ok() {
                    self.config.set = set;
                }
                reply.send(changed.map(|()| next)).ok();
            }
            FilterCommand::Initialize { pose, reply } => {
                reply.send(self.initialize(pose).map(|()| next)).ok();
            }
            FilterCommand::Candidates { reply } => {
                let candidates = self.config.localizer.hypotheses();
                self.listed = Listed {
                    candidates: candidates.clone(),
                    odometry: self.last_odometry,
                };
                reply.send(candidates).ok();
            }
            FilterCommand::SelectCandidate { number, reply } => {
                let selected = self.listed_candidate(number).and_then(|pose| {
                    self.initialize(pose)?;
                    Ok((next, pose))
                });
                reply.send(selected).ok();
            }
            FilterCommand::Relocalize { reply } => {
                self.relocalize();
                reply.send(next).ok();
            }
        }
    }

    fn change_localizer(&mut self, change: LocalizerChange) -> Result<(), String> {
        let localizer = &mut self.config.localizer;
        match change {
            LocalizerChange::Tune(prepared) => localizer
                .set_parameters(prepared)
                .map_err(|_| "the set is for another kind of localizer".to_owned()),
            LocalizerChange::Replace(mut successor) => {
                successor.take_over(localizer.hand_over());
                if let Some(pose) = &self.last_external {
                    successor.on_external_pose(pose).ok();
                }
                *localizer = successor;
                self.jobs.discard();
                Ok(())
            }
        }
    }

    fn initialize(&mut self, pose: Pose) -> Result<(), String> {
        self.config
            .localizer
            .initialize(pose)
            .map_err(|error| error.to_string())?;
        let now = self.now();
        self.config.monitor.on_new_pose(now);
        self.laps.on_new_pose();
        self.forward(|| ShadowInput::PoseReset);
        Ok(())
    }

    fn relocalize(&mut self) {
        self.config.localizer.relocalize();
        let now = self.now();
        self.config.monitor.on_search(now);
        self.laps.on_new_pose();
    }

    /// The current pose of a candidate: the listed pose, moved by the odometry since then.
    fn listed_candidate(&self, number: usize) -> Result<Pose, String> {
        let Listed { candidates, odometry } = &self.listed;
        let candidate = number
            .checked_sub(1)
            .and_then(|index| candidates.get(index))
            .ok_or_else(|| match candidates.len() {
                0 => "no search has found a candidate yet".to_owned(),
                count => format!("candidate {number} of {count}"),
            })?;
        Ok(match (self.last_odometry, odometry) {
            (Some(now), Some(then)) => candidate.pose * now.since(*then),
            _ => candidate.pose,
        })
    }

    fn handle(&mut self, feed: Feed, queued: usize) {
        let event = match feed {
            Feed::Sensor(event) => event,
            Feed::Truth(truth) => {
                if self.records() {
                    self.config.shared.telemetry.record(Record::Truth(truth));
                }
                return;
            }
            Feed::Log(text) => {
                self.ros.log(self.now(), Severity::Warning, &text);
                return self.event(EventKind::Warning { text });
            }
            Feed::InitialPose { pose, by } => return self.initialize_from_source(pose, &by),
            Feed::Clock { moved, step, text } => return self.on_clock(moved, step, text),
            Feed::Mount { mount, turned, text } => {
                return self.on_mount(mount.base_link_from_laser, turned, text);
            }
            Feed::GlobalSearch { by } => {
                self.relocalize();
                let text = format!("{by}: the whole map is searched");
                self.ros.log(self.now(), Severity::Info, text);
                return self.event_by(EventKind::SearchStarted, &by);
            }
        };
        let now = self.now();
        let stamp = event.stamp();
        let counters = Arc::clone(&self.config.shared.counters);
        counters.arrived(&event, now.since(stamp), now.0 as f64 * 1e-9, queued);
        let result = match event {
            SensorEvent::Odometry(odometry) => self.on_odometry(odometry, now),
            SensorEvent::YawRate(yaw_rate) => {
                self.forward(|| ShadowInput::YawRate(yaw_rate));
                let result = self.config.localizer.on_yaw_rate(&yaw_rate);
                if self.config.shared.recording() {
                    self.config.shared.telemetry.record(Record::YawRate(yaw_rate));
                }
                result
            }
            SensorEvent::Pose(pose) => {
                self.last_external = Some(pose);
                self.forward(|| ShadowInput::Pose(pose));
                self.config.localizer.on_external_pose(&pose)
            }
            SensorEvent::Scan(scan) => self.on_scan(scan, queued),
        };
        if let Err(cause) = result {
            counters.dropped(cause);
        }
    }

    /// The laser is mounted elsewhere than was assumed. After one that was taken to be the other way up, the map is searched.
    fn on_mount(&mut self, laser: Pose, turned: bool, text: String) {
        self.config.base_link_from_laser = laser;
        self.config.shared.set_laser(laser);
        self.config.localizer.set_laser(laser);
        self.forward(|| ShadowInput::Laser(laser));
        self.ros.log(self.now(), Severity::Info, &text);
        self.event(EventKind::Warning { text });
        if turned {
            self.relocalize();
            self.event(EventKind::SearchStarted);
        }
    }

    /// The sensors' clock was set, or its reading was moved.
    fn on_clock(&mut self, moved: f64, step: Option<f64>, text: Option<String>) {
        let now = self.now();
        self.config.monitor.on_clock_moved(moved);
        if let Some(step) = step {
            self.config.monitor.on_clock_step(now, step);
        }
        if let Some(text) = text {
            self.ros.log(now, Severity::Warning, &text);
            self.event(EventKind::Warning { text });
        }
    }

    fn initialize_from_source(&mut self, pose: Pose, by: &str) {
        let before = self.last_update.as_ref().map(|update| wire::pose2(update.pose));
        let kind = match self.initialize(pose) {
            Ok(()) => {
                let (x, y, heading) = (pose.x, pose.y, pose.heading.to_degrees());
                let text = format!("{by}: initial pose taken: {x:.2}, {y:.2} m, {heading:.1} deg");
                self.ros.log(self.now(), Severity::Info, text);
                EventKind::PoseInitialized {
                    before,
                    pose: wire::pose2(pose),
                }
            }
            Err(fault) => {
                let text = format!("{by}: initial pose refused: {fault}");
                self.ros.log(self.now(), Severity::Warning, &text);
                EventKind::Warning { text }
            }
        };
        self.event_by(kind, by);
    }

    fn on_odometry(&mut self, odometry: Odometry, now: Stamp) -> Result<(), Dropped> {
        self.config.localizer.on_odometry(&odometry)?;
        self.forward(|| ShadowInput::Odometry(odometry));
        self.config.monitor.on_odometry(now);
        self.last_odometry = Some(odometry.pose);
        if self.records() {
            self.config.shared.telemetry.record(Record::Odometry(odometry));
        }
        let Some(update) = &self.last_update else {
            return Ok(());
        };
        if let Some(pose) = self.config.localizer.predict(odometry.stamp) {
            let estimate = PoseEstimate {
                stamp: odometry.stamp,
                pose,
                twist: odometry.twist,
            };
            self.ros.on_odometry(&odometry, pose, update);
            self.share(estimate);
            if self.config.predict && self.paces.pose.due(odometry.stamp, self.rates().pose) {
                let report = self.pose_report(estimate, update, true);
                self.config.shared.telemetry.pose(report);
            }
        }
        Ok(())
    }

    /// Sends an input to the shadow set, if one runs.
    fn forward(&self, input: impl FnOnce() -> ShadowInput) {
        if self.config.shadow.wanted() {
            self.config.shadow.send(input());
        }
    }

    fn on_scan(&mut self, scan: Scan, queued: usize) -> Result<(), Dropped> {
        let before = Instant::now();
        self.jobs.hand_in(self.config.localizer.as_mut());
        let result = self.config.localizer.on_scan(&scan);
        let taken = before.elapsed().as_secs_f64();
        self.tables.build_pending();
        self.jobs.take_from(self.config.localizer.as_mut());
        let now = self.now();
        let rates = self.rates();
        let update = match result {
            Ok(update) => update,
            Err(cause) => {
                self.config.monitor.on_refused_scan(now, cause);
                return Err(cause);
            }
        };
        let shared = Arc::clone(&self.config.shared);
        shared.counters.updated(taken);

        // The pose goes out first: a controller waits for it.
        let estimate = PoseEstimate {
            stamp: update.stamp,
            pose: update.pose,
            twist: update.twist,
        };
        self.ros.on_update(&update, self.config.localizer.as_ref());
        self.share(estimate);
        self.count_laps(&update);
        let report = self.pose_report(estimate, &update, false);
        let records = self.records();
        if records {
            shared.telemetry.record(Record::Pose(report.clone()));
        }
        if self.paces.pose.due(update.stamp, rates.pose) {
            shared.telemetry.pose(report);
        }

        self.config.monitor.on_sweep(scan.sweep());
        self.config.monitor.on_update(&update, now);
        self.watch_slip(&update);
        self.announce_findings();
        self.watch_map(&update, &scan);
        if self.paces.cloud.due(update.stamp, rates.cloud) {
            // Every n-th particle; their order has no meaning, so this is a fair sample.
            let particles = self.config.localizer.particles(protocol::Cloud::MAX_PARTICLES);
            shared.telemetry.cloud(views::cloud(&update, particles));
        }
        if self.paces.scan.due(update.stamp, rates.scan) {
            let laser = self.config.base_link_from_laser;
            let points = views::scan_points(&update, &scan, &self.config.map, laser);
            shared.telemetry.scan(points);
        }
        self.forward(|| {
            ShadowInput::Scan(Box::new(ShadowScan {
                scan: scan.clone(),
                update: update.clone(),
                taken,
                queued,
                set: self.config.set.clone(),
            }))
        });
        if records {
            shared.telemetry.record(Record::Scan(scan));
        }
        self.last_update = Some(update);
        self.publish_health(now, true);
        Ok(())
    }

    /// Gives the estimate to a simulated driver.
    fn share(&self, estimate: PoseEstimate) {
        let mut latest = self
            .config
            .shared
            .pose
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        *latest = Some(estimate);
    }

    fn pose_report(&self, estimate: PoseEstimate, update: &Update, predicted: bool) -> PoseReport {
        let track = self.config.raceline.as_ref().map(|line| {
            let at = line.project([estimate.pose.x, estimate.pose.y]);
            [at.s, at.d]
        });
        PoseReport {
            stamp: estimate.stamp,
            pose: estimate.pose,
            twist: estimate.twist,
            covariance: update.covariance,
            track,
            lap: self.laps.laps(),
            update: update.number,
            predicted,
        }
    }

    fn count_laps(&mut self, update: &Update) {
        let Some(line) = self.config.raceline.clone() else {
            return;
        };
        let at = line.project([update.pose.x, update.pose.y]);
        if let Some(crossing) = self.laps.on_position(update.stamp, at, &line) {
            self.event(EventKind::Lap {
                lap: crossing.ended,
                time: crossing.time,
                set: self.config.set.name.clone(),
            });
        }
    }

    fn watch_slip(&mut self, update: &Update) {
        let thresholds = *self.config.monitor.thresholds();
        match self.slip.on_update(update, &thresholds) {
            Some(SlipEvent::Started { slip }) => self.event(EventKind::SlipStarted { slip: slip as f32 }),
            Some(SlipEvent::Ended { worst, duration }) => self.event(EventKind::SlipEnded {
                worst: worst as f32,
                duration: duration as f32,
            }),
            None => {}
        }
        self.set_recommender.on_update(update, &thresholds);
        let proposal = self.set_recommender.proposal(&self.config.set.name).cloned();
        let mut advice = self
            .config
            .shared
            .advice
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        let before = advice.proposal.as_ref().map(|proposal| proposal.set.clone());
        advice.proposal.clone_from(&proposal);
        drop(advice);
        if let Some(Proposal { set, evidence, .. }) = proposal
            && before.as_ref() != Some(&set)
        {
            self.event(EventKind::Proposed { set, evidence });
        }
    }

    /// Sends an event for each fault of a sensor, the first time that it is a cause.
    fn announce_findings(&mut self) {
        let causes = &self.config.monitor.verdict().causes;
        let new: Vec<Cause> = causes
            .iter()
            .filter(|cause| cause.kind.is_sensor_fault() && !self.announced.contains(&cause.kind))
            .copied()
            .collect();
        for cause in new {
            self.announced.push(cause.kind);
            let text = cause.to_string();
            self.event(EventKind::Warning { text });
        }
    }

    /// Tells where the map differs from what a localized car sees.
    fn watch_map(&mut self, update: &Update, scan: &Scan) {
        if self.config.monitor.verdict().state != State::Localized {
            return;
        }
        let laser = update.pose * self.config.base_link_from_laser;
        let stretches = self.map_watch.on_scan(scan, laser, &self.config.map);
        if stretches.is_empty() {
            return;
        }
        self.config.monitor.on_map_differs(self.map_watch.found());
        for stretch in stretches {
            let text = stretch.to_string();
            self.event(EventKind::Warning { text });
        }
    }

    fn tick(&mut self) {
        let now = self.now();
        self.config.monitor.tick(now);
        self.publish_health(now, false);
    }

    /// Publishes health: every update to the recorder, and at its rate or on a change to the pit wall.
    fn publish_health(&mut self, now: Stamp, updated: bool) {
        let rates = self.rates();
        let verdict = self.config.monitor.verdict();
        let state = verdict.state;
        let changed = state != self.last_state;
        let live = self.paces.health.due(now, rates.health) || changed;
        let recorded = updated && self.records();
        let kinds = verdict.causes.iter().map(|cause| cause.kind);
        let for_ros = self.ros.wants_health(now, state, kinds);
        if !live && !recorded && !for_ros {
            return;
        }
        let verdict = self.config.monitor.verdict().clone();
        if changed {
            self.event(EventKind::StateChanged {
                from: self.last_state,
                to: state,
                causes: verdict.causes.clone(),
            });
            self.last_state = state;
        }
        let advice = self
            .config
            .shared
            .advice
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .clone();
        let report = HealthReport {
            stamp: now,
            verdict,
            proposal: advice.proposal,
            auto: advice.auto,
        };
        if for_ros {
            self.ros.health(report.clone());
        }
        if live || recorded {
            self.config.shared.telemetry.record(Record::Health {
                report,
                live,
                recorded,
            });
        }
    }
}
