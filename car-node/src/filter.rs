//! The thread that owns the localizer. It waits for sensor data and orders, and for nothing else: what it has
//! to say goes into the [`Outbox`], where it never has to wait.

use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Sender, select};
use maps::{Pose, Raceline};
use protocol::{CommandId, EventKind, Rates, SetRef};
use synpf::{Hypothesis, Localizer, Mode, Odometry, Scan, Stamp, SynPf, Tuning, Update, WeightedPose};

use crate::bag::SensorEvent;
use crate::clock::SensorClock;
use crate::counters::Counters;
use crate::health::{Monitor, SlipEvent, SlipTracker, State};
use crate::laps::LapCounter;
use crate::outbox::{CloudSample, Fit, Happening, HealthReport, Outbox, PoseEstimate, Record, ScanPoints};
use crate::proposal::{Advisor, Proposal};
use crate::shadow::{Note, Sample, Tap};
use crate::source::{Belief, Feed, SharedBelief};
use crate::throttle::Throttle;
use crate::wire;

/// Something to do between two updates. The answer to each names the first update that it holds for.
#[derive(Debug)]
pub enum Order {
    /// Swap the parameter set.
    SetParameters {
        /// The set, for proposals, laps and the shadow.
        set: SetRef,
        /// The set, made ready.
        tuning: Box<Tuning>,
        /// Where the answer goes.
        answer: Sender<u64>,
    },
    /// Start again from a pose.
    Initialize {
        /// `map_from_base_link`.
        pose: Pose,
        /// Where the answer goes.
        answer: Sender<Result<u64, String>>,
    },
    /// Search the whole map.
    Relocalize {
        /// Where the answer goes.
        answer: Sender<u64>,
    },
    /// Tell what a search has found so far, the best first.
    Candidates {
        /// Where the answer goes.
        answer: Sender<Vec<Hypothesis>>,
    },
    /// Follow one of the candidates that were last told, counted from 1.
    Pick {
        /// Which.
        number: usize,
        /// Where the answer goes: the update, and where the car is taken to be.
        answer: Sender<Result<(u64, Pose), String>>,
    },
}

/// What other threads and the filter tell each other without waiting.
#[derive(Debug)]
pub struct Shared {
    /// What goes out.
    pub outbox: Outbox,
    /// What the load meter reads.
    pub counters: Arc<Counters>,
    /// How often to send what.
    pub rates: Mutex<Rates>,
    /// The set that the car would rather use, and whether it may switch by itself.
    pub advice: Mutex<Advice>,
    /// What the car believes, for a simulated driver.
    pub belief: SharedBelief,
    /// What pit walls say of the link, and whether less is sent for it.
    pub throttle: Mutex<Throttle>,
    /// Name of the set in the shadow: the desk begins it, the shadow's thread may drop it.
    pub shadow: Mutex<Option<String>>,
}

impl Default for Shared {
    fn default() -> Self {
        Self {
            outbox: Outbox::default(),
            counters: Arc::default(),
            rates: Mutex::new(DEFAULT_RATES),
            advice: Mutex::default(),
            belief: SharedBelief::default(),
            throttle: Mutex::default(),
            shadow: Mutex::default(),
        }
    }
}

/// How often a car sends what unless told otherwise: every pose, the rest as fast as people can see.
pub const DEFAULT_RATES: Rates = Rates {
    pose: Rates::MAX,
    cloud: 10.0,
    scan: 10.0,
    health: 10.0,
    recorded: true,
};

/// Between the filter, which proposes, and the desk, which decides.
#[derive(Debug, Clone, Default)]
pub struct Advice {
    /// The set that the car would rather use.
    pub proposal: Option<Proposal>,
    /// The desk may follow it by itself.
    pub auto: bool,
}

impl Shared {
    /// Notes which set runs in the shadow; returns the one before it.
    pub fn set_shadow(&self, name: Option<String>) -> Option<String> {
        let mut shadow = self.shadow.lock().unwrap_or_else(PoisonError::into_inner);
        std::mem::replace(&mut *shadow, name)
    }

