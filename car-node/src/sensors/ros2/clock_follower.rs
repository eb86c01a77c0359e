//! The sensors' clocks, followed while the car runs.
//!
//! A sensor's clock may be set: by NTP, or because a simulator starts again. Its stamps then jump, and the filter must not see
//! that. Each stream has a shift that is added to its stamps. A stamp that goes back, or that comes earlier than the way here
//! allows, changes the shift, so that time goes on as it did before. Another stream takes the same step as soon as its messages come
//! rather as late as they used to with it than without it. That keeps the time between a scan and odometry exact, however late a
//! busy machine was when it saw the step.
//!
//! How late messages come says what the clock shows now. It is followed, too: it may drift, stand still while a simulator is
//! paused, or run at another speed.

use std::collections::VecDeque;

use synpf::Stamp;

use super::topics::Kind;

/// Steps by less are late messages [ns]: 0.1 s.
const LEAST_STEP: i64 = 100_000_000;
/// Streams of one clock step so soon after each other [ns]: 3 s.
const TOGETHER: i64 = 3_000_000_000;
/// A stream that steps more often within [`FLAPPING`] may have two publishers: its steps are not followed at once.
const MOST_STEPS: usize = 4;
/// [ns]: 10 s.
const FLAPPING: i64 = 10_000_000_000;
/// After so long without another step it has one publisher, whose clock was set often. Time that has not gone on for so long is made to
/// [ns]: 1 s.
const STEADY: i64 = 1_000_000_000;
/// Messages by which a stream's usual delay and spacing are known.
const KNOWN: usize = 32;
/// Fewer say nothing.
const LEAST_KNOWN: usize = 8;
/// A message that comes so early or so late against the clock moves it \[s\].
const TOLERATED: std::ops::RangeInclusive<f64> = -0.002..=0.05;
/// The clock is read off the messages that came in least late in each stretch of this \[s\] ...
const STRETCH: f64 = 0.25;
/// ... over so many of them.
const STRETCHES: usize = 4;
/// A clock whose rate is off by less runs at 1: quartz is, by far.
const SAME_RATE: f64 = 0.03;
/// Rates of a simulator.
const RATES: [f64; 2] = [0.05, 20.0];
/// A change of the clock by less is not worth a message \[s\].
const SAID: f64 = 0.1;

/// One stream of messages.
#[derive(Debug, Default)]
struct Stream {
    /// What is added to its stamps \[ns\].
    shift: i64,
    /// The last stamp as it came, and when it came \[ns\].
    last: Option<[i64; 2]>,
    /// Recent delays from shifted stamp to arrival \[ns\].
    delays: VecDeque<i64>,
    /// Recent times from stamp to stamp \[ns\].
    gaps: VecDeque<i64>,
    /// The least delay ever since the last step \[ns\].
    least_delay: Option<i64>,
    /// When it stepped lately \[ns\].
    steps: VecDeque<i64>,
    /// It steps too often, and that was said.
    flapping: bool,
    /// When it made the last step that was not followed, and its usual delay before the first of them \[ns\].
    waiting: Option<[i64; 2]>,
    /// The newest stamp that was passed on, and when it came \[ns\].
    newest: Option<[i64; 2]>,
    /// When the first message came since then that was not newer \[ns\].
    stuck: Option<i64>,
    /// The last step that it took, by its time \[ns\].
    taken: Option<i64>,
}

/// A message's stamp, and what it says of the clocks.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct FollowedStamp {
    /// The stamp for the filter.
    pub(super) stamp: Stamp,
    /// The clock was set by this, back if negative \[s\].
    pub(super) step: Option<f64>,
    /// The stamps go back and forth: two publishers share the topic. Said once.
    pub(super) flapping: bool,
    /// The clock to set.
    pub(super) clock: Option<ClockSetting>,
}

/// What the sensors' clock shows at the arrival of a message.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ClockSetting {
    /// Sensor time at the arrival.
    pub(super) sensor: Stamp,
    /// Sensor seconds per second.
    pub(super) rate: f64,
    /// By how much it was set forwards \[s\].
    pub(super) by: f64,
    /// Worth a message.
    pub(super) said: bool,
}

