//! Decides which run of a car is followed, and which messages are dropped. Pure: the caller passes the time.
//!
//! ```text
//! message --> of the followed run?   yes --> does its number leap?  no --> passed on
//!                | no                              | yes: held until the next one follows it
//!                v
//!             held --> the followed run has ended, and the other one is proven --> followed, and passed on
//!                  --> both are heard --> two senders: dropped, counted, an alarm
//! ```
//!
//! A run is known by its liveliness token, never by the order of run ids: the clock of a car that restarts may be behind. A
//! car of an older version has no such token. Its new run is proven by a few messages, and its old run has ended when it is
//! silent.

use std::collections::{BTreeMap, BTreeSet};

use protocol::{CarName, Topic};

use super::gap_recovery::MessageId;
use crate::event::Rejection;

/// A run that sends nothing for this long may be replaced, even if nothing shows that it has ended \[ns\].
const SILENT: i64 = SECOND;
/// Two runs that are heard side by side for this long are two senders \[ns\].
const SIDE_BY_SIDE: i64 = 2 * SECOND;
/// Messages that prove a run without a token.
const PROOF: u64 = 3;
/// Messages that are held until their run is followed.
const HELD: usize = 2000;
/// A number this far after the last one must be followed by another before it is believed.
const LEAP: u64 = 40;
/// The next message after a leap is at most this far on.
const NEXT: u64 = 1000;
/// No stream gets as far as this number.
const MOST: u64 = 1 << 62;
/// Period at which dropped messages are reported \[ns\].
const REPORT: i64 = SECOND;
/// Tokens that are known of one car.
const TOKENS: usize = 16;

const SECOND: i64 = 1_000_000_000;

/// Messages that were dropped for one reason.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Rejected {
    pub(crate) car: CarName,
    /// The last of them.
    pub(crate) id: MessageId,
    /// How many.
    pub(crate) count: u64,
    pub(crate) reason: Rejection,
}

/// The runs of all cars. `T` is a message.
#[derive(Debug)]
pub(crate) struct RunGate<T>(BTreeMap<CarName, CarGate<T>>);

impl<T> Default for RunGate<T> {
    fn default() -> Self {
        Self(BTreeMap::new())
    }
}

#[derive(Debug)]
struct CarGate<T> {
    /// The runs that have a liveliness token.
    tokens: BTreeSet<u64>,
    /// The run that is followed, and when it was last heard \[unix ns\].
    followed: Option<(u64, i64)>,
    /// The highest number of each stream.
    numbers: BTreeMap<Topic, u64>,
    /// A message of each stream whose number has leapt.
    leaps: BTreeMap<Topic, (MessageId, T)>,
    other: Option<OtherRun<T>>,
    rejected: BTreeMap<(Topic, Rejection), (MessageId, u64)>,
    reported: i64,
}

/// A run that is not followed.
#[derive(Debug)]
struct OtherRun<T> {
    run_id: u64,
    /// When it was first and last heard \[unix ns\].
    since: i64,
    heard: i64,
    messages: u64,
    held: Vec<(MessageId, T)>,
}

impl<T> Default for CarGate<T> {
    fn default() -> Self {
        Self {
            tokens: BTreeSet::new(),
            followed: None,
            numbers: BTreeMap::new(),
            leaps: BTreeMap::new(),
            other: None,
            rejected: BTreeMap::new(),
            reported: 0,
        }
    }
}

impl<T> RunGate<T> {
    /// Notes that the token of a run has appeared or vanished at `at` \[unix ns\]. Returns what is passed on.
    pub(crate) fn token(
        &mut self,
        car: &CarName,
        run_id: u64,
        present: bool,
        at: i64,
    ) -> Vec<(MessageId, T)> {
        let car = self.0.entry(car.clone()).or_default();
        if !present {
            car.tokens.remove(&run_id);
        } else if car.tokens.len() < TOKENS {
            car.tokens.insert(run_id);
        }
        car.switch(at)
    }