    /// Leaves an event.
    pub fn event(
        &self,
        stamp: Stamp,
        update: u64,
        kind: EventKind,
        who: Option<&str>,
        command: Option<CommandId>,
    ) {
        self.outbox.record(Record::Event(Happening {
            stamp,
            update,
            who: who.map(str::to_owned),
            command,
            kind,
        }));
    }
}

/// Everything that the thread owns.
#[derive(Debug)]
pub struct Filter {
    /// The filter itself.
    pub localizer: SynPf,
    /// What it is worth.
    pub monitor: Monitor,
    /// Where the laser is.
    pub base_link_from_laser: Pose,
    /// The line to count laps on.
    pub raceline: Option<Arc<Raceline>>,
    /// The sensors' time.
    pub clock: SensorClock,
    /// The set in force.
    pub set: SetRef,
    /// Send a pose with every odometry message, predicted, and not only with every scan.
    pub predict: bool,
    /// Where everything goes.
    pub shared: Arc<Shared>,
    /// What was taken, for a set in the shadow.
    pub tap: Tap,
    /// Who on the car gets every belief of a car that knows where it is, such as its controller.
    pub follower: Option<Sender<Belief>>,
}

/// What happens at its own pace, on the sensors' clock.
#[derive(Debug, Default)]
struct Pace {
    next: Option<Stamp>,
}

impl Pace {
    /// True when something at `rate` [Hz] is due, which counts as having done it.
    fn due(&mut self, now: Stamp, rate: f32) -> bool {
        if rate <= 0.0 {
            return false;
        }
        let period = 1.0 / f64::from(rate);
        // A little early is due as well: at 40 scans a second, every fourth is 10 Hz, jitter or not.
        if self.next.is_some_and(|next| now.since(next) < -0.2 * period) {
            return false;
        }
        let next = self.next.unwrap_or(now).plus(period);
        // After a pause the pace begins anew rather than catching up.
        self.next = Some(if next <= now { now.plus(period) } else { next });
        true
    }
}

#[derive(Debug, Default)]
struct Paces {
    pose: Pace,
    cloud: Pace,
    scan: Pace,
    health: Pace,
}

/// The loop's own state beside the filter's.
struct Loop {
    filter: Filter,
    paces: Paces,
    laps: LapCounter,
    slip: SlipTracker,
    advisor: Advisor,
    last_update: Option<Update>,
    last_state: State,
    last_odometry: Option<Pose>,
    /// What was last told of a search, and odometry's pose then: the car drives on while somebody chooses.
    candidates: (Vec<Hypothesis>, Option<Pose>),
}

/// Silence is looked at this often.
const TICK: Duration = Duration::from_millis(20);

/// Starts the thread. It ends when `feed` and `orders` have no sender left.
pub fn start(
    filter: Filter,
    feed: Receiver<Feed>,
    orders: Receiver<Order>,
) -> std::io::Result<JoinHandle<()>> {
    thread::Builder::new().name("filter".into()).spawn(move || {
        let last_state = filter.monitor.verdict().state;
        Loop {
            filter,
            paces: Paces::default(),
            laps: LapCounter::default(),
            slip: SlipTracker::default(),
            advisor: Advisor::default(),
            last_update: None,
            last_state,
            last_odometry: None,
            candidates: (Vec::new(), None),
        }
        .run(feed, &orders);
    })
}

impl Loop {
    fn run(mut self, mut feed: Receiver<Feed>, orders: &Receiver<Order>) {
        let silence = crossbeam_channel::never::<Feed>();
        loop {
            select! {
                recv(orders) -> order => match order {
                    Ok(order) => self.obey(order),
                    Err(_) => return,
                },
                recv(feed) -> message => if let Ok(message) = message {
                    self.take_in(message, feed.len());
                } else {
                    self.event(EventKind::SourceEnded);
                    feed = silence.clone();
                },
                default(TICK) => {}
            }
            self.look_at_health();
        }
    }

    fn now(&self) -> Stamp {
        self.filter.clock.now()
    }

    fn update_number(&self) -> u64 {
        self.last_update.as_ref().map_or(0, |update| update.number)
    }

    fn event(&self, kind: EventKind) {
        self.filter
            .shared
            .event(self.now(), self.update_number(), kind, None, None);
    }

