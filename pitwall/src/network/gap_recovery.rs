//! Decides which missing messages to request from the cars, and when. Pure: the caller passes the time and sends the queries.
//!
//! ```text
//! messages --> arrive --> messages in order                      (the others are held back for a while)
//! time     --> due    --> queries to cars --> answered: the messages, what else the car has, its last numbers
//! ```
//!
//! Each car has at most one query under way, and replies are short. On a slow link they take a small share of it. On a fast
//! link the next query follows at once.
//!
//! Each connection has one gap recovery: a page and the recorder behind it share the messages. Several programs on one
//! laptop do not. Each requests its own, and a slow link carries the missing messages several times. On such a link,
//! record from the page.
//!
//! When a recording ends, a final sync asks every car for its last numbers and requests what it had sent by then. Otherwise
//! the streams would end up to [`POLL`] and [`TRANSIT`] apart. A car that stops gets one, too: it answers for a while after its
//! last message.

use std::collections::BTreeMap;

use protocol::{CarName, Kept, MissingRequest, Topic, Wanted};

use super::reorder_buffer::ReorderBuffer;
use crate::event::{RunEnd, SentRange};
use crate::fleet::Fleet;

/// Period at which a car is asked for its last numbers. A lost message is noticed with the next one or with this \[ns\].
const POLL: i64 = SECOND;
/// Delay of the next query after one that nobody answered \[ns\].
const RETRY: i64 = SECOND / 3;
/// A message that was sent may be in transit for this long before it counts as missing \[ns\].
const TRANSIT: i64 = SECOND;
/// Replaces [`TRANSIT`] and [`POLL`] during a final sync \[ns\].
const FINAL_SYNC: i64 = SECOND / 10;
/// Earlier runs of a car that are remembered.
const RUNS: usize = 16;
/// No stream gets as far as this number: a reply that says so is not believed.
const MOST: u64 = 1 << 62;
/// Limits of a reply's size \[bytes\]. It grows when the round trip is below the first time, and shrinks above the second \[ns\].
const BUDGET: [u32; 2] = [4_000, 48_000];
const ROUND_TRIP: [i64; 2] = [SECOND / 20, SECOND / 5];

const SECOND: i64 = 1_000_000_000;

/// Identifies a message of a car.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct MessageId {
    /// The stream.
    pub(crate) topic: Topic,
    /// See [`protocol::Header`].
    pub(crate) run_id: u64,
    /// See [`protocol::Header`]; 0 is not counted.
    pub(crate) number: u64,
}

/// A query to send to a car.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct MissingQuery {
    /// The car.
    pub(crate) car: CarName,
    /// The messages to request.
    pub(crate) request: MissingRequest,
    /// True when an operator sees these messages. False when only a recording needs them.
    pub(crate) urgent: bool,
}

/// The streams of all cars. `T` is a message.
#[derive(Debug)]
pub(crate) struct GapRecovery<T> {
    cars: BTreeMap<CarName, Car<T>>,
    /// True when the full-rate streams are recovered, too.
    recorded: bool,
}

impl<T> Default for GapRecovery<T> {
    fn default() -> Self {
        Self {
            cars: BTreeMap::new(),
            recorded: false,
        }
    }
}

#[derive(Debug)]
struct Car<T> {
    run_id: Option<u64>,
    /// Earlier runs, the newest last. A car of two that send at once may come back.
    before: Vec<u64>,
    streams: BTreeMap<Topic, ReorderBuffer<T>>,
    /// When the query under way was sent \[unix ns\].
    queried: Option<i64>,
    /// When to send the next query \[unix ns\].
    due: i64,
    budget: u32,
    final_sync: Option<FinalSync>,
    /// True when the run has sent its last message.
    stopped: bool,
}

/// State of a car's final sync.
#[derive(Debug)]
enum FinalSync {
    /// It was requested at this time \[unix ns\].
    Requested(i64),
    /// The car's run, and what had not been released of each stream.
    Answered(u64, Vec<SentRange>),
    /// Nobody answered.
    Unanswered,
}

/// What a final sync still waits for. The order is the order of progress: less is further.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Outstanding {
    /// Cars that have not answered.
    pub(crate) cars: u64,
    /// Missing messages that the other cars had sent by then.
    pub(crate) messages: u64,
}

