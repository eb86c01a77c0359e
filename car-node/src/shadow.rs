//! A second localizer under another parameter set, on a thread of its own, fed with what the one in force has
//! already taken: a switch is then decided on evidence.
//!
//! ```text
//! filter --scan, odometry, its own update (never waits)--> shadow --1 Hz--> comparison
//!                                    desk --run, end-----> shadow
//! ```
//!
//! The filter hands on a scan when its own update is done and on its way, and never waits for the shadow: a full queue
//! costs the shadow a scan. The shadow ends by itself when there is not enough CPU for both (see `budget`), and when it
//! has lost its pose: to search the map would take all cores.

mod budget;
mod comparison;

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Sender, bounded, select};
use protocol::{EventKind, SetRef};
use synpf::{Mode, Odometry, Scan, Stamp, SynPf, Update, YawRate};

use self::budget::{Budget, Spent};
use self::comparison::{Judged, Window};
use crate::clock::{SensorClock, wall_now};
use crate::filter::Shared;
use crate::outbox::Record;

/// What the filter hands on.
#[derive(Debug)]
pub enum Note {
    /// Odometry that it has taken.
    Odometry(Odometry),
    /// A gyroscope's reading that it has taken.
    YawRate(YawRate),
    /// A scan that led to an update.
    Scan(Box<Sample>),
    /// Its pose was set anew: so is the shadow's.
    Placed,
}

/// A scan, with what the set in force made of it.
#[derive(Debug)]
pub struct Sample {
    /// The scan.
    pub scan: Scan,
    /// The update it led to.
    pub update: Update,
    /// How long that took [s].
    pub taken: f64,
    /// Messages that waited for the filter meanwhile.
    pub queued: usize,
    /// The set in force.
    pub set: SetRef,
}

/// What the desk asks for.
pub enum Wish {
    /// Run this set.
    Run {
        /// Its name.
        name: String,
        /// Who wants it.
        who: String,
        /// A localizer under it, without a pose.
        localizer: Box<SynPf>,
    },
    /// Run none.
    End {
        /// Who wants that.
        who: String,
    },
}

/// Notes that wait for the shadow: half a second of a car's sensors.
const QUEUE: usize = 64;
/// The comparison is told this often.
const PERIOD: Duration = Duration::from_secs(1);
/// A localizer that was just placed is not judged yet [s].
const SETTLING: f64 = 2.0;

/// The filter's end: hands on what it has taken, if anybody wants it.
#[derive(Debug, Clone)]
pub struct Tap {
    notes: Sender<Note>,
    wanted: Arc<AtomicBool>,
    skipped: Arc<AtomicU64>,
}

impl Tap {
    /// True while a shadow runs: without one, nothing needs to be copied.
    pub fn wanted(&self) -> bool {
        self.wanted.load(Ordering::Relaxed)
    }

    /// Hands something on, unless the shadow is too far behind.
    pub fn hand_on(&self, note: Note) {
        let scan = matches!(note, Note::Scan(_));
        if self.notes.try_send(note).is_err() && scan {
            self.skipped.fetch_add(1, Ordering::Relaxed);
        }
    }
}

/// The shadow's end of a [`Tap`].
pub struct Tapped {
    notes: Receiver<Note>,
    wanted: Arc<AtomicBool>,
    skipped: Arc<AtomicU64>,
}

/// A tap for the filter, and what comes out of it.
pub fn tap() -> (Tap, Tapped) {
    let (notes, noted) = bounded(QUEUE);
    let (wanted, skipped) = (Arc::default(), Arc::default());
    let tap = Tap {
        notes,
        wanted: Arc::clone(&wanted),
        skipped: Arc::clone(&skipped),
    };
    let tapped = Tapped {
        notes: noted,
        wanted,
        skipped,
    };
    (tap, tapped)
}

/// Starts the thread. It ends when the desk, which gives `wishes`, has gone.
pub fn start(
    tapped: Tapped,
    wishes: Receiver<Wish>,
    shared: Arc<Shared>,
    clock: SensorClock,
) -> std::io::Result<JoinHandle<()>> {
    thread::Builder::new().name("shadow".into()).spawn(move || {
        Loop {
            tapped,
            shared,
            clock,
            running: None,
            who: "start".into(),
            since: wall_now(),
            due: Instant::now(),
        }
        .run(&wishes);
    })
}

/// A set in the shadow.
struct Running {
    name: String,
    localizer: Box<SynPf>,
    /// Since when it has had a pose.
    placed: Option<Stamp>,
    window: Window,
    budget: Budget,
    /// What the tap had left out when it was last looked at.
    skipped: u64,
}

struct Loop {
    tapped: Tapped,
    shared: Arc<Shared>,
    clock: SensorClock,
    running: Option<Running>,
    /// Who has last changed what runs, and when.
    who: String,
    since: Stamp,
    due: Instant,
}

