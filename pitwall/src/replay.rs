//! Replays a recording: the same events as from live cars, through the same fleet.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use serde::Serialize;

use crate::event::FleetEvent;
use crate::event_bus::EventBus;
use crate::fleet::Fleet;
use crate::recording::{RecordingError, Survey, Unreadable, UnreadableCount, read_events, survey};

/// A recording that is being played.
pub struct Replay {
    bus: Arc<EventBus>,
    path: PathBuf,
    /// When the first and the last event arrived \[unix ns\].
    span: (i64, i64),
    unreadable: Vec<Unreadable>,
    survey: Survey,
    playhead: Mutex<Playhead>,
    changed: Condvar,
}

/// Position and speed of the replay.
struct Playhead {
    playing: bool,
    speed: f64,
    /// The recording's time at the moment `since` \[unix ns\].
    at: i64,
    since: Instant,
    /// Target of a jump that is not made yet \[unix ns\].
    jump: Option<i64>,
    stop: bool,
}

/// State of a replay.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ReplayView {
    /// The file.
    pub file: String,
    /// False when paused and at the end.
    pub playing: bool,
    /// Speed \[times real time\].
    pub speed: f64,
    /// Time since the recording's start \[s\].
    pub at_s: f64,
    /// Length of the recording \[s\].
    pub duration_s: f64,
}

impl Playhead {
    fn now(&self, end: i64) -> i64 {
        if !self.playing {
            return self.at.min(end);
        }
        let ahead = self.since.elapsed().as_secs_f64() * self.speed * 1e9;
        self.at.saturating_add(ahead as i64).min(end)
    }

    /// Stores the current position before the speed changes.
    fn settle(&mut self, end: i64) {
        self.at = self.now(end);
        self.since = Instant::now();
    }
}

impl Replay {
    /// Allowed speeds \[times real time\].
    pub const SPEEDS: std::ops::RangeInclusive<f64> = 0.1..=50.0;

    /// Reads the whole recording once, so that its faults are known before it is shown. Then plays it on a thread.
    pub fn start(path: &Path) -> Result<Arc<Self>, RecordingError> {
        let mut span: Option<(i64, i64)> = None;
        let mut unreadable = UnreadableCount::default();
        for event in read_events(path)? {
            let event = event?;
            unreadable.add(&event);
            let at = event.at;
            span = Some(span.map_or((at, at), |(from, to)| (from.min(at), to.max(at))));
        }
        let span = span.ok_or_else(|| RecordingError::Empty(path.display().to_string()))?;
        let replay = Arc::new(Self {
            bus: Arc::default(),
            path: path.to_owned(),
            span,
            unreadable: unreadable.list(),
            survey: survey(path)?,
            playhead: Mutex::new(Playhead {
                playing: true,
                speed: 1.0,
                at: span.0,
                since: Instant::now(),
                jump: None,
                stop: false,
            }),
            changed: Condvar::new(),
        });
        replay.survey.prepare_replay(&mut replay.bus.fleet());
        let player = replay.clone();
        std::thread::Builder::new()
            .name("replay".to_owned())
            .spawn(move || player.play())
            .map_err(|source| RecordingError::io(path, source))?;
        Ok(replay)
    }

    /// Distributes the events.
    pub fn bus(&self) -> &Arc<EventBus> {
        &self.bus
    }

    /// The messages that cannot be decoded.
    pub fn unreadable(&self) -> &[Unreadable] {
        &self.unreadable
    }

    /// The recording's time that is shown \[unix ns\].
    pub fn now(&self) -> i64 {
        self.playhead().now(self.span.1)
    }

    /// The state of the replay.
    pub fn view(&self) -> ReplayView {
        let playhead = self.playhead();
        let at = playhead.jump.unwrap_or_else(|| playhead.now(self.span.1));
        ReplayView {
            file: self.path.display().to_string(),
            playing: playhead.playing && at < self.span.1,
            speed: playhead.speed,
            at_s: (at - self.span.0) as f64 * 1e-9,
            duration_s: (self.span.1 - self.span.0) as f64 * 1e-9,
        }
    }