impl Outstanding {
    /// Before anything is known.
    pub(crate) const UNKNOWN: Self = Self {
        cars: u64::MAX,
        messages: u64::MAX,
    };
    /// Everything has arrived.
    pub(crate) const NOTHING: Self = Self { cars: 0, messages: 0 };
}

impl<T> Default for Car<T> {
    fn default() -> Self {
        Self {
            run_id: None,
            before: Vec::new(),
            streams: BTreeMap::new(),
            queried: None,
            due: 0,
            budget: BUDGET[0],
            final_sync: None,
            stopped: false,
        }
    }
}

impl<T> GapRecovery<T> {
    /// Adds a car, or queries it at once when it is known.
    pub(crate) fn appeared(&mut self, car: &CarName) {
        if self.has_room(car) {
            self.cars.entry(car.clone()).or_default().due = 0;
        }
    }

    /// True when the car is known, or can be added. A car that only announced itself makes room for another.
    fn has_room(&mut self, car: &CarName) -> bool {
        if self.cars.len() < Fleet::MOST_CARS || self.cars.contains_key(car) {
            return true;
        }
        let silent = self.cars.iter().find(|(_, car)| car.streams.is_empty());
        let Some(silent) = silent.map(|(name, _)| name.clone()) else {
            return false;
        };
        self.cars.remove(&silent);
        true
    }

    /// Switches recovery of the full-rate streams on or off. Returns what was held back for a recording that ends.
    pub(crate) fn want_recorded(&mut self, on: bool) -> Vec<T> {
        self.recorded = on;
        let mut out = Vec::new();
        for car in self.cars.values_mut() {
            car.due = 0;
            car.final_sync = None;
            if !on {
                for stream in car.streams.values_mut() {
                    out.extend(stream.take_held());
                }
                car.streams.retain(|topic, _| !topic.recorded());
            }
        }
        out
    }

    /// Starts a final sync at `now` \[unix ns\]: asks every car for its last numbers and requests all that it has sent by then.
    /// A car that has stopped was asked then.
    pub(crate) fn final_sync(&mut self, now: i64) {
        for car in self.cars.values_mut().filter(|car| !car.stopped) {
            car.final_sync = Some(FinalSync::Requested(now));
            car.due = 0;
        }
    }

    /// Starts a final sync at `now` \[unix ns\] with a car whose run has sent its last message.
    pub(crate) fn stopped(&mut self, car: &CarName, run_id: u64, now: i64) {
        let car = self.cars.get_mut(car);
        if let Some(car) = car.filter(|car| car.run_id == Some(run_id) && !car.stopped) {
            car.stopped = true;
            car.final_sync = Some(FinalSync::Requested(now));
            car.due = 0;
        }
    }

    /// What the final sync still waits for.
    pub(crate) fn outstanding(&self) -> Outstanding {
        let mut outstanding = Outstanding::NOTHING;
        for car in self.cars.values() {
            match &car.final_sync {
                Some(FinalSync::Requested(_)) => outstanding.cars += 1,
                Some(FinalSync::Answered(..)) => outstanding.messages += car.outstanding(),
                Some(FinalSync::Unanswered) | None => {}
            }
        }
        outstanding
    }

    /// Adds a message that arrived at `at` \[unix ns\]. Returns what is in order now.
    pub(crate) fn arrive(&mut self, car: &CarName, id: MessageId, message: T, at: i64) -> Vec<T> {
        let MessageId {
            topic,
            run_id,
            number,
        } = id;
        if !self.has_room(car) {
            return vec![message];
        }
        let car = self.cars.entry(car.clone()).or_default();
        let mut out = car.follow(run_id);
        if number == 0 {
            out.push(message);
        } else {
            let stream = car.streams.entry(topic).or_insert_with(ReorderBuffer::new);
            stream.arrive(topic, number, message, at, &mut out);
        }
        out
    }

    /// Messages that have been held back for too long at `now` \[unix ns\].
    pub(crate) fn overdue(&mut self, now: i64) -> Vec<T> {
        let mut out = Vec::new();
        for stream in self.cars.values_mut().flat_map(|car| car.streams.values_mut()) {
            stream.release_overdue(now, &mut out);
        }
        out
    }