/// Follows the clocks of a car's sensors. Arrivals are on a monotonic clock of this machine.
#[derive(Debug)]
pub(super) struct ClockFollower {
    scan: Stream,
    odometry: Stream,
    imu: Stream,
    /// The last step: when, and by how much \[ns\].
    last_step: Option<[i64; 2]>,
    /// What the clock was last set to: arrival, sensor time and rate.
    clock: (Stamp, Stamp, f64),
    /// The message that came least late in each stretch: arrival, stamp.
    stretches: VecDeque<(Stamp, Stamp)>,
    /// When the present stretch began.
    stretch: Option<Stamp>,
    /// Nothing had come for a while before these stretches.
    after_silence: bool,
}

/// The middle value.
fn median(values: &VecDeque<i64>) -> Option<i64> {
    let mut sorted: Vec<_> = values.iter().copied().collect();
    let middle = sorted.len() / 2;
    (!sorted.is_empty()).then(|| *sorted.select_nth_unstable(middle).1)
}

fn keep(values: &mut VecDeque<i64>, value: i64, most: usize) {
    values.push_back(value);
    if values.len() > most {
        values.pop_front();
    }
}

impl ClockFollower {
    /// A follower of clocks that show `sensor` at the arrival time `at`.
    pub(super) fn new(at: Stamp, sensor: Stamp) -> Self {
        Self {
            scan: Stream::default(),
            odometry: Stream::default(),
            imu: Stream::default(),
            last_step: None,
            clock: (at, sensor, 1.0),
            stretches: VecDeque::new(),
            stretch: None,
            after_silence: false,
        }
    }

    /// What is added to odometry's stamps \[ns\].
    pub(super) fn shift(&self) -> i64 {
        self.odometry.shift
    }

    /// Takes in a stamp as it came, of a scan, odometry or an IMU.
    pub(super) fn follow(&mut self, kind: Kind, stamp: Stamp, arrival: Stamp) -> FollowedStamp {
        let last_step = self.last_step;
        let known = self.known_delay();
        let stream = match kind {
            Kind::Scan => &mut self.scan,
            Kind::Imu => &mut self.imu,
            _ => &mut self.odometry,
        };
        if let (None, Some((shift, delay))) = (stream.last, known) {
            stream.begin(stamp.0, arrival.0, shift, delay);
        }
        let mut flapping = false;
        let mut said = None;
        if let Some([at, by]) = last_step
            && stream.taken != Some(at)
            && arrival.0.saturating_sub(at) < TOGETHER
            && stream.fits_with(by, stamp.0, arrival.0)
        {
            stream.take(by, at);
        } else {
            let step = match stream.step(stamp.0, arrival.0) {
                Some(_) if stream.steps_too_often(arrival.0) => {
                    flapping = !std::mem::replace(&mut stream.flapping, true);
                    stream.wait(arrival.0);
                    None
                }
                Some(by) => Some(by),
                None => stream.overdue_step(stamp.0, arrival.0),
            };
            if let Some(by) = step.or_else(|| stream.standstill(stamp.0, arrival.0)) {
                stream.take(by, arrival.0);
                self.last_step = Some([arrival.0, by]);
                said = Some(by as f64 * 1e-9);
            }
        }
        let followed = Stamp(stamp.0.saturating_add(stream.shift));
        stream.note(stamp.0, followed.0, arrival.0);
        FollowedStamp {
            stamp: followed,
            step: said,
            flapping,
            clock: self.clock_setting(followed, arrival),
        }
    }

    /// The shift and the usual delay of a stream that runs \[ns\].
    fn known_delay(&self) -> Option<(i64, i64)> {
        [&self.odometry, &self.scan]
            .into_iter()
            .find_map(|stream| Some((stream.shift, median(&stream.delays)?)))
    }