    /// Adds a message that arrived at `at` \[unix ns\]. `resent` is true for one that the car sent on request. Returns what is
    /// passed on.
    pub(crate) fn arrive(
        &mut self,
        car: &CarName,
        id: MessageId,
        resent: bool,
        message: T,
        at: i64,
    ) -> Vec<(MessageId, T)> {
        self.0
            .entry(car.clone())
            .or_default()
            .arrive(id, resent, message, at)
    }

    /// Notes that a car in this run has answered a query at `at` \[unix ns\]. False when that run is not followed.
    pub(crate) fn answered(&mut self, car: &CarName, run_id: u64, at: i64) -> bool {
        let car = self.0.entry(car.clone()).or_default();
        match &mut car.followed {
            Some((followed, heard)) if *followed == run_id => {
                *heard = at;
                true
            }
            Some(_) => {
                if car.take_over_by(run_id, at)
                    && let Some(other) = &mut car.other
                {
                    other.messages += PROOF;
                    other.heard = at;
                }
                false
            }
            None => {
                car.followed = Some((run_id, at));
                true
            }
        }
    }

    /// What is passed on because time has passed until `now` \[unix ns\].
    pub(crate) fn tick(&mut self, now: i64) -> Vec<(CarName, MessageId, T)> {
        let mut out = Vec::new();
        for (name, car) in &mut self.0 {
            let passed = car.switch(now);
            out.extend(
                passed
                    .into_iter()
                    .map(|(id, message)| (name.clone(), id, message)),
            );
        }
        out
    }

    /// The messages that were dropped, of each car once a second.
    pub(crate) fn take_rejected(&mut self, now: i64) -> Vec<Rejected> {
        let mut out = Vec::new();
        for (name, car) in &mut self.0 {
            if now - car.reported < REPORT || car.rejected.is_empty() {
                continue;
            }
            car.reported = now;
            let rejected = std::mem::take(&mut car.rejected);
            out.extend(rejected.into_iter().map(|((_, reason), (id, count))| Rejected {
                car: name.clone(),
                id,
                count,
                reason,
            }));
        }
        out
    }
}

impl<T> CarGate<T> {
    fn arrive(&mut self, id: MessageId, resent: bool, message: T, at: i64) -> Vec<(MessageId, T)> {
        if id.number > MOST {
            self.reject(id, Rejection::Leap);
            return Vec::new();
        }
        let Some((followed, heard)) = &mut self.followed else {
            if self.tokens.is_empty() || self.tokens.contains(&id.run_id) {
                self.followed = Some((id.run_id, at));
                return self.pass(id, true, message);
            }
            return self.hold(id, message, at);
        };
        if *followed != id.run_id {
            return self.hold(id, message, at);
        }
        *heard = at;
        self.pass(id, resent, message)
    }

    /// Passes on a message of the followed run, unless its number leaps.
    fn pass(&mut self, id: MessageId, trusted: bool, message: T) -> Vec<(MessageId, T)> {
        let highest = self.numbers.get(&id.topic).copied();
        let leaps = highest.is_some_and(|highest| id.number.saturating_sub(highest) > LEAP);
        let before = self.leaps.remove(&id.topic);
        if !leaps || trusted {
            self.numbers
                .insert(id.topic, highest.unwrap_or_default().max(id.number));
            // A resent message says nothing about one that has leapt ahead.
            match before {
                Some(before) if trusted => drop(self.leaps.insert(id.topic, before)),
                Some((before, _)) if before.number > id.number => self.reject(before, Rejection::Leap),
                _ => {}
            }
            return vec![(id, message)];
        }
        match before {
            Some((before, held)) if (1..=NEXT).contains(&id.number.saturating_sub(before.number)) => {
                self.numbers.insert(id.topic, id.number);
                vec![(before, held), (id, message)]
            }
            before => {
                if let Some((before, _)) = before {
                    self.reject(before, Rejection::Leap);
                }
                self.leaps.insert(id.topic, (id, message));
                Vec::new()
            }
        }
    }