    /// The queries to send at `now` \[unix ns\].
    pub(crate) fn due(&mut self, now: i64) -> Vec<MissingQuery> {
        let recorded = self.recorded;
        let queries = self.cars.iter_mut().filter_map(|(name, car)| {
            if car.queried.is_some() || now < car.due {
                return None;
            }
            car.queried = Some(now);
            let topics = || Topic::all().filter(|topic| topic.recovered());
            let wanted = |car: &Car<T>, topic| Wanted {
                topic,
                ranges: car
                    .streams
                    .get(&topic)
                    .map(ReorderBuffer::wanted)
                    .unwrap_or_default(),
            };
            let mut streams: Vec<_> = topics()
                .filter(|topic| !topic.recorded())
                .map(|topic| wanted(car, topic))
                .filter(|wanted| !wanted.ranges.is_empty())
                .collect();
            // Events first: they matter most and are short.
            streams.sort_by_key(|wanted| wanted.topic != Topic::Event);
            let urgent = !streams.is_empty();
            if !urgent && recorded {
                let full_rate = topics().filter(|topic| topic.recorded());
                streams.extend(full_rate.map(|topic| wanted(car, topic)));
                streams.retain(|wanted| !wanted.ranges.is_empty());
                // The oldest first, of any stream: a recording is usable up to where all streams are complete.
                streams
                    .sort_by_key(|wanted| car.streams.get(&wanted.topic).map(ReorderBuffer::missing_since));
            }
            let request = MissingRequest {
                run_id: car.run_id.unwrap_or_default(),
                streams,
                budget: car.budget,
            };
            Some(MissingQuery {
                car: name.clone(),
                request,
                urgent,
            })
        });
        queries.collect()
    }

    /// Handles the end of a reply at `now` \[unix ns\], after its messages. `kept` is what the car still has. Returns what need
    /// not be held back any more and, as the answer to a final sync, the end that it gives and the ranges that are still to come.
    pub(crate) fn answered(
        &mut self,
        car: &CarName,
        run_id: u64,
        kept: &[Kept],
        more: bool,
        now: i64,
    ) -> (Vec<T>, Option<(RunEnd, Vec<SentRange>)>) {
        let recorded = self.recorded;
        let Some(car) = self.cars.get_mut(car) else {
            return (Vec::new(), None);
        };
        let mut out = car.follow(run_id);
        let answers_final_sync = car.answers_final_sync();
        if let Some(queried) = car.queried.take() {
            let [least, most] = BUDGET;
            let [short, long] = ROUND_TRIP;
            car.budget = match now - queried {
                took if took < short => (2 * car.budget).min(most),
                took if took > long => (car.budget / 2).max(least),
                _ => car.budget,
            };
        }
        let grace = car.final_sync.as_ref().map_or(TRANSIT, |_| FINAL_SYNC);
        let mut sent = Vec::new();
        for kept in kept {
            let plausible = kept.first <= kept.last && kept.last < MOST;
            if !plausible || !kept.topic.recovered() || kept.topic.recorded() && !recorded {
                continue;
            }
            let stream = car.streams.entry(kept.topic).or_insert_with(ReorderBuffer::new);
            stream.note_kept(*kept, now, grace, &mut out);
            let (topic, from, to) = (kept.topic, stream.next(), kept.last);
            if from <= to {
                sent.push(SentRange { topic, from, to });
            }
        }
        if answers_final_sync {
            car.final_sync = Some(FinalSync::Answered(run_id, sent.clone()));
        }
        let missing = car.streams.values().any(ReorderBuffer::has_gaps);
        car.due = match (missing, more, &car.final_sync) {
            (true, true, _) | (_, _, Some(FinalSync::Requested(_))) => now,
            (_, _, Some(FinalSync::Answered(..))) if car.outstanding() > 0 => now + FINAL_SYNC,
            (true, false, _) => now + RETRY,
            (false, _, _) => now + POLL,
        };
        let end = if car.stopped {
            RunEnd::Stopped
        } else {
            RunEnd::Answered
        };
        (out, answers_final_sync.then_some((end, sent)))
    }

    /// Notes at `now` \[unix ns\] that nobody has answered a query.
    pub(crate) fn unanswered(&mut self, car: &CarName, now: i64) {
        let car = self.cars.entry(car.clone()).or_default();
        if car.answers_final_sync() {
            car.final_sync = Some(FinalSync::Unanswered);
        }
        car.queried = None;
        car.budget = BUDGET[0];
        car.due = match car.final_sync {
            Some(FinalSync::Requested(_)) => now,
            _ => now + RETRY,
        };
    }
}