impl Loop {
    fn run(mut self, wishes: &Receiver<Wish>) {
        let mut notes = self.tapped.notes.clone();
        loop {
            let patience = self.due.saturating_duration_since(Instant::now());
            select! {
                recv(wishes) -> wish => match wish {
                    Ok(wish) => self.fulfil(wish),
                    Err(_) => return,
                },
                recv(notes) -> note => match note {
                    Ok(note) => self.take_in(note),
                    // Without a filter there is nothing to do but to wait for the end.
                    Err(_) => notes = crossbeam_channel::never(),
                },
                default(patience) => {}
            }
            if Instant::now() >= self.due {
                self.tell();
            }
        }
    }

    fn fulfil(&mut self, wish: Wish) {
        // What was meant for another shadow, or for none, is too old for this one.
        while self.tapped.notes.try_recv().is_ok() {}
        let before = self.running.take();
        match wish {
            Wish::Run { name, who, localizer } => {
                self.who = who;
                self.running = Some(Running {
                    name,
                    localizer,
                    placed: None,
                    window: Window::default(),
                    budget: Budget::default(),
                    skipped: self.tapped.skipped.load(Ordering::Relaxed),
                });
            }
            Wish::End { who } if before.is_some() => self.who = who,
            Wish::End { .. } => {}
        }
        self.since = wall_now();
        self.tapped
            .wanted
            .store(self.running.is_some(), Ordering::Relaxed);
        self.tell();
    }

    fn take_in(&mut self, note: Note) {
        let Some(running) = &mut self.running else {
            return;
        };
        let ended = match note {
            // What the shadow refuses, the one in force has taken: a scan then counts as left out.
            Note::Odometry(odometry) => {
                running.localizer.on_odometry(&odometry).ok();
                None
            }
            Note::YawRate(yaw_rate) => {
                running.localizer.on_yaw_rate(&yaw_rate).ok();
                None
            }
            Note::Placed => {
                running.placed = None;
                None
            }
            Note::Scan(sample) => {
                let skipped = self.tapped.skipped.load(Ordering::Relaxed);
                let since = skipped - std::mem::replace(&mut running.skipped, skipped);
                running.on_scan(&sample, since)
            }
        };
        if let Some(evidence) = ended {
            self.drop_it(evidence);
        }
    }

    /// Ends the shadow for the car's own reasons.
    fn drop_it(&mut self, evidence: String) {
        let Some(running) = self.running.take() else {
            return;
        };
        self.tapped.wanted.store(false, Ordering::Relaxed);
        self.who = "load".into();
        self.since = wall_now();
        let set = running.name;
        let mut known = self.shared.shadow.lock().unwrap_or_else(PoisonError::into_inner);
        // Unless the desk has begun another one in this moment.
        if known.as_ref() == Some(&set) {
            *known = None;
        }
        drop(known);
        self.shared.event(
            self.clock.now(),
            0,
            EventKind::ShadowDropped { set, evidence },
            None,
            None,
        );
        self.tell();
    }

    fn tell(&mut self) {
        self.due = Instant::now() + PERIOD;
        let running = self.running.as_ref();
        let shadow = protocol::Shadow {
            set: running.map(|running| running.name.clone()),
            who: self.who.clone(),
            since: self.since.0,
            comparison: running.and_then(|running| running.window.comparison()),
        };
        self.shared.outbox.record(Record::Shadow(Box::new(shadow)));
    }
}

impl Running {
    /// Takes a scan, `skipped` others having been left out before it. Some reason when the shadow must end.
    fn on_scan(&mut self, sample: &Sample, skipped: u64) -> Option<String> {
        let force = &sample.update;
        self.window.skip(force.stamp, skipped);
        if force.mode != Mode::Tracking {
            self.placed = None;
            return None;
        }
        if self.placed.is_none() {
            self.localizer.initialize(force.pose).ok()?;
            self.window = Window::default();
        }
        let placed = *self.placed.get_or_insert(force.stamp);
        let before = Instant::now();
        let update = self.localizer.on_scan(&sample.scan);
        let taken = before.elapsed().as_secs_f64();
        let spent = Spent {
            stamp: force.stamp,
            taken: sample.taken,
            queued: sample.queued,
            skipped,
        };
        if let Some(evidence) = self.budget.on_scan(&spent) {
            return Some(evidence);
        }
        let Ok(update) = update else {
            self.window.skip(force.stamp, 1);
            return None;
        };
        if update.mode != Mode::Tracking {
            let distance = update.pose.distance(force.pose);
            return Some(format!(
                "it has lost its pose, {distance:.2} m from that of {}",
                sample.set.name
            ));
        }
        if force.stamp.since(placed) >= SETTLING {
            self.window.push(
                &sample.set,
                Judged::new(force, sample.taken),
                Judged::new(&update, taken),
            );
        }
        None
    }
}