    /// Holds a message of another run than the followed one.
    fn hold(&mut self, id: MessageId, message: T, at: i64) -> Vec<(MessageId, T)> {
        if !self.take_over_by(id.run_id, at) {
            self.reject(id, Rejection::OtherRun);
            return Vec::new();
        }
        let side_by_side = self.followed.is_some_and(|(_, heard)| at - heard < SILENT);
        let mut two_senders = false;
        if let Some(other) = &mut self.other {
            other.heard = at;
            other.messages += 1;
            two_senders = side_by_side && at - other.since > SIDE_BY_SIDE && other.messages > PROOF;
            if !two_senders && other.held.len() < HELD {
                other.held.push((id, message));
                return self.switch(at);
            }
            if two_senders {
                let held = std::mem::take(&mut other.held);
                for (id, _) in held {
                    self.reject(id, Rejection::TwoSenders);
                }
            }
        }
        self.reject(
            id,
            if two_senders {
                Rejection::TwoSenders
            } else {
                Rejection::OtherRun
            },
        );
        self.switch(at)
    }

    /// Makes a run the one that may be followed next. False while another one has a better claim.
    fn take_over_by(&mut self, run_id: u64, at: i64) -> bool {
        if let Some(other) = &self.other {
            if other.run_id == run_id {
                return true;
            }
            let better = self.tokens.contains(&run_id) && !self.tokens.contains(&other.run_id);
            if at - other.heard < SILENT && !better {
                return false;
            }
        }
        self.drop_other();
        self.other = Some(OtherRun {
            run_id,
            since: at,
            heard: at,
            messages: 0,
            held: Vec::new(),
        });
        true
    }

    fn drop_other(&mut self) {
        for (id, _) in self.other.take().map(|other| other.held).unwrap_or_default() {
            self.reject(id, Rejection::OtherRun);
        }
    }

    /// Follows the other run if it is proven and the followed one has ended.
    fn switch(&mut self, now: i64) -> Vec<(MessageId, T)> {
        let Some(other) = &self.other else {
            return Vec::new();
        };
        let token = |run_id| self.tokens.contains(&run_id);
        let proven = if self.tokens.is_empty() {
            other.messages >= PROOF
        } else {
            token(other.run_id)
        };
        let ended = self.followed.is_none_or(|(run_id, heard)| {
            now - heard >= SILENT || (!self.tokens.is_empty() && !token(run_id))
        });
        if !(proven && ended && now - other.heard < 5 * SECOND) {
            if now - other.heard > 5 * SECOND {
                self.drop_other();
            }
            return Vec::new();
        }
        let Some(other) = self.other.take() else {
            return Vec::new();
        };
        self.followed = Some((other.run_id, other.heard));
        self.numbers.clear();
        for (id, _) in std::mem::take(&mut self.leaps).into_values() {
            self.reject(id, Rejection::Leap);
        }
        for (id, _) in &other.held {
            let highest = self.numbers.entry(id.topic).or_default();
            *highest = id.number.max(*highest);
        }
        other.held
    }

