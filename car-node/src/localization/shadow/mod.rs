//! Runs a second localizer under another parameter set, on its own thread, over the data that the filter has accepted.
//! An operator sees the comparison before switching.
//!
//! ```text
//! filter --scan, odometry, its own update (never blocks)--> shadow --1 Hz--> comparison
//!                  command handler --run, end-------------> shadow
//! ```
//!
//! The filter forwards a scan after its own update is published. A full queue costs the shadow a scan. The shadow ends by
//! itself when there is not enough CPU for both (see `budget`), and when it loses its pose: a search of the map would take
//! all cores.

mod budget;
mod comparison;

use std::sync::{Arc, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, select};
use protocol::EventKind;
use synpf::{Localizer, Mode, PoseError, Stamp};

use self::budget::{Budget, ScanCost};
use self::comparison::{ComparisonWindow, ScanOutcome};
use super::shadow_channel::{ShadowInput, ShadowReceiver, ShadowScan};
use crate::sensors::clock::{SensorClock, wall_now};
use crate::telemetry::queue::Record;
use crate::telemetry::shared_state::SharedState;

/// Commands from the command handler to the shadow.
#[derive(Debug)]
pub enum ShadowCommand {
    /// Run this set.
    Run {
        /// Its name.
        name: String,
        /// The operator.
        who: String,
        /// A localizer under the set, without a pose.
        localizer: Box<dyn Localizer>,
    },
    /// Run no set.
    End {
        /// The operator.
        who: String,
    },
}

/// The comparison is published this often.
const PERIOD: Duration = Duration::from_secs(1);
/// A localizer is compared from this time after it got its pose \[s\].
const SETTLING: f64 = 2.0;

/// Starts the thread. It ends when `commands` has no sender left.
pub fn start(
    receiver: ShadowReceiver,
    commands: Receiver<ShadowCommand>,
    shared: Arc<SharedState>,
    clock: SensorClock,
) -> std::io::Result<JoinHandle<()>> {
    thread::Builder::new().name("shadow".into()).spawn(move || {
        ShadowWorker {
            receiver,
            shared,
            clock,
            running: None,
            who: "start".into(),
            since: wall_now(),
            due: Instant::now(),
        }
        .run(&commands);
    })
}

/// A shadow set that runs.
struct RunningShadow {
    name: String,
    localizer: Box<dyn Localizer>,
    /// When it got its pose; None while it has none.
    initialized: Option<Stamp>,
    window: ComparisonWindow,
    budget: Budget,
    /// Scans that the channel had dropped at the last scan.
    skipped: u64,
}

/// The thread's state.
struct ShadowWorker {
    receiver: ShadowReceiver,
    shared: Arc<SharedState>,
    clock: SensorClock,
    running: Option<RunningShadow>,
    /// Who last changed what runs, and when.
    who: String,
    since: Stamp,
    due: Instant,
}

impl ShadowWorker {
    fn run(mut self, commands: &Receiver<ShadowCommand>) {
        let mut inputs = self.receiver.inputs().clone();
        loop {
            let patience = self.due.saturating_duration_since(Instant::now());
            select! {
                recv(commands) -> command => match command {
                    Ok(command) => self.apply(command),
                    Err(_) => return,
                },
                recv(inputs) -> input => match input {
                    Ok(input) => self.handle(input),
                    // The filter has ended; wait for the end of the commands.
                    Err(_) => inputs = crossbeam_channel::never(),
                },
                default(patience) => {}
            }
            if Instant::now() >= self.due {
                self.publish();
            }
        }
    }

    fn apply(&mut self, command: ShadowCommand) {
        // Inputs for the previous shadow are too old for this one.
        while self.receiver.inputs().try_recv().is_ok() {}
        let before = self.running.take();
        match command {
            ShadowCommand::Run { name, who, localizer } => {
                self.who = who;
                self.running = Some(RunningShadow {
                    name,
                    localizer,
                    initialized: None,
                    window: ComparisonWindow::default(),
                    budget: Budget::default(),
                    skipped: self.receiver.skipped(),
                });
            }
            ShadowCommand::End { who } if before.is_some() => self.who = who,
            ShadowCommand::End { .. } => {}
        }
        self.since = wall_now();
        self.receiver.set_wanted(self.running.is_some());
        self.publish();
    }

    fn handle(&mut self, input: ShadowInput) {
        let Some(running) = &mut self.running else {
            return;
        };
        let ended = match input {
            // The filter has accepted these. If the shadow refuses them, its next scan fails and counts as skipped.
            ShadowInput::Odometry(odometry) => {
                running.localizer.on_odometry(&odometry).ok();
                None
            }
            ShadowInput::YawRate(yaw_rate) => {
                running.localizer.on_yaw_rate(&yaw_rate).ok();
                None
            }
            ShadowInput::Pose(pose) => {
                running.localizer.on_external_pose(&pose).ok();
                None
            }
            ShadowInput::PoseReset => {
                running.initialized = None;
                None
            }
            ShadowInput::Laser(laser) => {
                running.localizer.set_laser(laser);
                None
            }
            ShadowInput::Scan(scan) => {
                let skipped = self.receiver.skipped();
                let since = skipped - std::mem::replace(&mut running.skipped, skipped);
                running.on_scan(&scan, since)
            }
        };
        if let Some(evidence) = ended {
            self.drop_shadow(evidence);
        }
    }

    /// Ends the shadow for a reason that the car has found itself.
    fn drop_shadow(&mut self, evidence: String) {
        let Some(running) = self.running.take() else {
            return;
        };
        self.receiver.set_wanted(false);
        self.who = "load".into();
        self.since = wall_now();
        let set = running.name;
        let mut known = self.shared.shadow.lock().unwrap_or_else(PoisonError::into_inner);
        // The command handler may just have started another one.
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
        self.publish();
    }

    fn publish(&mut self) {
        self.due = Instant::now() + PERIOD;
        let running = self.running.as_ref();
        let shadow = protocol::Shadow {
            set: running.map(|running| running.name.clone()),
            who: self.who.clone(),
            since: self.since.0,
            comparison: running.and_then(|running| running.window.comparison()),
        };
        self.shared.telemetry.record(Record::Shadow(Box::new(shadow)));
    }
}

impl RunningShadow {
    /// Updates the shadow with a scan; the channel has dropped `skipped` scans before it. Returns a reason when the shadow
    /// must end.
    fn on_scan(&mut self, scan: &ShadowScan, skipped: u64) -> Option<String> {
        let force = &scan.update;
        self.window.skip(force.stamp, skipped);
        if force.mode != Mode::Tracking {
            self.initialized = None;
            return None;
        }
        if self.initialized.is_none() {
            match self.localizer.initialize(force.pose) {
                // A localizer that follows another one has its pose from there.
                Ok(()) | Err(PoseError::Elsewhere) => {}
                Err(_) => return None,
            }
            self.window = ComparisonWindow::default();
        }
        let initialized = *self.initialized.get_or_insert(force.stamp);
        let before = Instant::now();
        let update = self.localizer.on_scan(&scan.scan);
        let taken = before.elapsed().as_secs_f64();
        let cost = ScanCost {
            stamp: force.stamp,
            taken: scan.taken,
            queued: scan.queued,
            skipped,
        };
        if let Some(evidence) = self.budget.on_scan(&cost) {
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
                scan.set.name
            ));
        }
        if force.stamp.since(initialized) >= SETTLING {
            self.window.push(
                &scan.set,
                ScanOutcome::new(force, scan.taken),
                ScanOutcome::new(&update, taken),
            );
        }
        None
    }
}
