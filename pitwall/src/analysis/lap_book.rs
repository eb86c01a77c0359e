//! The laps of one car, from its messages.

use std::collections::VecDeque;
use std::sync::Arc;

use protocol::{CauseKind, Covariance, Event, EventKind, Header, Health, Load, Pose, Severity, State};

use super::lap_check::{LapCheck, Step};
use super::{Channel, LapKind, LapTrace, TrackLine};

/// A pose, as far as laps need it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseSample {
    /// When it was true, by the car's clock \[unix ns\].
    pub at: i64,
    /// Arc length on the raceline \[m\].
    pub s: f64,
    /// Laps begun.
    pub lap: u32,
    /// Speed over ground \[m/s\].
    pub speed: f64,
    /// Distance from the raceline, left positive \[m\].
    pub lateral: f64,
    /// Heading in `map` \[rad\].
    pub heading: f64,
    /// Yaw rate \[rad/s\].
    pub yaw_rate: f64,
    /// Greatest standard deviation of the position \[m\].
    pub sigma: f64,
    /// Position in `map` \[m\].
    pub position: [f64; 2],
}

impl PoseSample {
    /// From a message; None without a position on a raceline.
    pub fn of(header: &Header, pose: &Pose) -> Option<Self> {
        let track = pose.track?;
        Some(Self {
            at: header.sensor,
            s: track.s,
            lap: pose.lap,
            speed: pose.twist.linear_x.hypot(pose.twist.linear_y),
            lateral: track.d,
            heading: pose.pose.heading,
            yaw_rate: pose.twist.angular,
            sigma: greatest_sigma(pose.covariance),
            position: [pose.pose.x, pose.pose.y],
        })
    }
}

/// Square root of the greater eigenvalue of the position's covariance \[m\].
fn greatest_sigma(c: Covariance) -> f64 {
    let (xx, xy, yy) = (f64::from(c.xx), f64::from(c.xy), f64::from(c.yy));
    let half = ((xx - yy) / 2.0).hypot(xy);
    (f64::midpoint(xx, yy) + half).max(0.0).sqrt()
}

/// Values with their channels.
type Values<const N: usize> = [(Channel, f32); N];

/// Values at a place.
#[derive(Debug, Clone, Copy)]
struct Sample<const N: usize> {
    /// When it was true \[unix ns\].
    at: i64,
    s: f64,
    values: Values<N>,
}

/// All laps of one car, the last [`LapBook::MAX_LAPS`].
#[derive(Debug, Clone, Default)]
pub struct LapBook {
    line: Option<Arc<TrackLine>>,
    laps: VecDeque<Arc<LapTrace>>,
    open: Option<OpenLap>,
    /// Laps begun here.
    count: u64,
    pose: Option<Sample<4>>,
    /// The newest pose as it came.
    last: Option<PoseSample>,
    health: Option<Sample<9>>,
    update_ms: Option<f32>,
    sigma: Option<f32>,
    /// True while the newest lap in `laps` may still get its last cells of health and its time.
    closing: bool,
}

/// The lap that is being driven.
#[derive(Debug, Clone)]
struct OpenLap {
    trace: LapTrace,
    whole: bool,
    check: LapCheck,
}

impl LapBook {
    /// Most laps kept.
    pub const MAX_LAPS: usize = 500;
    /// A longer time between two messages is a gap \[ns\].
    const GAP: i64 = Step::GAP;

    #[cfg(test)]
    pub(super) fn of_lap(lap: LapTrace) -> Self {
        Self {
            laps: VecDeque::from([Arc::new(lap)]),
            ..Self::default()
        }
    }

    /// The car drives along this line from now on.
    pub fn set_line(&mut self, line: Arc<TrackLine>) {
        if self.line.as_ref().is_some_and(|old| old.key == line.key) {
            return;
        }
        self.line = Some(line);
        self.open = None;
        (self.pose, self.last, self.health) = (None, None, None);
    }

    /// The line that the car drives along.
    pub fn line(&self) -> Option<&Arc<TrackLine>> {
        self.line.as_ref()
    }

    /// The laps that have ended and are complete, the oldest first.
    pub fn laps(&self) -> impl DoubleEndedIterator<Item = &Arc<LapTrace>> {
        self.laps.iter().take(self.laps.len() - usize::from(self.closing))
    }