    /// Whether the clock must be set, by a message with this stamp that came in now.
    fn clock_setting(&mut self, stamp: Stamp, arrival: Stamp) -> Option<ClockSetting> {
        let (at, sensor, rate) = self.clock;
        let shows = |arrival: Stamp| sensor.plus(arrival.since(at) * rate);
        let age = |(arrival, stamp): (Stamp, Stamp)| shows(arrival).since(stamp);
        let new = (arrival, stamp);
        let begun = *self.stretch.get_or_insert(arrival);
        let since = arrival.since(begun);
        if since >= STRETCH || self.stretches.is_empty() {
            // After a silence the messages before it say nothing of the clock's rate.
            if since >= 3.0 * STRETCH {
                self.stretches.clear();
                self.after_silence = true;
            }
            self.stretch = Some(arrival);
            self.stretches.push_back(new);
            if self.stretches.len() > STRETCHES {
                self.stretches.pop_front();
            }
        } else if let Some(best) = self.stretches.back_mut()
            && age(new) < age(*best)
        {
            *best = new;
        }
        let least = self
            .stretches
            .iter()
            .copied()
            .min_by(|a, b| age(*a).total_cmp(&age(*b)))?;
        let early = age(new) < *TOLERATED.start();
        // What comes late after a silence is either a burst, which is over at once, or time has stood still.
        let known = if self.after_silence { 2 } else { STRETCHES };
        let late = self.stretches.len() >= known && age(least) > *TOLERATED.end();
        if self.stretches.len() >= known {
            self.after_silence = false;
        }
        if !early && !late {
            return None;
        }
        let measured = match (self.stretches.front(), self.stretches.back()) {
            (Some(first), Some(last)) if last.0.since(first.0) > 2.0 * STRETCH => {
                last.1.since(first.1) / last.0.since(first.0)
            }
            _ => rate,
        };
        let rate = if (measured - 1.0).abs() < SAME_RATE {
            1.0
        } else {
            measured.clamp(RATES[0], RATES[1])
        };
        // The newest of the least late messages: an older one is of another time, if the clock has changed its rate.
        let reference = if early { new } else { *self.stretches.back()? };
        let shown = reference.1.plus(arrival.since(reference.0) * rate);
        let by = shown.since(shows(arrival));
        let said = by.abs() > SAID || (rate - self.clock.2).abs() > SAME_RATE;
        self.clock = (arrival, shown, rate);
        self.stretches.clear();
        self.stretch = None;
        Some(ClockSetting {
            sensor: shown,
            rate,
            by,
            said,
        })
    }
}

impl Stream {
    /// By how much the clock was set before this message \[ns\]; None if it was not.
    fn step(&self, stamp: i64, arrival: i64) -> Option<i64> {
        let [last_stamp, last_arrival] = self.last?;
        let gap = stamp - last_stamp;
        let delay = arrival.saturating_sub(stamp.saturating_add(self.shift));
        if gap < 0 {
            let usual = median(&self.delays).unwrap_or(0);
            // Time goes on after the last message.
            return Some(usual.saturating_sub(delay).min(gap - 1));
        }
        let least = self.least_delay.filter(|_| self.delays.len() >= LEAST_KNOWN)?;
        let sudden = gap - (arrival - last_arrival) > LEAST_STEP && gap > 3 * median(&self.gaps)?;
        (sudden && delay < least - LEAST_STEP)
            .then(|| median(&self.delays).unwrap_or(0).saturating_sub(delay))
    }

    /// Notes a step. True if there were too many lately.
    fn steps_too_often(&mut self, arrival: i64) -> bool {
        while self.steps.front().is_some_and(|at| arrival - at > FLAPPING) {
            self.steps.pop_front();
        }
        self.flapping &= !self.steps.is_empty();
        keep(&mut self.steps, arrival, MOST_STEPS + 1);
        self.steps.len() > MOST_STEPS
    }

    /// A step is not followed yet.
    fn wait(&mut self, arrival: i64) {
        let usual = match self.waiting {
            Some([_, usual]) => usual,
            None => median(&self.delays).unwrap_or(0),
        };
        self.waiting = Some([arrival, usual]);
    }

    /// The step that was not followed, once the stream is steady \[ns\].
    fn overdue_step(&mut self, stamp: i64, arrival: i64) -> Option<i64> {
        let [_, usual] = self
            .waiting
            .take_if(|[at, _]| arrival.saturating_sub(*at) > STEADY)?;
        let by = usual.saturating_sub(self.delay(stamp, arrival));
        // A step forward has been passed on, and time must not go back.
        let goes_on = self
            .newest
            .is_none_or(|[newest, _]| stamp.saturating_add(self.shift).saturating_sub(by) > newest);
        if !goes_on {
            self.delays.clear();
            self.least_delay = None;
        }
        (goes_on && by.saturating_abs() > LEAST_STEP).then_some(by)
    }