    fn rates(&self) -> Rates {
        let shared = &self.filter.shared;
        let wanted = *shared.rates.lock().unwrap_or_else(PoisonError::into_inner);
        let throttle = shared.throttle.lock().unwrap_or_else(PoisonError::into_inner);
        throttle.rates(wanted)
    }

    fn obey(&mut self, order: Order) {
        let next = self.update_number() + 1;
        let now = self.now();
        // An answer that nobody waits for any more is nobody's loss.
        match order {
            Order::SetParameters { set, tuning, answer } => {
                self.filter.localizer.tune(*tuning);
                self.filter.set = set;
                answer.send(next).ok();
            }
            Order::Initialize { pose, answer } => {
                answer.send(self.initialize(pose).map(|()| next)).ok();
            }
            Order::Candidates { answer } => {
                let found = self.filter.localizer.hypotheses();
                self.candidates = (found.clone(), self.last_odometry);
                answer.send(found).ok();
            }
            Order::Pick { number, answer } => {
                let picked = self.picked(number).and_then(|pose| {
                    self.initialize(pose)?;
                    Ok((next, pose))
                });
                answer.send(picked).ok();
            }
            Order::Relocalize { answer } => {
                self.filter.localizer.relocalize();
                self.filter.monitor.on_search(now);
                self.laps.on_new_pose();
                answer.send(next).ok();
            }
        }
    }

    fn initialize(&mut self, pose: Pose) -> Result<(), String> {
        self.filter
            .localizer
            .initialize(pose)
            .map_err(|error| error.to_string())?;
        let now = self.now();
        self.filter.monitor.on_new_pose(now);
        self.laps.on_new_pose();
        self.hand_on(|| Note::Placed);
        Ok(())
    }

    /// Where a candidate is by now.
    fn picked(&self, number: usize) -> Result<Pose, String> {
        let (candidates, odometry_then) = &self.candidates;
        let candidate = number
            .checked_sub(1)
            .and_then(|index| candidates.get(index))
            .ok_or_else(|| match candidates.len() {
                0 => "no search has found a candidate yet".to_owned(),
                count => format!("candidate {number} of {count}"),
            })?;
        Ok(match (self.last_odometry, odometry_then) {
            (Some(now), Some(then)) => candidate.pose * now.since(*then),
            _ => candidate.pose,
        })
    }

    fn take_in(&mut self, feed: Feed, queued: usize) {
        let event = match feed {
            Feed::Sensor(event) => event,
            Feed::Truth(truth) => {
                if self.rates().recorded {
                    self.filter.shared.outbox.record(Record::Truth(truth));
                }
                return;
            }
            Feed::Word(text) => return self.event(EventKind::Warning { text }),
            Feed::Placed(pose) => return self.placed(pose),
        };
        let now = self.now();
        let stamp = event.stamp();
        let counters = Arc::clone(&self.filter.shared.counters);
        counters.arrived(&event, now.since(stamp), now.0 as f64 * 1e-9, queued);
        let result = match event {
            SensorEvent::Odometry(odometry) => self.on_odometry(odometry, now),
            SensorEvent::YawRate(yaw_rate) => {
                self.hand_on(|| Note::YawRate(yaw_rate));
                self.filter.localizer.on_yaw_rate(&yaw_rate)
            }
            SensorEvent::Scan(scan) => self.on_scan(scan, queued),
        };
        if let Err(cause) = result {
            counters.dropped(cause);
        }
    }

    fn placed(&mut self, pose: Pose) {
        let before = self.last_update.as_ref().map(|update| wire::pose2(update.pose));
        if self.initialize(pose).is_ok() {
            self.event(EventKind::PoseInitialized {
                before,
                pose: wire::pose2(pose),
            });
        }
    }

    fn on_odometry(&mut self, odometry: Odometry, now: Stamp) -> Result<(), synpf::Dropped> {
        self.filter.localizer.on_odometry(&odometry)?;
        self.hand_on(|| Note::Odometry(odometry));
        self.filter.monitor.on_odometry(now);
        self.last_odometry = Some(odometry.pose);
        if self.rates().recorded {
            self.filter.shared.outbox.record(Record::Odometry(odometry));
        }
        let Some(update) = &self.last_update else {
            return Ok(());
        };
        if let Some(pose) = self.filter.localizer.predict(odometry.stamp) {
            let belief = Belief {
                stamp: odometry.stamp,
                pose,
                twist: odometry.twist,
            };
            self.believe(belief, update.mode);
            if self.filter.predict && self.paces.pose.due(odometry.stamp, self.rates().pose) {
                let estimate = self.estimate(belief, update, true);
                self.filter.shared.outbox.pose(estimate);
            }
        }
        Ok(())
    }