    /// Number of laps that have ended and are complete.
    pub fn ended(&self) -> u64 {
        self.count
            .saturating_sub(u64::from(self.open.is_some()) + u64::from(self.closing))
    }

    /// The lap that is being driven, as far as it is known.
    pub fn open(&self) -> Option<&LapTrace> {
        self.open.as_ref().map(|open| &open.trace)
    }

    /// The newest value of a channel; None before there is one.
    pub fn newest(&self, channel: Channel) -> Option<f64> {
        let of = |values: &[(Channel, f32)]| {
            values
                .iter()
                .find(|(other, _)| *other == channel)
                .map(|(_, v)| f64::from(*v))
        };
        match channel {
            Channel::UpdateTime => self.update_ms.map(f64::from),
            Channel::Sigma => self.sigma.map(f64::from),
            _ => self
                .pose
                .and_then(|pose| of(&pose.values))
                .or_else(|| self.health.and_then(|health| of(&health.values))),
        }
    }

    /// Arc length of the newest pose \[m\].
    pub fn s(&self) -> Option<f64> {
        self.pose.map(|pose| pose.s)
    }

    /// Ends the lap that is being driven, because nothing follows.
    pub fn end(&mut self) {
        self.closing = false;
        if let Some(open) = self.open.take() {
            let mut trace = open.trace;
            if trace.kind == LapKind::Flying {
                trace.kind = LapKind::In;
            }
            if trace.covered() > 0.0 {
                self.keep(trace);
            }
        }
    }

    /// Adds a pose.
    pub fn on_pose(&mut self, pose: &PoseSample) {
        let Some(line) = self.line.clone() else { return };
        let length = line.length;
        if !(0.0..=length).contains(&pose.s) {
            return;
        }
        let heading = maps::wrap_angle(pose.heading - line.heading(pose.s));
        let here = Sample {
            at: pose.at,
            s: pose.s,
            values: [
                (Channel::Speed, pose.speed as f32),
                (Channel::Lateral, pose.lateral as f32),
                (Channel::HeadingError, heading as f32),
                (Channel::YawRate, pose.yaw_rate as f32),
            ],
        };
        let before = self.pose.filter(|before| before.at < pose.at);
        if self.pose.is_some() && before.is_none() {
            return;
        }
        let sigma = pose.sigma as f32;
        self.sigma = Some(sigma);
        self.pose = Some(here);
        let last = self.last.replace(*pose);
        if let Some(open) = &mut self.open {
            open.check.on_pose(last.as_ref(), pose);
        }
        if self.open.is_none() {
            self.begin(pose.lap, pose.at, LapKind::Out, &line);
        }
        let Some(mut before) = before else { return };
        let Some(step) = last.and_then(|last| Step::between(&last, pose, length)) else {
            // A lap that the car counted without being seen at the line.
            let crossed = pose.s - before.s < -length / 2.0;
            if self.open.as_ref().is_some_and(|open| open.trace.lap != pose.lap)
                && (crossed || pose.at - before.at > Self::GAP)
            {
                self.end();
                self.begin(pose.lap, pose.at, LapKind::Out, &line);
            }
            return;
        };
        if let Some(open) = &mut self.open {
            open.check.on_step(&step, length, false);
        }
        if step.over_line {
            let line_at = step.when(length).unwrap_or(pose.at);
            let share = (line_at - before.at) as f64 / (pose.at - before.at) as f64;
            let mut on_line = here;
            on_line.at = line_at;
            on_line.s = length;
            for (i, value) in on_line.values.iter_mut().enumerate() {
                value.1 = mix(before.values[i].1, here.values[i].1, share as f32);
            }
            self.fill_pose(&before, &on_line, sigma);
            self.close();
            self.begin(pose.lap, line_at, LapKind::Flying, &line);
            if let Some(open) = &mut self.open {
                open.check.on_step(&step, length, true);
            }
            on_line.s = 0.0;
            before = on_line;
            self.fill_pose(&before, &here, sigma);
        } else {
            self.fill_pose(&before, &here, sigma);
        }
    }

    fn begin(&mut self, lap: u32, at: i64, kind: LapKind, line: &Arc<TrackLine>) {
        self.count += 1;
        let mut trace = LapTrace::new(self.count, lap, at, kind, line.clone());
        let whole = kind == LapKind::Flying;
        if whole {
            trace.edges[0] = 0.0;
        }
        self.open = Some(OpenLap {
            trace,
            whole,
            check: LapCheck::default(),
        });
    }