impl<T> Car<T> {
    /// Follows the car into a new run. Returns what was held back from the run before.
    fn follow(&mut self, run_id: u64) -> Vec<T> {
        let mut out = Vec::new();
        match self.run_id {
            Some(known) if run_id == known => return out,
            Some(known) => {
                let is_new = !self.before.contains(&run_id);
                if self.before.len() == RUNS {
                    self.before.remove(0);
                }
                self.before.push(known);
                for stream in self.streams.values_mut() {
                    out.extend(stream.take_held());
                    // The streams of a new run start with number 1 again.
                    *stream = if is_new {
                        ReorderBuffer::from_first()
                    } else {
                        ReorderBuffer::new()
                    };
                }
                self.due = 0;
                if std::mem::take(&mut self.stopped) {
                    self.final_sync = None;
                }
            }
            None => {}
        }
        self.run_id = Some(run_id);
        out
    }

    /// True when the query under way was sent after a final sync was requested, which is not answered yet.
    fn answers_final_sync(&self) -> bool {
        let Some(FinalSync::Requested(at)) = self.final_sync else {
            return false;
        };
        self.queried.is_some_and(|queried| queried >= at)
    }

    /// Missing messages of those that the car had sent when it answered the final sync.
    fn outstanding(&self) -> u64 {
        let Some(FinalSync::Answered(run_id, sent)) = &self.final_sync else {
            return 0;
        };
        let streams = sent.iter().filter(|_| self.run_id == Some(*run_id));
        streams
            .filter_map(|sent| Some(self.streams.get(&sent.topic)?.missing_up_to(sent.to)))
            .sum()
    }
}

#[cfg(test)]
mod tests {
    use super::super::reorder_buffer::HOLD;
    use super::*;

    const RUN: u64 = 5;
    const TOPIC: Topic = Topic::RecordedScan;

    struct Harness {
        recovery: GapRecovery<u64>,
        car: CarName,
        now: i64,
        out: Vec<u64>,
        /// The answers to final syncs.
        ends: Vec<(RunEnd, Vec<SentRange>)>,
    }

    impl Harness {
        fn new() -> Self {
            let mut recovery = GapRecovery::default();
            recovery.want_recorded(true);
            let car = CarName::new("car-1").expect("a good name");
            recovery.appeared(&car);
            Self {
                recovery,
                car,
                now: SECOND,
                out: Vec::new(),
                ends: Vec::new(),
            }
        }

        fn arrive_in(&mut self, run_id: u64, numbers: impl IntoIterator<Item = u64>) {
            for number in numbers {
                let id = MessageId {
                    topic: TOPIC,
                    run_id,
                    number,
                };
                self.out
                    .extend(self.recovery.arrive(&self.car, id, number, self.now));
            }
        }

        fn arrive(&mut self, numbers: impl IntoIterator<Item = u64>) {
            self.arrive_in(RUN, numbers);
        }

        /// Sends the query that is due and answers it with at most `most` messages.
        fn ask(&mut self, first: u64, last: u64, most: usize) -> Vec<[u64; 2]> {
            let query = self.recovery.due(self.now).pop().expect("is due");
            assert_eq!(self.recovery.due(self.now), [], "one at a time");
            let ranges: Vec<_> = query
                .request
                .streams
                .iter()
                .flat_map(|wanted| wanted.ranges.clone())
                .collect();
            let numbers = ranges.iter().flat_map(|[from, to]| *from..=*to);
            let sent: Vec<_> = numbers
                .filter(|number| (first..=last).contains(number))
                .take(most)
                .collect();
            self.arrive(sent.clone());
            let kept = Kept {
                topic: TOPIC,
                first,
                last,
            };
            let more = !sent.is_empty();
            let (out, sent) = self.recovery.answered(&self.car, RUN, &[kept], more, self.now);
            self.out.extend(out);
            self.ends.extend(sent);
            ranges
        }

        fn outstanding(&self) -> (u64, u64) {
            let Outstanding { cars, messages } = self.recovery.outstanding();
            (cars, messages)
        }

        fn wait(&mut self, seconds: f64) {
            self.now += (seconds * SECOND as f64) as i64;
        }
    }

    #[test]
    fn a_newcomer_gets_the_last_hundred_in_order() {
        let mut harness = Harness::new();
        harness.arrive([300]);
        assert!(
            harness.out.is_empty(),
            "held back until the first number is known"
        );
        assert_eq!(harness.ask(1, 300, 0), [] as [[u64; 2]; 0]);
        harness.wait(0.5);
        assert_eq!(harness.ask(1, 300, 1000), [[201, 299]]);
        assert_eq!(harness.out, (201..=300).collect::<Vec<_>>());
    }

