//! What of the streams that must be whole has not come, and what to ask the cars for. Pure: the caller brings the time and
//! carries questions and answers.
//!
//! ```text
//! messages --> arrive --> those that are in order                   (others are held back for a while)
//! time     --> due    --> questions to cars --> answered: what came, what the car still keeps, its last numbers
//! ```
//!
//! One question per car is on its way at a time, and its answer is short: over a slow link it takes no more than its share,
//! over a fast one the next follows at once.
//!
//! There is one of these per link: a page and the recorder behind it share what was asked for. Several programs on one
//! laptop do not: each asks for itself, and over a slow link what is missing goes once to each. Where that counts, record
//! from the page.
//!
//! When a recording ends, a last call asks every car for its last numbers, and what it had sent by then is asked for at
//! once: without it the streams would end up to [`POLL`] and [`ON_ITS_WAY`] apart.

use std::collections::BTreeMap;

use protocol::{CarName, Kept, MissingRequest, Topic, Wanted};

use crate::event::SentRange;

/// Messages of a stream that are asked for when its sender is found; of events all.
const HISTORY: u64 = 100;
/// What comes after a gap is held back for so long, for the gap to be filled [ns].
const HOLD: i64 = 5 * SECOND;
/// A car is asked this often for its last numbers: a message that was lost is not missed until the next one comes [ns].
const POLL: i64 = SECOND;
/// Where nobody answered, the next question waits for so long [ns].
const AGAIN: i64 = SECOND / 3;
/// A message that was sent is on its way for so long before it counts as missing [ns].
const ON_ITS_WAY: i64 = SECOND;
/// Both when a recording is about to end [ns].
const FINAL_SYNC: i64 = SECOND / 10;
/// Bounds of what an answer may hold [bytes], and the round trip between which it grows and shrinks [ns].
const BUDGET: [u32; 2] = [4_000, 48_000];
const ROUND_TRIP: [i64; 2] = [SECOND / 20, SECOND / 5];
/// A stream with more gaps than this gives up the oldest: they stay missing.
const MAX_GAPS: usize = 4096;

const SECOND: i64 = 1_000_000_000;

/// A number in a stream of a car's run_id.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct MessageId {
    /// The stream.
    pub(crate) topic: Topic,
    /// See [`protocol::Header`].
    pub(crate) run_id: u64,
    /// See [`protocol::Header`]; 0 is not counted.
    pub(crate) number: u64,
}

/// A question to put to a car.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct MissingQuery {
    /// The car.
    pub(crate) car: CarName,
    /// What to ask.
    pub(crate) request: MissingRequest,
    /// It is about what an operator looks at, and not only a recorder.
    pub(crate) urgent: bool,
}

/// The streams of all cars. `T` is a message.
#[derive(Debug)]
pub(crate) struct GapRecovery<T> {
    cars: BTreeMap<CarName, Car<T>>,
    /// The full-rate streams are wanted, too.
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
    streams: BTreeMap<Topic, Stream<T>>,
    /// When it was asked what it has not answered yet [unix ns].
    asked: Option<i64>,
    /// When to ask next [unix ns].
    due: i64,
    budget: u32,
    final_sync: Option<FinalSync>,
}

/// How a car stands with a last call.
#[derive(Debug)]
enum FinalSync {
    /// It was made at this time, and is not answered yet [unix ns].
    Made(i64),
    /// The car's run_id, and the last number of each stream.
    Answered(u64, Vec<SentRange>),
    /// Nobody answered.
    Silent,
}

/// What is still to come after a last call; the less, the smaller.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Outstanding {
    /// Cars that have not answered it.
    pub(crate) cars: u64,
    /// Messages that those which have answered had sent by then.
    pub(crate) messages: u64,
}

impl Outstanding {
    /// Nothing is known yet.
    pub(crate) const UNKNOWN: Self = Self {
        cars: u64::MAX,
        messages: u64::MAX,
    };
    /// All is there.
    pub(crate) const NOTHING: Self = Self { cars: 0, messages: 0 };
}