    /// The step that lets time go on, where it has not for long \[ns\]: whatever the reason, the filter would refuse all that comes.
    fn standstill(&self, stamp: i64, arrival: i64) -> Option<i64> {
        let ([newest, at], stuck) = (self.newest?, self.stuck?);
        let followed = stamp.saturating_add(self.shift);
        let waited = arrival.saturating_sub(at);
        (arrival.saturating_sub(stuck) > STEADY && followed <= newest)
            .then(|| followed.saturating_sub(newest).saturating_sub(waited))
    }

    /// From a stamp to its arrival \[ns\].
    fn delay(&self, stamp: i64, arrival: i64) -> i64 {
        arrival.saturating_sub(stamp.saturating_add(self.shift))
    }

    /// True if a message comes rather as late as usual with a step than without it.
    fn fits_with(&self, by: i64, stamp: i64, arrival: i64) -> bool {
        median(&self.delays).is_some_and(|usual| {
            let off = self.delay(stamp, arrival).saturating_sub(usual);
            off.saturating_add(by).saturating_abs() < off.saturating_abs()
        })
    }

    /// Takes a step, which happened at this arrival.
    fn take(&mut self, by: i64, at: i64) {
        self.shift = self.shift.saturating_sub(by);
        self.taken = Some(at);
        // They may be off by how late the message was that showed the step.
        self.delays.clear();
        self.gaps.clear();
        self.least_delay = None;
    }

    /// The first message of a stream that begins later than others: it has their shift if that fits, and none else.
    fn begin(&mut self, stamp: i64, arrival: i64, shift: i64, delay: i64) {
        let off = |shift: i64| {
            arrival
                .saturating_sub(stamp.saturating_add(shift))
                .saturating_sub(delay)
                .saturating_abs()
        };
        if off(shift) < off(0) {
            self.shift = shift;
        }
    }