    #[test]
    fn what_comes_after_a_gap_waits_for_it_and_the_gap_is_asked_for_in_pieces() {
        let mut harness = Harness::new();
        harness.ask(1, 1, 1);
        harness.wait(1.0);
        harness.ask(1, 1, 1);
        harness.out.clear();
        harness.arrive([2, 5, 9]);
        assert_eq!(harness.out, [2]);
        harness.wait(1.0);
        assert_eq!(harness.ask(1, 9, 3), [[3, 4], [6, 8]]);
        assert_eq!(harness.out, [2, 3, 4, 5, 6]);
        assert_eq!(harness.ask(1, 9, 3), [[7, 8]], "at once");
        assert_eq!(harness.out, [2, 3, 4, 5, 6, 7, 8, 9]);
        harness.arrive([7, 10]);
        assert_eq!(harness.out.last(), Some(&10), "a second copy is dropped");
        assert_eq!(harness.out.len(), 9);
    }

    #[test]
    fn a_gap_that_nobody_fills_holds_back_for_a_while_only() {
        let mut harness = Harness::new();
        harness.arrive([1, 2]);
        harness.ask(1, 2, 0);
        harness.arrive([4]);
        assert_eq!(harness.out, [1, 2]);
        harness.wait(0.5 + HOLD as f64 / SECOND as f64);
        assert_eq!(harness.recovery.overdue(harness.now), [4]);
        // It is asked for all the same, until the car has it no more.
        assert_eq!(harness.ask(4, 4, 1), [[3, 3]]);
        harness.wait(1.0);
        assert_eq!(harness.ask(4, 4, 1), [] as [[u64; 2]; 0]);
    }

    #[test]
    fn the_last_message_lost_is_missed_after_a_second() {
        let mut harness = Harness::new();
        harness.arrive([1]);
        harness.ask(1, 1, 0);
        harness.wait(1.0);
        assert_eq!(harness.ask(1, 2, 0), [] as [[u64; 2]; 0], "2 may be on its way");
        harness.wait(1.0);
        harness.ask(1, 2, 0);
        harness.wait(1.0);
        assert_eq!(harness.ask(1, 2, 1), [[2, 2]]);
        assert_eq!(harness.out, [1, 2]);
    }

    #[test]
    fn a_final_sync_brings_what_was_sent_by_then_within_tenths_of_a_second() {
        let mut harness = Harness::new();
        harness.arrive([1]);
        harness.ask(1, 1, 0);
        harness.arrive([2, 4]);
        harness.wait(0.05);
        harness.recovery.final_sync(harness.now);
        assert_eq!(harness.outstanding(), (1, 0));
        assert_eq!(harness.ask(1, 6, 0), [[3, 3]]);
        let sent = SentRange {
            topic: TOPIC,
            from: 3,
            to: 6,
        };
        assert_eq!(harness.ends, [(RunEnd::Answered, vec![sent])]);
        assert_eq!(harness.outstanding(), (0, 3), "3, 5 and 6");
        harness.arrive([7]);
        assert_eq!(harness.outstanding(), (0, 3), "7 was sent after it");
        harness.wait(0.1);
        assert_eq!(harness.ask(1, 9, 9), [[3, 3], [5, 6]]);
        assert_eq!((harness.outstanding(), harness.ends.len()), ((0, 0), 1));
        assert_eq!(harness.out, [1, 2, 3, 4, 5, 6, 7]);
    }

    #[test]
    fn a_car_that_stops_is_asked_at_once_and_not_again_when_the_recording_ends() {
        let mut harness = Harness::new();
        harness.arrive([1]);
        harness.ask(1, 1, 0);
        harness.arrive([2, 4]);
        let car = harness.car.clone();
        harness.recovery.stopped(&car, RUN, harness.now);
        assert_eq!(harness.ask(1, 5, 1), [[3, 3]]);
        let sent = |from| SentRange {
            topic: TOPIC,
            from,
            to: 5,
        };
        assert_eq!(harness.ends, [(RunEnd::Stopped, vec![sent(5)])]);
        harness.recovery.final_sync(harness.now);
        assert_eq!(harness.outstanding(), (0, 1), "5");
        harness.wait(0.1);
        assert_eq!(harness.ask(1, 5, 0), [] as [[u64; 2]; 0], "it was on its way");
        harness.wait(0.1);
        assert_eq!(harness.ask(1, 5, 1), [[5, 5]]);
        assert_eq!(harness.out, [1, 2, 3, 4, 5]);
        assert_eq!(harness.outstanding(), (0, 0));
        // Its next run is asked when the recording ends.
        harness.arrive_in(RUN + 1, [1]);
        harness.recovery.final_sync(harness.now);
        assert_eq!(harness.outstanding(), (1, 0));
    }