impl<T> Default for Car<T> {
    fn default() -> Self {
        Self {
            run_id: None,
            streams: BTreeMap::new(),
            asked: None,
            due: 0,
            budget: BUDGET[0],
            final_sync: None,
        }
    }
}

impl<T> GapRecovery<T> {
    /// Takes note of a car: it is asked what it has.
    pub(crate) fn appeared(&mut self, car: &CarName) {
        self.cars.entry(car.clone()).or_default().due = 0;
    }

    /// Asks for the full-rate streams, too, or no more. Returns what was held back for a recording that ends.
    pub(crate) fn want_recorded(&mut self, on: bool) -> Vec<T> {
        self.recorded = on;
        let mut out = Vec::new();
        for car in self.cars.values_mut() {
            car.due = 0;
            car.final_sync = None;
            if !on {
                let streams = car.streams.values_mut();
                let held = streams.flat_map(|stream| std::mem::take(&mut stream.held).into_values());
                out.extend(held.map(|(_, message)| message));
                car.streams.retain(|topic, _| !topic.recorded());
            }
        }
        out
    }

    /// Asks every car at `now` [unix ns] how far its streams go, and for all that it has sent by then.
    pub(crate) fn final_sync(&mut self, now: i64) {
        for car in self.cars.values_mut() {
            car.final_sync = Some(FinalSync::Made(now));
            car.due = 0;
        }
    }

    /// What is still to come after the last call.
    pub(crate) fn outstanding(&self) -> Outstanding {
        let mut outstanding = Outstanding::NOTHING;
        for car in self.cars.values() {
            match &car.final_sync {
                Some(FinalSync::Made(_)) => outstanding.cars += 1,
                Some(FinalSync::Answered(..)) => outstanding.messages += car.outstanding(),
                Some(FinalSync::Silent) | None => {}
            }
        }
        outstanding
    }

    /// Takes in a message that came at `at` [unix ns]. Returns what can be handed on now, in order.
    pub(crate) fn arrive(&mut self, car: &CarName, id: MessageId, message: T, at: i64) -> Vec<T> {
        let MessageId {
            topic,
            run_id,
            number,
        } = id;
        let car = self.cars.entry(car.clone()).or_default();
        let mut out = car.follow(run_id);
        if number == 0 || car.run_id.is_some_and(|known| run_id < known) {
            out.push(message);
        } else {
            let stream = car.streams.entry(topic).or_insert_with(|| Stream::new(false));
            stream.arrive(topic, number, message, at, &mut out);
        }
        out
    }

    /// What was held back for too long, to be handed on at `now` [unix ns] all the same.
    pub(crate) fn overdue(&mut self, now: i64) -> Vec<T> {
        let mut out = Vec::new();
        for stream in self.cars.values_mut().flat_map(|car| car.streams.values_mut()) {
            // What began before it is known where the stream begins would seem to be its begin.
            let hold = if stream.begun { HOLD } else { 3 * HOLD };
            while let Some(oldest) = stream.held.first_entry()
                && now - oldest.get().0 > hold
            {
                out.push(oldest.remove().1);
            }
        }
        out
    }