    /// Ends the open lap at the start line.
    fn close(&mut self) {
        let Some(open) = self.open.take() else { return };
        let mut trace = open.trace;
        if open.whole
            && let Some(reason) = open.check.verdict(trace.line.length)
        {
            trace.kind = LapKind::Invalid(reason);
        }
        self.keep(trace);
        self.closing = true;
    }

    fn keep(&mut self, trace: LapTrace) {
        if self.laps.len() == Self::MAX_LAPS {
            self.laps.pop_front();
        }
        self.laps.push_back(Arc::new(trace));
    }

    /// Fills the open lap from one pose to the next.
    fn fill_pose(&mut self, from: &Sample<4>, to: &Sample<4>, sigma: f32) {
        let Some(open) = &mut self.open else { return };
        let trace = &mut open.trace;
        let cell = trace.line.cell();
        let span = to.s - from.s;
        if span <= 0.0 {
            return;
        }
        let first = (from.s / cell).floor() as usize;
        for edge in first..=trace.line.cells {
            let at = edge as f64 * cell;
            if at > to.s + 1e-9 {
                break;
            }
            if at > from.s && trace.edges[edge].is_nan() {
                let time = from.at as f64 + (at - from.s) / span * (to.at - from.at) as f64;
                trace.edges[edge] = ((time - trace.begun as f64) * 1e-9) as f32;
            }
        }
        for index in first..trace.line.cells {
            let at = (index as f64 + 0.5) * cell;
            if at > to.s {
                break;
            }
            if at > from.s {
                let share = ((at - from.s) / span) as f32;
                for ((channel, a), (_, b)) in from.values.iter().zip(&to.values) {
                    trace.set_value(*channel, index, mix(*a, *b, share));
                }
                trace.set_value(Channel::Sigma, index, sigma);
                if let Some(ms) = self.update_ms {
                    trace.set_value(Channel::UpdateTime, index, ms);
                }
            }
        }
    }

    /// Adds a health message, at the place of the newest pose.
    pub fn on_health(&mut self, at: i64, health: &Health) {
        if let Some(open) = &mut self.open {
            open.check.on_state(health.state);
        }
        let (Some(line), Some(pose), Some(metrics)) = (&self.line, self.pose, &health.metrics) else {
            return;
        };
        let length = line.length;
        let here = Sample {
            at,
            s: pose.s,
            values: [
                (Channel::Alignment, metrics.alignment),
                (Channel::Residual, metrics.residual),
                (Channel::SpreadAlong, metrics.spread_along),
                (Channel::SpreadAcross, metrics.spread_across),
                (Channel::Slip, metrics.slip),
                (Channel::Correction, metrics.innovation),
                (Channel::LongBeams, metrics.long_beams),
                (Channel::ShortBeams, metrics.short_beams),
                (Channel::Age, metrics.age_p99 * 1e3),
            ],
        };
        let serious = health
            .causes
            .iter()
            .filter(|cause| cause.severity >= Severity::Warning);
        let causes: Vec<CauseKind> = serious.map(|cause| cause.kind).collect();
        let before = self.health.replace(here);
        let Some(before) = before.filter(|before| (1..=Self::GAP).contains(&(at - before.at))) else {
            self.closing = false;
            return;
        };
        let ahead = here.s - before.s;
        if ahead < -length / 2.0 {
            // Over the start line: the end of the last lap, then the begin of this one.
            let end = Sample {
                s: here.s + length,
                ..here
            };
            if self.closing
                && let Some(last) = self.laps.back_mut()
            {
                fill_health(Arc::make_mut(last), &before, &end, &causes, health.state);
            }
            let begin = Sample {
                s: before.s - length,
                ..before
            };
            if let Some(open) = &mut self.open {
                fill_health(&mut open.trace, &begin, &here, &causes, health.state);
            }
        } else if ahead > 0.0
            && ahead < length / 4.0
            && let Some(open) = &mut self.open
        {
            fill_health(&mut open.trace, &before, &here, &causes, health.state);
        }
        // By now the lap before has all that it can get but for its time, which may come late.
        if self.laps.back().is_some_and(|last| last.time_s.is_some())
            || self.open().is_some_and(|open| at - open.begun > 2 * Self::GAP)
        {
            self.closing = false;
        }
    }