    #[test]
    fn a_final_sync_is_not_answered_by_what_was_asked_before_it() {
        let mut harness = Harness::new();
        let early = harness.recovery.due(harness.now);
        assert_eq!(early.len(), 1);
        harness.wait(0.1);
        harness.recovery.final_sync(harness.now);
        let (_, sent) = harness
            .recovery
            .answered(&harness.car, RUN, &[], false, harness.now);
        assert_eq!((sent, harness.outstanding()), (None, (1, 0)));
        harness.ask(1, 1, 0);
        assert_eq!(harness.outstanding(), (0, 1));
    }

    #[test]
    fn a_silent_car_is_not_waited_for_and_what_came_of_it_is_handed_on() {
        let mut harness = Harness::new();
        harness.arrive([1]);
        harness.ask(1, 1, 0);
        harness.arrive([3, 5]);
        harness.wait(1.0);
        harness.recovery.final_sync(harness.now);
        assert_eq!(harness.recovery.due(harness.now).len(), 1);
        harness.recovery.unanswered(&harness.car, harness.now);
        assert_eq!(harness.outstanding(), (0, 0));
        assert_eq!(harness.out, [1]);
        assert_eq!(harness.recovery.want_recorded(false), [3, 5]);
    }

    #[test]
    fn a_car_that_begins_anew_begins_with_one() {
        let mut harness = Harness::new();
        harness.arrive([1]);
        harness.ask(1, 1, 0);
        harness.arrive([3]);
        harness.arrive_in(RUN + 1, [2]);
        assert_eq!(harness.out, [1, 3], "what was held back is all there will be");
        let query = harness.recovery.due(harness.now).pop().expect("is due");
        assert_eq!(query.request.run_id, RUN + 1);
        assert_eq!(query.request.streams[0].ranges, [[1, 1]]);
        harness.arrive_in(RUN + 1, [1]);
        assert_eq!(harness.out, [1, 3, 1, 2]);
    }

    #[test]
    fn answers_grow_on_a_fast_link_and_shrink_on_a_slow_one() {
        let mut harness = Harness::new();
        let budgets: Vec<_> = [0.001, 0.01, 0.001, 0.01, 0.1, 0.5, 0.5, 3.0]
            .map(|took| {
                harness.wait(2.0);
                let query = harness.recovery.due(harness.now).pop().expect("is due");
                harness.wait(took);
                harness
                    .recovery
                    .answered(&harness.car, RUN, &[], false, harness.now);
                query.request.budget
            })
            .to_vec();
        assert_eq!(
            budgets,
            [4000, 8000, 16_000, 32_000, 48_000, 48_000, 24_000, 12_000]
        );
        harness.wait(2.0);
        harness.recovery.due(harness.now);
        harness.recovery.unanswered(&harness.car, harness.now);
        harness.wait(1.0);
        assert_eq!(harness.recovery.due(harness.now)[0].request.budget, 4000);
    }

    /// Messages are lost and replies are short: in the end each message is released once.
    #[test]
    fn every_message_is_released_once() {
        for seed in 0..50_u64 {
            let mut dice = seed;
            let mut roll = move |sides: u64| {
                dice = dice.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                (dice >> 33) % sides
            };
            let mut harness = Harness::new();
            harness.ask(1, 1, 1);
            for number in 2..=300 {
                harness.wait(0.025);
                if roll(3) > 0 {
                    harness.arrive([number]);
                }
                if roll(4) == 0 && harness.now >= harness.recovery.cars[&harness.car].due {
                    let most = roll(5) as usize;
                    harness.ask(1, number, most);
                }
            }
            for _ in 0..300 {
                harness.wait(1.1);
                harness.ask(1, 300, 7);
            }
            assert_eq!(harness.out, (1..=300).collect::<Vec<_>>(), "seed {seed}");
        }
    }
}