    /// The questions that are to be put at `now` [unix ns].
    pub(crate) fn due(&mut self, now: i64) -> Vec<MissingQuery> {
        let recorded = self.recorded;
        let asked = self.cars.iter_mut().filter_map(|(name, car)| {
            if car.asked.is_some() || now < car.due {
                return None;
            }
            car.asked = Some(now);
            let topics = || Topic::all().filter(|topic| topic.recovered());
            let wanted = |car: &Car<T>, topic| Wanted {
                topic,
                ranges: car.streams.get(&topic).map(Stream::wanted).unwrap_or_default(),
            };
            let mut streams: Vec<_> = topics()
                .filter(|topic| !topic.recorded())
                .map(|topic| wanted(car, topic))
                .filter(|wanted| !wanted.ranges.is_empty())
                .collect();
            // Events tell most and are short.
            streams.sort_by_key(|wanted| wanted.topic != Topic::Event);
            let urgent = !streams.is_empty();
            if !urgent && recorded {
                let full_rate = topics().filter(|topic| topic.recorded());
                streams.extend(full_rate.map(|topic| wanted(car, topic)));
                streams.retain(|wanted| !wanted.ranges.is_empty());
                // The oldest first, whatever the stream: a recording is of use up to where all of them are whole.
                streams.sort_by_key(|wanted| car.streams.get(&wanted.topic).map(Stream::since));
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
        asked.collect()
    }

    /// A car has answered at `now` [unix ns]: what it sent has been taken in, `kept` is what else it said. Returns what need
    /// not be held back any more, and, as the answer to a last call, how far each stream goes of which something is to come.
    pub(crate) fn answered(
        &mut self,
        car: &CarName,
        run_id: u64,
        kept: &[Kept],
        more: bool,
        now: i64,
    ) -> (Vec<T>, Option<Vec<SentRange>>) {
        let recorded = self.recorded;
        let car = self.cars.entry(car.clone()).or_default();
        let mut out = car.follow(run_id);
        let answers_final_sync = car.answers_final_sync();
        if let Some(asked) = car.asked.take() {
            let [least, most] = BUDGET;
            let [short, long] = ROUND_TRIP;
            car.budget = match now - asked {
                took if took < short => (2 * car.budget).min(most),
                took if took > long => (car.budget / 2).max(least),
                _ => car.budget,
            };
        }
        let on_its_way = car.final_sync.as_ref().map_or(ON_ITS_WAY, |_| FINAL_SYNC);
        let mut sent = Vec::new();
        for kept in kept {
            if !kept.topic.recovered() || kept.topic.recorded() && !recorded {
                continue;
            }
            let stream = car
                .streams
                .entry(kept.topic)
                .or_insert_with(|| Stream::new(false));
            stream.kept(*kept, now, on_its_way, &mut out);
            let (topic, from, to) = (kept.topic, stream.next(), kept.last);
            if from <= to {
                sent.push(SentRange { topic, from, to });
            }
        }
        if answers_final_sync {
            car.final_sync = Some(FinalSync::Answered(run_id, sent.clone()));
        }
        let missing = car.streams.values().any(|stream| !stream.gaps.is_empty());
        car.due = match (missing, more, &car.final_sync) {
            (true, true, _) | (_, _, Some(FinalSync::Made(_))) => now,
            (_, _, Some(FinalSync::Answered(..))) if car.outstanding() > 0 => now + FINAL_SYNC,
            (true, false, _) => now + AGAIN,
            (false, _, _) => now + POLL,
        };
        (out, answers_final_sync.then_some(sent))
    }

    /// Nobody has answered by `now` [unix ns].
    pub(crate) fn unanswered(&mut self, car: &CarName, now: i64) {
        let car = self.cars.entry(car.clone()).or_default();
        if car.answers_final_sync() {
            car.final_sync = Some(FinalSync::Silent);
        }
        car.asked = None;
        car.budget = BUDGET[0];
        car.due = match car.final_sync {
            Some(FinalSync::Made(_)) => now,
            _ => now + AGAIN,
        };
    }
}

impl<T> Car<T> {
    /// Follows a car that began anew; returns what was held back of what it was before.
    fn follow(&mut self, run_id: u64) -> Vec<T> {
        let mut out = Vec::new();
        match self.run_id {
            Some(known) if run_id <= known => return out,
            Some(_) => {
                // What we have followed begins with number 1 again.
                for stream in self.streams.values_mut() {
                    let before = std::mem::replace(stream, Stream::new(true));
                    out.extend(before.held.into_values().map(|(_, message)| message));
                }
                self.due = 0;
            }
            None => {}
        }
        self.run_id = Some(run_id);
        out
    }

    /// True when the question on its way was put after a last call, which nobody has answered yet.
    fn answers_final_sync(&self) -> bool {
        matches!((&self.final_sync, self.asked), (Some(FinalSync::Made(at)), Some(asked)) if asked >= *at)
    }

    /// Messages to come of those that the car had sent when it answered the last call.
    fn outstanding(&self) -> u64 {
        let Some(FinalSync::Answered(run_id, sent)) = &self.final_sync else {
            return 0;
        };
        let streams = sent.iter().filter(|_| self.run_id == Some(*run_id));
        streams
            .filter_map(|sent| Some(self.streams.get(&sent.topic)?.lacks_up_to(sent.to)))
            .sum()
    }
}

#[derive(Debug)]
struct Stream<T> {
    /// Where it begins for us is known; until then everything is held back.
    begun: bool,
    /// The highest number that has come or is known to be missing.
    highest: u64,
    /// Missing ranges as `[from, to]`, ascending, and since when [unix ns].
    gaps: Vec<([u64; 2], i64)>,
    /// A number that the car has sent, and since when that is known [unix ns].
    tail: Option<(u64, i64)>,
    /// What came after a gap, and when [unix ns].
    held: BTreeMap<u64, (i64, T)>,
}

impl<T> Stream<T> {
    fn new(begun: bool) -> Self {
        Self {
            begun,
            highest: 0,
            gaps: Vec::new(),
            tail: None,
            held: BTreeMap::new(),
        }
    }

    fn arrive(&mut self, topic: Topic, number: u64, message: T, at: i64, out: &mut Vec<T>) {
        if self.begun && number <= self.highest {
            // It fills a gap, or has come already.
            if !self.fill(number) {
                return;
            }
        } else {
            if self.begun && number > self.highest + 1 {
                self.miss([self.highest + 1, number - 1], at);
            }
            self.highest = self.highest.max(number);
        }
        // Health is shown as it comes: its age tells more than its order.
        if topic == Topic::Health {
            out.push(message);
        } else {
            self.held.insert(number, (at, message));
        }
        self.release(out);
    }

    /// Takes note of what the car still has. What it sent is on its way for so long before it counts as missing [ns].
    fn kept(&mut self, kept: Kept, now: i64, on_its_way: i64, out: &mut Vec<T>) {
        let Kept { topic, first, last } = kept;
        if !self.begun {
            self.begun = true;
            let start = if topic == Topic::Event {
                first
            } else {
                first.max((last + 1).saturating_sub(HISTORY))
            };
            let mut next = self.held.keys().next().map_or(start, |held| start.min(*held));
            self.highest = self.highest.max(last);
            let held: Vec<_> = self.held.keys().copied().chain([self.highest + 1]).collect();
            for number in held {
                if number > next {
                    self.miss([next, number - 1], now);
                }
                next = number + 1;
            }
        }
        // What the car no longer has is lost.
        self.gaps.retain_mut(|([from, to], _)| {
            *from = first.max(*from);
            from <= to
        });
        match self.tail {
            Some((number, since)) if number > self.highest && now - since >= on_its_way => {
                self.miss([self.highest + 1, number], since);
                self.highest = number;
                self.tail = None;
            }
            Some((number, _)) if number > self.highest => {}
            _ => self.tail = (last > self.highest).then_some((last, now)),
        }
        self.release(out);
    }

    /// Hands on what no gap precedes.
    fn release(&mut self, out: &mut Vec<T>) {
        if !self.begun {
            return;
        }
        let first_hole = self.gaps.first().map_or(u64::MAX, |([from, _], _)| *from);
        while let Some(next) = self.held.first_entry()
            && *next.key() < first_hole
        {
            out.push(next.remove().1);
        }
    }

    fn miss(&mut self, range: [u64; 2], at: i64) {
        if self.gaps.len() == MAX_GAPS {
            self.gaps.remove(0);
        }
        self.gaps.push((range, at));
    }

    /// Takes a number out of the missing ones; false when it was none of them.
    fn fill(&mut self, number: u64) -> bool {
        let within = |([from, to], _): &([u64; 2], i64)| (*from..=*to).contains(&number);
        let Some(index) = self.gaps.iter().position(within) else {
            return false;
        };
        let ([from, to], since) = self.gaps.remove(index);
        if number < to {
            self.gaps.insert(index, ([number + 1, to], since));
        }
        if number > from {
            self.gaps.insert(index, ([from, number - 1], since));
        }
        true
    }

    /// The first number that has not been handed on.
    fn next(&self) -> u64 {
        let gap = self.gaps.first().map(|([from, _], _)| *from);
        let held = self.held.keys().next().copied();
        let next = gap.into_iter().chain(held).min();
        next.unwrap_or(self.highest + 1)
    }

    /// How many numbers up to `last` have not come.
    fn lacks_up_to(&self, last: u64) -> u64 {
        let gaps = self
            .gaps
            .iter()
            .map(|([from, to], _)| (*to.min(&last) + 1).saturating_sub(*from));
        gaps.sum::<u64>() + last.saturating_sub(self.highest)
    }

    /// What to ask for: the oldest ranges.
    fn wanted(&self) -> Vec<[u64; 2]> {
        let ranges = self.gaps.iter().map(|(range, _)| *range);
        ranges.take(Wanted::MAX_RANGES).collect()
    }

    /// Since when something has been missing [unix ns].
    fn since(&self) -> i64 {
        self.gaps.first().map_or(i64::MAX, |(_, since)| *since)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RUN: u64 = 5;
    const TOPIC: Topic = Topic::RecordedScan;

    struct Harness {
        recovery: GapRecovery<u64>,
        car: CarName,
        now: i64,
        out: Vec<u64>,
        /// The answers to last calls.
        sent: Vec<Vec<SentRange>>,
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
                sent: Vec::new(),
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

        /// Asks what is due and answers with the last number, and up to so many messages.
        fn ask(&mut self, first: u64, last: u64, most: usize) -> Vec<[u64; 2]> {
            let question = self.recovery.due(self.now).pop().expect("is due");
            assert_eq!(self.recovery.due(self.now), [], "one at a time");
            let ranges: Vec<_> = question
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
            self.sent.extend(sent);
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
            "held back until it is known what came before"
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
        assert_eq!(harness.sent, [[sent]]);
        assert_eq!(harness.outstanding(), (0, 3), "3, 5 and 6");
        harness.arrive([7]);
        assert_eq!(harness.outstanding(), (0, 3), "7 was sent after it");
        harness.wait(0.1);
        assert_eq!(harness.ask(1, 9, 9), [[3, 3], [5, 6]]);
        assert_eq!((harness.outstanding(), harness.sent.len()), ((0, 0), 1));
        assert_eq!(harness.out, [1, 2, 3, 4, 5, 6, 7]);
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
        let question = harness.recovery.due(harness.now).pop().expect("is due");
        assert_eq!(question.request.run_id, RUN + 1);
        assert_eq!(question.request.streams[0].ranges, [[1, 1]]);
        harness.arrive_in(RUN, [2]);
        assert_eq!(harness.out, [1, 3, 2], "a straggler");
        harness.arrive_in(RUN + 1, [1]);
        assert_eq!(harness.out, [1, 3, 2, 1, 2]);
    }

    #[test]
    fn answers_grow_on_a_fast_link_and_shrink_on_a_slow_one() {
        let mut harness = Harness::new();
        let budgets: Vec<_> = [0.001, 0.01, 0.001, 0.01, 0.1, 0.5, 0.5, 3.0]
            .map(|took| {
                harness.wait(2.0);
                let question = harness.recovery.due(harness.now).pop().expect("is due");
                harness.wait(took);
                harness
                    .recovery
                    .answered(&harness.car, RUN, &[], false, harness.now);
                question.request.budget
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

    /// Whatever is lost, repeated and answered late: in the end each has been handed on, each once.
    #[test]
    fn nothing_is_lost_and_nothing_comes_twice() {
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