    /// Notes a message, as it came and as it is passed on.
    fn note(&mut self, stamp: i64, followed: i64, arrival: i64) {
        let delay = arrival.saturating_sub(followed);
        keep(&mut self.delays, delay, KNOWN);
        if let Some([last, _]) = self.last
            && stamp > last
        {
            keep(&mut self.gaps, stamp - last, KNOWN);
        }
        self.least_delay = Some(self.least_delay.map_or(delay, |least| least.min(delay)));
        if self.newest.is_none_or(|[newest, _]| followed > newest) {
            self.newest = Some([followed, arrival]);
            self.stuck = None;
        } else {
            self.stuck.get_or_insert(arrival);
        }
        self.last = Some([stamp, arrival]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    /// A car with scans at 40 Hz, 20 ms late, and odometry at 50 Hz, 1 ms late. `clock` maps true time \[ns\] to what the
    /// sensors' clock shows, `silent` says when nothing is sent. Calls `check` with the true stamp and what is made of it.
    struct Drive {
        follower: ClockFollower,
        steps: Vec<f64>,
        shown: (Stamp, Stamp, f64),
        worst_age: f64,
    }

    fn drive(
        seconds: i64,
        clock: impl Fn(i64) -> i64,
        silent: impl Fn(i64) -> bool,
        mut check: impl FnMut(Kind, i64, Stamp),
    ) -> Drive {
        let start = Stamp(1_000 * MS);
        let mut drive = Drive {
            follower: ClockFollower::new(start, Stamp(clock(start.0))),
            steps: Vec::new(),
            shown: (start, Stamp(clock(start.0)), 1.0),
            worst_age: 0.0,
        };
        let mut messages: Vec<(i64, i64, Kind)> = Vec::new();
        for i in 0..seconds * 50 {
            // Odometry jitters by up to 1 ms.
            let stamp = start.0 + i * 20 * MS;
            messages.push((stamp + MS + (i * 7 % 10) * MS / 10, stamp, Kind::Odometry));
        }
        for i in 0..seconds * 40 {
            let stamp = start.0 + i * 25 * MS;
            messages.push((stamp + 20 * MS + (i * 3 % 10) * MS / 5, stamp, Kind::Scan));
        }
        messages.sort_unstable_by_key(|message| message.0);
        for (arrival, stamp, kind) in messages {
            if silent(stamp) {
                continue;
            }
            let followed = drive.follower.follow(kind, Stamp(clock(stamp)), Stamp(arrival));
            assert!(!followed.flapping);
            drive.steps.extend(followed.step);
            if let Some(setting) = followed.clock {
                drive.shown = (Stamp(arrival), setting.sensor, setting.rate);
            }
            let (at, sensor, rate) = drive.shown;
            let age = sensor.plus(Stamp(arrival).since(at) * rate).since(followed.stamp);
            // The end of the drive: what went on before is over.
            if stamp > start.0 + (seconds - 2) * 1_000 * MS {
                drive.worst_age = drive.worst_age.max(age).max(-age);
            }
            check(kind, stamp, followed.stamp);
        }
        drive
    }

    /// Checks that the filter's time goes on as true time does, over a clock that is set by `by` \[ns\] after 5 s.
    fn survives(by: i64) {
        let at = 6_000 * MS;
        let mut last: [Option<(i64, Stamp)>; 2] = [None; 2];
        let mut between: Vec<i64> = Vec::new();
        let drive = drive(
            12,
            |t| if t >= at { t + by } else { t },
            |_| false,
            |kind, stamp, followed| {
                let last = &mut last[usize::from(kind == Kind::Scan)];
                if let Some((before, before_followed)) = *last {
                    assert!(followed > before_followed, "{kind:?} goes back");
                    let off = (followed.0 - before_followed.0) - (stamp - before);
                    assert!(off.abs() < 25 * MS, "{kind:?}: {off} ns");
                }
                *last = Some((stamp, followed));
                between.push(followed.0 - stamp);
            },
        );
        assert_eq!(drive.steps.len(), 1, "{:?}", drive.steps);
        assert!(
            (drive.steps[0] - by as f64 * 1e-9).abs() < 0.025,
            "{:?}",
            drive.steps
        );
        assert!(drive.worst_age < 0.06, "{}", drive.worst_age);
        // Both streams are shifted by the same.
        assert_eq!(drive.follower.scan.shift, drive.follower.odometry.shift);
    }

    #[test]
    fn a_clock_that_is_set_is_followed() {
        for by in [-300 * MS, -3_600_000 * MS, 300 * MS, 3_600_000 * MS] {
            survives(by);
        }
    }

    #[test]
    fn a_simulator_that_starts_again_at_zero_is_followed() {
        survives(-6_000 * MS);
    }

    #[test]
    fn a_pause_moves_the_clock_and_no_stamp() {
        // The clock stands still for 5 s, and nothing is sent.
        let paused = |t: i64| t.clamp(0, 6_000 * MS) + (t - 11_000 * MS).max(0);
        let drive = drive(
            16,
            paused,
            |t| (6_000 * MS..11_000 * MS).contains(&t),
            |_, stamp, followed| assert_eq!(followed.0, paused(stamp)),
        );
        assert!(drive.steps.is_empty(), "{:?}", drive.steps);
        assert!(drive.worst_age < 0.06, "{}", drive.worst_age);
        assert!((drive.shown.2 - 1.0).abs() < 1e-9);
    }

    #[test]
    fn a_simulator_at_half_speed_is_followed() {
        let drive = drive(
            10,
            |t| t / 2,
            |_| false,
            |_, stamp, followed| assert_eq!(followed.0, stamp / 2),
        );
        assert!(drive.steps.is_empty(), "{:?}", drive.steps);
        assert!((drive.shown.2 - 0.5).abs() < 0.05, "{}", drive.shown.2);
        assert!(drive.worst_age < 0.06, "{}", drive.worst_age);
    }

    #[test]
    fn a_burst_after_a_stall_is_no_step() {
        let mut follower = ClockFollower::new(Stamp(0), Stamp(0));
        let mut steps = 0;
        for i in 0..400_i64 {
            let stamp = i * 20 * MS;
            // Between 3 s and 5 s the network stands; then all of it comes at once, every other message lost.
            let stalled = (3_000 * MS..5_000 * MS).contains(&stamp);
            if stalled && i % 30 > 10 {
                continue;
            }
            let arrival = if stalled { 5_000 * MS + i } else { stamp + MS };
            let followed = follower.follow(Kind::Odometry, Stamp(stamp), Stamp(arrival));
            steps += usize::from(followed.step.is_some());
            assert_eq!(followed.stamp, Stamp(stamp));
        }
        assert_eq!(steps, 0);
    }

    #[test]
    fn a_backlog_at_the_start_is_no_step() {
        let mut follower = ClockFollower::new(Stamp(0), Stamp(0));
        for i in 0..200_i64 {
            let stamp = i * 20 * MS;
            let arrival = (stamp + MS).max(2_000 * MS);
            let followed = follower.follow(Kind::Odometry, Stamp(stamp), Stamp(arrival));
            assert_eq!((followed.step, followed.stamp), (None, Stamp(stamp)));
        }
    }

    #[test]
    fn two_publishers_on_one_topic_are_noticed_once() {
        let mut follower = ClockFollower::new(Stamp(0), Stamp(0));
        let mut flapping = 0;
        for i in 0..400_i64 {
            let stamp = i * 10 * MS - if i % 2 == 0 { 0 } else { 300 * MS };
            let followed = follower.follow(Kind::Odometry, Stamp(stamp), Stamp(i * 10 * MS));
            flapping += usize::from(followed.flapping);
        }
        assert_eq!(flapping, 1);
    }

    #[test]
    fn a_step_that_a_busy_machine_sees_late_keeps_the_streams_together() {
        for (by, stalled) in [(-300, 250), (500, 300), (-3_600_000, 900), (3_600_000, 900)] {
            let mut follower = ClockFollower::new(Stamp(0), Stamp(0));
            let mut worst = 0;
            for i in 0..900_i64 {
                let stamp = i * 10 * MS;
                let (kind, latency) = if i % 5 == 4 {
                    (Kind::Scan, 20)
                } else {
                    (Kind::Odometry, 1)
                };
                let set = if stamp >= 4_000 * MS { by * MS } else { 0 };
                // The first odometry after the step comes late, the scans in time.
                let late = if (4_000..4_030).contains(&(stamp / MS)) && kind == Kind::Odometry {
                    stalled
                } else {
                    0
                };
                let arrival = stamp + (latency + late) * MS;
                let followed = follower.follow(kind, Stamp(stamp + set), Stamp(arrival));
                if stamp > 5_000 * MS {
                    let shifts = [follower.scan.shift, follower.odometry.shift];
                    worst = worst.max((shifts[0] - shifts[1]).abs());
                    assert!((followed.stamp.0 - stamp).abs() < 1_000 * MS, "{by} {followed:?}");
                }
            }
            assert_eq!(worst, 0, "{by} ms");
        }
    }

    #[test]
    fn a_sensor_that_begins_after_a_step_is_on_the_same_clock() {
        let mut follower = ClockFollower::new(Stamp(0), Stamp(0));
        for i in 0..400_i64 {
            let stamp = i * 20 * MS;
            let set = if i >= 100 { -3_600_000 * MS } else { 0 };
            let followed = follower.follow(Kind::Odometry, Stamp(stamp + set), Stamp(stamp + MS));
            assert!((followed.stamp.0 - stamp).abs() < 25 * MS);
            if i >= 200 {
                let imu = follower.follow(Kind::Imu, Stamp(stamp + set), Stamp(stamp + MS));
                assert!((imu.stamp.0 - stamp).abs() < 25 * MS);
            }
        }
    }

    #[test]
    fn a_clock_that_is_set_again_and_again_is_followed() {
        let mut follower = ClockFollower::new(Stamp(0), Stamp(0));
        let (mut newest, mut newest_at) = (i64::MIN, 0);
        for i in 0..1_000_i64 {
            let arrival = i * 20 * MS;
            // Set every two seconds, by more each time, back and forth.
            let times = arrival / (2_000 * MS);
            let set = times * times * 700 * MS * (1 - 2 * (times % 2));
            let followed = follower.follow(Kind::Odometry, Stamp(arrival + set), Stamp(arrival + MS));
            if followed.stamp.0 > newest {
                (newest, newest_at) = (followed.stamp.0, arrival);
            }
            assert!(
                arrival - newest_at < 1_100 * MS,
                "time stands still at {arrival} ns"
            );
        }
    }

    #[test]
    fn stamps_at_the_ends_of_time_break_nothing() {
        let mut follower = ClockFollower::new(Stamp(0), Stamp(0));
        for (i, stamp) in [
            0,
            i64::from(i32::MAX) * 1_000 * MS,
            i64::from(i32::MIN) * 1_000 * MS,
            0,
            5,
        ]
        .into_iter()
        .cycle()
        .take(200)
        .enumerate()
        {
            follower.follow(Kind::Imu, Stamp(stamp), Stamp(i as i64 * 20 * MS));
        }
    }
}