    /// Plays or pauses, changes the speed \[times real time\], jumps \[s since the start\]. Does nothing and returns the
    /// reason when a value is out of range.
    pub fn set_playback(
        &self,
        playing: Option<bool>,
        speed: Option<f64>,
        at_s: Option<f64>,
    ) -> Result<(), String> {
        if let Some(speed) = speed.filter(|speed| !Self::SPEEDS.contains(speed)) {
            let (from, to) = (Self::SPEEDS.start(), Self::SPEEDS.end());
            return Err(format!("speed {speed} is not between {from} and {to}"));
        }
        if let Some(at_s) = at_s.filter(|at_s| !at_s.is_finite()) {
            return Err(format!("{at_s} s is not a time"));
        }
        let mut playhead = self.playhead();
        playhead.settle(self.span.1);
        if let Some(at_s) = at_s {
            let at = self.span.0.saturating_add((at_s * 1e9) as i64);
            playhead.jump = Some(at.clamp(self.span.0, self.span.1));
        }
        // Play at the end starts from the beginning.
        if playing == Some(true) && at_s.is_none() && playhead.at >= self.span.1 {
            playhead.jump = Some(self.span.0);
        }
        playhead.playing = playing.unwrap_or(playhead.playing);
        playhead.speed = speed.unwrap_or(playhead.speed);
        drop(playhead);
        self.changed.notify_all();
        Ok(())
    }

    /// Stops the replay.
    pub fn stop(&self) {
        self.playhead().stop = true;
        self.changed.notify_all();
    }

    fn playhead(&self) -> MutexGuard<'_, Playhead> {
        self.playhead.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn play(&self) {
        if let Err(error) = self.play_until_stopped() {
            tracing::error!(%error, "the replay has failed");
        }
    }

    fn play_until_stopped(&self) -> Result<(), RecordingError> {
        let mut events = PeekedEvents::open(&self.path)?;
        loop {
            let (now, jump) = {
                let mut playhead = self.playhead();
                if playhead.stop {
                    return Ok(());
                }
                (playhead.now(self.span.1), playhead.jump.take())
            };
            if let Some(to) = jump {
                events = self.jump(to)?;
                let mut playhead = self.playhead();
                playhead.at = to;
                playhead.since = Instant::now();
                continue;
            }
            while let Some(event) = events.next_until(now)? {
                self.bus.publish(event);
            }
            self.bus.fleet().tick(now);
            let playhead = self.playhead();
            if playhead.jump.is_none() && !playhead.stop {
                // Ten milliseconds of real time: less than from one snapshot to the next.
                drop(self.changed.wait_timeout(playhead, Duration::from_millis(10)));
            }
        }
    }

    /// Applies all events up to `to` \[unix ns\] to a new fleet and shows that fleet.
    fn jump(&self, to: i64) -> Result<PeekedEvents, RecordingError> {
        let mut events = PeekedEvents::open(&self.path)?;
        let mut fleet = Fleet::default();
        self.survey.prepare_replay(&mut fleet);
        let mut ticked = self.span.0;
        while let Some(event) = events.next_until(to)? {
            // Time passes as it did, so that a car is BLIND where it was.
            fleet.tick_between(&mut ticked, event.at);
            fleet.apply(&event);
        }
        fleet.tick(to);
        self.bus.replace_fleet(fleet, to);
        Ok(events)
    }
}

/// The events of a recording, with one event of look-ahead.
struct PeekedEvents {
    events: Box<dyn Iterator<Item = Result<FleetEvent, RecordingError>> + Send>,
    next: Option<FleetEvent>,
}

impl PeekedEvents {
    fn open(path: &Path) -> Result<Self, RecordingError> {
        Ok(Self {
            events: Box::new(read_events(path)?),
            next: None,
        })
    }

    /// The next event, if it arrived by `until` \[unix ns\].
    fn next_until(&mut self, until: i64) -> Result<Option<FleetEvent>, RecordingError> {
        if self.next.is_none() {
            self.next = self.events.next().transpose()?;
        }
        Ok(self.next.take_if(|event| event.at <= until))
    }
}