    fn reject(&mut self, id: MessageId, reason: Rejection) {
        let (last, count) = self.rejected.entry((id.topic, reason)).or_insert((id, 0));
        *last = id;
        *count += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Harness {
        gate: RunGate<()>,
        car: CarName,
        now: i64,
        /// The run and the number of everything passed on.
        out: Vec<(u64, u64)>,
        rejected: BTreeMap<Rejection, u64>,
    }

    impl Harness {
        fn new() -> Self {
            Self {
                gate: RunGate::default(),
                car: CarName::new("car-1").expect("a good name"),
                now: SECOND,
                out: Vec::new(),
                rejected: BTreeMap::new(),
            }
        }

        fn token(&mut self, run_id: u64, present: bool) {
            let passed = self.gate.token(&self.car, run_id, present, self.now);
            self.out
                .extend(passed.iter().map(|(id, ())| (id.run_id, id.number)));
        }

        /// Messages at 40 Hz.
        fn arrive(&mut self, run_id: u64, numbers: impl IntoIterator<Item = u64>) {
            for number in numbers {
                self.now += SECOND / 40;
                let id = MessageId {
                    topic: Topic::Pose,
                    run_id,
                    number,
                };
                let passed = self.gate.arrive(&self.car, id, false, (), self.now);
                self.out
                    .extend(passed.iter().map(|(id, ())| (id.run_id, id.number)));
                let passed = self.gate.tick(self.now);
                self.out
                    .extend(passed.iter().map(|(_, id, ())| (id.run_id, id.number)));
            }
        }

        fn rejected(&mut self) -> &BTreeMap<Rejection, u64> {
            self.now += 6 * SECOND;
            self.gate.tick(self.now);
            for rejected in self.gate.take_rejected(self.now) {
                *self.rejected.entry(rejected.reason).or_default() += rejected.count;
            }
            &self.rejected
        }
    }

    fn run(run_id: u64, numbers: impl IntoIterator<Item = u64>) -> Vec<(u64, u64)> {
        numbers.into_iter().map(|number| (run_id, number)).collect()
    }

    // A car whose clock was behind after a power cut once stayed frozen on its old run.
    #[test]
    fn a_car_that_restarts_with_its_clock_behind_is_followed_with_all_its_messages() {
        for has_tokens in [true, false] {
            let mut harness = Harness::new();
            if has_tokens {
                harness.token(1_000_000, true);
            }
            harness.arrive(1_000_000, 1..=100);
            if has_tokens {
                harness.token(1_000_000, false);
                harness.token(5, true);
            }
            harness.arrive(5, 1..=100);
            assert_eq!(harness.out[100..], run(5, 1..=100), "tokens: {has_tokens}");
            assert!(harness.rejected().is_empty());
        }
    }

    // One forged header once stopped a car until the pit wall was restarted.
    #[test]
    fn a_forged_header_stops_nothing() {
        for (run_id, number) in [
            (u64::MAX, 1),
            (u64::MAX, u64::MAX),
            (7, u64::MAX),
            (7, 1 << 40),
            (7, 5000),
        ] {
            let mut harness = Harness::new();
            harness.token(7, true);
            harness.arrive(7, 1..=100);
            harness.arrive(run_id, [number]);
            harness.arrive(7, 101..=200);
            assert_eq!(harness.out, run(7, 1..=200), "{run_id}, {number}");
            assert_eq!(harness.rejected().values().sum::<u64>(), 1);
        }
    }

    #[test]
    fn a_forged_header_at_first_is_replaced_within_a_second() {
        let mut harness = Harness::new();
        harness.arrive(u64::MAX, [9]);
        harness.arrive(7, 1..=100);
        assert_eq!(harness.out[1..], run(7, 1..=100));
    }

    #[test]
    fn a_leap_after_a_cut_link_is_followed() {
        let mut harness = Harness::new();
        harness.arrive(7, 1..=10);
        harness.arrive(7, 50_000..=50_100);
        assert_eq!(harness.out.len(), 111);
        assert!(harness.rejected().is_empty());
    }

    #[test]
    fn of_two_senders_the_first_is_followed_and_the_other_is_counted() {
        let mut harness = Harness::new();
        harness.token(7, true);
        harness.arrive(7, 1..=100);
        harness.token(9, true);
        for number in 1..=200 {
            harness.arrive(7, [100 + number]);
            harness.arrive(9, [number]);
        }
        assert_eq!(harness.out, run(7, 1..=300));
        assert_eq!(harness.rejected().get(&Rejection::TwoSenders), Some(&200));
        // The first one leaves.
        harness.token(7, false);
        harness.arrive(9, 201..=203);
        assert_eq!(harness.out[300..], run(9, 201..=203));
    }

    #[test]
    fn a_run_without_a_token_is_not_followed_while_the_car_has_one() {
        let mut harness = Harness::new();
        harness.token(7, true);
        harness.arrive(7, 1..=10);
        harness.now += 3 * SECOND;
        harness.arrive(8, 1..=10);
        assert_eq!(harness.out.len(), 10);
        harness.arrive(7, 11..=20);
        assert_eq!(harness.out, run(7, 1..=20));
        assert_eq!(harness.rejected().get(&Rejection::OtherRun), Some(&10));
    }
}