    /// Adds a load message.
    pub fn on_load(&mut self, load: &Load) {
        self.update_ms = Some(load.update_us.p99 * 1e-3);
    }

    /// Adds an event.
    pub fn on_event(&mut self, event: &Event) {
        if let Some(open) = &mut self.open {
            open.check.on_event(&event.kind);
        }
        if let EventKind::Lap { lap, time, set } = &event.kind {
            if let Some(open) = self.open.as_mut().filter(|open| open.trace.lap == *lap) {
                // The event comes before the first pose of the next lap.
                open.trace.finish(*time, set);
            } else if let Some(trace) = self.laps.iter_mut().rev().take(3).find(|trace| trace.lap == *lap) {
                Arc::make_mut(trace).finish(*time, set);
            }
        }
    }
}

fn mix(a: f32, b: f32, share: f32) -> f32 {
    a + share * (b - a)
}

fn fill_health(trace: &mut LapTrace, from: &Sample<9>, to: &Sample<9>, causes: &[CauseKind], state: State) {
    let causes = trace.cause_bits(causes);
    let cell = trace.line.cell();
    let first = (from.s / cell).floor().max(0.0) as usize;
    for index in first..trace.line.cells {
        let at = (index as f64 + 0.5) * cell;
        if at > to.s {
            break;
        }
        if at > from.s {
            let share = ((at - from.s) / (to.s - from.s)) as f32;
            for ((channel, a), (_, b)) in from.values.iter().zip(&to.values) {
                trace.set_value(*channel, index, mix(*a, *b, share));
            }
            trace.causes[index] |= causes;
            trace.states[index] = Some(state);
        }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::super::Invalid;
    use super::super::track_line::tests::ring;
    use super::*;
    use protocol::{Cause, Metrics};
    use std::f64::consts::TAU;

    const LENGTH: f64 = 3.0 * TAU;

    /// Drives `laps` whole laps at 40 poses and 10 healths a second; `speed(lap, s)` \[m/s\].
    pub(in super::super) fn drive(laps: u32, speed: impl Fn(u32, f64) -> f64) -> LapBook {
        let mut book = LapBook::default();
        book.set_line(Arc::new(TrackLine::of(&ring(|_| false)).expect("a line")));
        let (mut s, mut at, mut lap, mut tick) = (LENGTH - 2.0, 1_000_000_000_000, 0, 0_u32);
        let mut begun = 0;
        while lap <= laps || s < 2.0 {
            let v = speed(lap, s);
            book.on_pose(&PoseSample {
                at,
                s,
                lap,
                speed: v,
                lateral: -0.1,
                heading: maps::wrap_angle(s / 3.0 + TAU / 4.0 + 0.05),
                yaw_rate: v / 3.0,
                sigma: 0.02,
                position: [3.0 * (s / 3.0).cos(), 3.0 * (s / 3.0).sin()],
            });
            if tick.is_multiple_of(4) {
                let slips = (5.0..7.0).contains(&s);
                book.on_health(at, &health(s / LENGTH, slips));
            }
            tick += 1;
            s += v * 0.025;
            at += 25_000_000;
            if s >= LENGTH {
                s -= LENGTH;
                let crossed = at - (s / v * 1e9) as i64;
                let time = (lap > 0).then(|| (crossed - begun) as f64 * 1e-9);
                book.on_event(&Event {
                    kind: EventKind::Lap {
                        lap,
                        time,
                        set: "hq".into(),
                    },
                    update: 1,
                    who: None,
                    command: None,
                });
                begun = crossed;
                lap += 1;
            }
        }
        book
    }

    fn health(alignment: f64, slips: bool) -> Health {
        let cause = Cause {
            kind: CauseKind::Slip,
            severity: Severity::Warning,
            value: None,
            limit: None,
        };
        Health {
            state: State::Localized,
            since: 0,
            causes: slips.then_some(cause).into_iter().collect(),
            update: 1,
            metrics: Some(Metrics {
                alignment: alignment as f32,
                ..Metrics::default()
            }),
            proposal: None,
            auto: false,
        }
    }

    #[test]
    fn a_lap_has_its_times_and_every_channel_at_every_place() {
        let book = drive(3, |_, _| 4.0);
        let laps: Vec<_> = book.laps().cloned().collect();
        assert_eq!(laps[0].kind, LapKind::Out);
        let lap = &laps[1];
        assert_eq!(
            (lap.lap, lap.kind, lap.set.as_deref()),
            (1, LapKind::Flying, Some("hq"))
        );
        assert!((lap.time_s.expect("known") - LENGTH / 4.0).abs() < 1e-3);
        for i in 0..=10 {
            let s = LENGTH * f64::from(i) / 10.0;
            let time = lap.time_at(s).expect("driven");
            assert!((time - s / 4.0).abs() < 2e-3, "{s}: {time}");
        }
        let all = |channel, expected: f64, tolerance: f64| {
            for value in lap.channel(channel) {
                assert!(
                    (f64::from(*value) - expected).abs() < tolerance,
                    "{channel:?}: {value}"
                );
            }
        };
        all(Channel::Speed, 4.0, 1e-6);
        all(Channel::Lateral, -0.1, 1e-6);
        all(Channel::HeadingError, 0.05, 0.01);
        all(Channel::Sigma, 0.02, 1e-6);
        // Interpolated between messages 0.4 m apart, but at the line from 1 to 0.
        for (i, value) in lap
            .channel(Channel::Alignment)
            .iter()
            .enumerate()
            .skip(2)
            .take(70)
        {
            let expected = (i as f64 + 0.5) / 75.0;
            assert!((f64::from(*value) - expected).abs() < 0.01, "{i}: {value}");
        }
        assert!(lap.channel(Channel::Alignment).iter().all(|v| v.is_finite()));
        let slipping = (0..75)
            .filter(|cell| lap.causes(*cell).eq([CauseKind::Slip]))
            .count();
        assert!((7..=10).contains(&slipping), "{slipping} cells of 0.25 m for 2 m");
    }

    #[test]
    fn a_slower_lap_is_behind_where_it_was_slower() {
        let book = drive(2, |lap, s| if lap == 2 && s < LENGTH / 2.0 { 3.0 } else { 4.0 });
        let laps: Vec<_> = book.laps().filter(|lap| lap.counts()).cloned().collect();
        let (reference, slow) = (&laps[0], &laps[1]);
        let delta = |s| slow.delta(reference, s).expect("driven");
        let lost = LENGTH / 2.0 / 3.0 - LENGTH / 2.0 / 4.0;
        assert!(delta(0.0).abs() < 1e-6);
        assert!(
            (delta(LENGTH / 2.0) - lost).abs() < 0.01,
            "{}",
            delta(LENGTH / 2.0)
        );
        assert!((delta(LENGTH) - lost).abs() < 0.01);
        let times = slow.time_s.expect("known") - reference.time_s.expect("known");
        assert!((delta(LENGTH) - times).abs() < 0.01);
    }

    #[test]
    fn laps_that_do_not_count_say_why() {
        let stops = drive(2, |lap, s| {
            if lap == 1 && (8.0..8.1).contains(&s) {
                0.05
            } else {
                4.0
            }
        });
        let kinds: Vec<_> = stops.laps().map(|lap| lap.kind).collect();
        assert_eq!(
            kinds,
            [LapKind::Out, LapKind::Invalid(Invalid::Stopped), LapKind::Flying]
        );

        let mut book = drive(1, |_, _| 4.0);
        let open = book.open().expect("a lap").clone();
        assert_eq!(open.lap, 2);
        let at = open.begun + 3_000_000_000;
        let far = PoseSample {
            at,
            s: 12.0,
            lap: 2,
            speed: 4.0,
            lateral: 0.0,
            heading: 0.0,
            yaw_rate: 0.0,
            sigma: 0.0,
            position: [0.0; 2],
        };
        book.on_pose(&far);
        book.end();
        let last = book.laps().next_back().expect("a lap");
        assert_eq!(last.kind, LapKind::In);
        assert!(last.covered() < 0.1);
    }

    #[test]
    fn poses_off_the_line_and_out_of_order_change_nothing() {
        let mut book = drive(1, |_, _| 4.0);
        let before = format!("{book:?}");
        for s in [f64::NAN, -1.0, 1e9] {
            let mut pose = PoseSample {
                at: i64::MAX,
                s,
                lap: 1,
                speed: 1.0,
                lateral: 0.0,
                heading: 0.0,
                yaw_rate: 0.0,
                sigma: 0.0,
                position: [0.0; 2],
            };
            book.on_pose(&pose);
            pose.at = 0;
            pose.s = 1.0;
            book.on_pose(&pose);
        }
        assert_eq!(format!("{book:?}"), before);
    }
}