    /// For the shadow, if there is one.
    fn hand_on(&self, note: impl FnOnce() -> Note) {
        if self.filter.tap.wanted() {
            self.filter.tap.hand_on(note());
        }
    }

    fn on_scan(&mut self, scan: Scan, queued: usize) -> Result<(), synpf::Dropped> {
        let before = Instant::now();
        let result = self.filter.localizer.on_scan(&scan);
        let taken = before.elapsed().as_secs_f64();
        let now = self.now();
        let rates = self.rates();
        let update = match result {
            Ok(update) => update,
            Err(cause) => {
                self.filter.monitor.on_refused_scan(now);
                return Err(cause);
            }
        };
        let shared = Arc::clone(&self.filter.shared);
        shared.counters.updated(taken);

        // The pose first: it is what somebody waits for.
        let belief = Belief {
            stamp: update.stamp,
            pose: update.pose,
            twist: update.twist,
        };
        self.believe(belief, update.mode);
        self.count_laps(&update);
        let estimate = self.estimate(belief, &update, false);
        if rates.recorded {
            shared.outbox.record(Record::Pose(estimate.clone()));
        }
        if self.paces.pose.due(update.stamp, rates.pose) {
            shared.outbox.pose(estimate);
        }

        self.filter.monitor.on_update(&update, now);
        self.watch_slip(&update);
        if self.paces.cloud.due(update.stamp, rates.cloud) {
            shared.outbox.cloud(self.cloud(&update));
        }
        if self.paces.scan.due(update.stamp, rates.scan) {
            shared.outbox.scan(self.scan_points(&update, &scan));
        }
        self.hand_on(|| {
            Note::Scan(Box::new(Sample {
                scan: scan.clone(),
                update: update.clone(),
                taken,
                queued,
                set: self.filter.set.clone(),
            }))
        });
        if rates.recorded {
            shared.outbox.record(Record::Scan(scan));
        }
        self.last_update = Some(update);
        self.tell_health(now, true);
        Ok(())
    }

    fn believe(&self, belief: Belief, mode: Mode) {
        // Who does not keep up misses some; the next one is better anyway.
        if mode == Mode::Tracking
            && let Some(follower) = &self.filter.follower
        {
            follower.try_send(belief).ok();
        }
        *self
            .filter
            .shared
            .belief
            .lock()
            .unwrap_or_else(PoisonError::into_inner) = Some(belief);
    }

    fn estimate(&self, belief: Belief, update: &Update, predicted: bool) -> PoseEstimate {
        let track = self.filter.raceline.as_ref().map(|line| {
            let at = line.project([belief.pose.x, belief.pose.y]);
            [at.s, at.d]
        });
        PoseEstimate {
            stamp: belief.stamp,
            pose: belief.pose,
            twist: belief.twist,
            covariance: update.covariance,
            track,
            lap: self.laps.laps(),
            update: update.number,
            predicted,
        }
    }

    fn count_laps(&mut self, update: &Update) {
        let Some(line) = self.filter.raceline.clone() else {
            return;
        };
        let at = line.project([update.pose.x, update.pose.y]);
        if let Some(crossing) = self.laps.on_position(update.stamp, at, &line) {
            self.event(EventKind::Lap {
                lap: crossing.ended,
                time: crossing.time,
                set: self.filter.set.name.clone(),
            });
        }
    }

    fn watch_slip(&mut self, update: &Update) {
        let thresholds = *self.filter.monitor.thresholds();
        match self.slip.on_update(update, &thresholds) {
            Some(SlipEvent::Started { slip }) => self.event(EventKind::SlipStarted { slip: slip as f32 }),
            Some(SlipEvent::Ended { worst, duration }) => self.event(EventKind::SlipEnded {
                worst: worst as f32,
                duration: duration as f32,
            }),
            None => {}
        }
        self.advisor.on_update(update, &thresholds);
        let proposal = self.advisor.proposal(&self.filter.set.name).cloned();
        let mut advice = self
            .filter
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

    fn look_at_health(&mut self) {
        let now = self.now();
        self.filter.monitor.tick(now);
        self.tell_health(now, false);
    }

    /// Sends health on every update for the recorder, and at its rate or on a change for the pit wall.
    fn tell_health(&mut self, now: Stamp, updated: bool) {
        let rates = self.rates();
        let state = self.filter.monitor.verdict().state;
        let changed = state != self.last_state;
        let live = self.paces.health.due(now, rates.health) || changed;
        let recorded = updated && rates.recorded;
        if !live && !recorded {
            return;
        }
        let verdict = self.filter.monitor.verdict().clone();
        if changed {
            self.event(EventKind::StateChanged {
                from: self.last_state,
                to: state,
                causes: verdict.causes.clone(),
            });
            self.last_state = state;
        }
        let advice = self
            .filter
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
        self.filter.shared.outbox.record(Record::Health {
            report,
            live,
            recorded,
        });
    }

    fn cloud(&self, update: &Update) -> CloudSample {
        // Every n-th particle: they are in no order, so that this is a fair sample.
        let step = update.particles.div_ceil(protocol::Cloud::MAX_PARTICLES).max(1);
        let particles: Vec<WeightedPose> = self.filter.localizer.particles().step_by(step).collect();
        CloudSample {
            stamp: update.stamp,
            update: update.number,
            centre: update.pose,
            count: update.particles,
            ess_ratio: update.ess_ratio,
            spread: update.spread,
            second_mode: update.second_mode,
            particles,
        }
    }

    fn scan_points(&self, update: &Update, scan: &Scan) -> ScanPoints {
        let map = self.filter.localizer.map();
        let map_from_laser = update.pose * self.filter.base_link_from_laser;
        let step = scan.ranges.len().div_ceil(protocol::ScanView::MAX_POINTS).max(1);
        let points = scan
            .ranges
            .iter()
            .enumerate()
            .step_by(step)
            .map(|(beam, range)| (beam, f64::from(*range)))
            .filter(|(_, range)| (scan.range_min..scan.range_max).contains(range))
            .map(|(beam, range)| {
                let angle = scan.angle_min + scan.angle_increment * beam as f64;
                let (sin, cos) = angle.sin_cos();
                let point = map_from_laser.transform([range * cos, range * sin]);
                let expected = map.range(map_from_laser * Pose::new(0.0, 0.0, angle), scan.range_max);
                (point, fit(map.distance(point), range - expected))
            })
            .collect();
        ScanPoints {
            stamp: update.stamp,
            update: update.number,
            centre: [map_from_laser.x, map_from_laser.y],
            points,
        }
    }
}

/// How an end point so far from a wall [m], and so much longer than the map says [m], compares with the map.
/// The limits are those of alignment and of long and short beams.
fn fit(distance: f64, longer: f64) -> Fit {
    if distance.abs() < 0.10 {
        Fit::OnWall
    } else if longer > 0.3 {
        Fit::Long
    } else if longer < -0.3 {
        Fit::Short
    } else {
        Fit::OffWall
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pace_of_ten_hertz_takes_every_fourth_of_forty_scans() {
        let mut pace = Pace::default();
        // Scans jitter by up to 2 ms.
        let due = (0..400)
            .filter(|scan| {
                let jitter = 0.002 * f64::from(scan % 3 - 1);
                pace.due(Stamp(0).plus(f64::from(*scan) * 0.025 + jitter), 10.0)
            })
            .count();
        assert_eq!(due, 100);
        assert!(!pace.due(Stamp(0).plus(100.0), 0.0), "never, at a rate of 0");
        assert!(pace.due(Stamp(0).plus(100.0), 10.0), "again after a pause");
        assert!(!pace.due(Stamp(0).plus(100.01), 10.0), "without catching up");
    }

    #[test]
    fn end_points_are_told_apart() {
        assert_eq!(fit(0.05, 1.0), Fit::OnWall);
        assert_eq!(fit(0.5, 1.0), Fit::Long);
        assert_eq!(fit(0.5, -1.0), Fit::Short);
        assert_eq!(fit(0.2, 0.1), Fit::OffWall);
    }
}
