//! Reads a recording by the time of publishing.
//!
//! What a link has lost is recovered later, and stands later in the file. Here, each car's messages come in the order in which
//! the car has published them, with the time at which they would have arrived. Live poses and health messages are left out
//! where the full-rate streams have them, because those are complete.
//!
//! The file is read twice. The first pass reads the headers, finds the messages that are late and keeps their bytes; the second one
//! hands them out before the messages that were published after them. Only the whole file says whether the full-rate streams have the
//! live messages. The first pass assumes that they do; where one of them does not, another pass finds what is late.

use std::collections::{BTreeMap, HashSet, VecDeque};
use std::path::Path;
use std::sync::Arc;

use protocol::{CarName, Header, Telemetry, Topic};

use super::error::RecordingError;
use super::reader::{Recording, payload, read_events};
use super::survey::{Survey, full_rate, survey_with};
use crate::event::{EventPayload, FleetEvent};
use crate::fleet::Fleet;

/// A message that stands later in the file than it was published.
struct Late {
    published: i64,
    topic: Topic,
    sequence: u64,
    bytes: Arc<[u8]>,
}

/// The newest message of a car's run so far.
type Newest = BTreeMap<(CarName, u64), i64>;

/// The late messages of each car's run.
type LateByRun = BTreeMap<(CarName, u64), LateMessages>;

/// The late messages of one run.
#[derive(Default)]
struct LateMessages {
    /// In the order of publishing.
    queue: VecDeque<Late>,
    /// Topic, sequence number and time of publishing of each.
    ids: HashSet<(Topic, u64, i64)>,
}

/// The wanted events of a recording in the order of publishing. The first error is the last item.
pub struct InOrder {
    survey: Survey,
    events: Recording,
    late: LateByRun,
    /// The car's clock minus the laptop's in each of its runs \[ns\].
    offsets: BTreeMap<(CarName, u64), i64>,
    ready: VecDeque<FleetEvent>,
    ended: bool,
    copies: bool,
}

/// Reads the events of a recording whose topic is wanted, and all that are not messages.
pub fn read_in_order(path: &Path, wanted: fn(Topic) -> bool) -> Result<InOrder, RecordingError> {
    let (survey, mut late) = find_late(path, wanted, |_, topic| full_rate(topic).is_some())?;
    let cars = survey.cars();
    let assumed = |(car, topic): (&CarName, Topic)| full_rate(topic).is_none() || survey.is_copy(car, topic);
    if !cars
        .iter()
        .flat_map(|car| survey.of(car).map(move |(topic, _)| (car, topic)))
        .all(assumed)
    {
        (_, late) = find_late(path, wanted, |car, topic| survey.is_copy(car, topic))?;
    }
    for messages in late.values_mut() {
        messages
            .queue
            .make_contiguous()
            .sort_by_key(|late| (late.published, late.topic, late.sequence));
    }
    Ok(InOrder {
        survey,
        events: read_events(path)?.only(wanted),
        late,
        offsets: BTreeMap::new(),
        ready: VecDeque::new(),
        ended: false,
        copies: false,
    })
}

/// Reads the headers of a recording, and finds the wanted messages that are late. Copies are left out.
fn find_late(
    path: &Path,
    wanted: fn(Topic) -> bool,
    is_copy: impl Fn(&CarName, Topic) -> bool,
) -> Result<(Survey, LateByRun), RecordingError> {
    let mut late = LateByRun::new();
    let mut newest = Newest::default();
    let survey = survey_with(path, |car, topic, header, bytes| {
        if !wanted(topic) || is_copy(car, topic) || !is_late(&mut newest, car, header) {
            return;
        }
        if Telemetry::decode(topic, &bytes).is_none_or(|decoded| decoded.is_err()) {
            // What cannot be decoded is told where it stands.
            return;
        }
        let late = late.entry((car.clone(), header.run_id)).or_default();
        late.ids.insert((topic, header.sequence, header.published));
        late.queue.push_back(Late {
            published: header.published,
            topic,
            sequence: header.sequence,
            bytes: bytes.into(),
        });
    })?;
    Ok((survey, late))
}

/// The message of an event, if it is one.
fn message(event: &FleetEvent) -> Option<(Topic, &Header, &Arc<[u8]>)> {
    match &event.payload {
        EventPayload::Message {
            topic, header, bytes, ..
        } => Some((*topic, header, bytes)),
        _ => None,
    }
}

/// True when a message of the same run that was published later stands before it.
fn is_late(newest: &mut Newest, car: &CarName, header: &Header) -> bool {
    let newest = newest
        .entry((car.clone(), header.run_id))
        .or_insert(header.published);
    if header.published < *newest {
        return true;
    }
    *newest = header.published;
    false
}

impl InOrder {
    /// Hands out the live poses and health messages as well, when they arrived. A fleet that was prepared does not show them.
    pub(crate) fn with_copies(mut self) -> Self {
        self.copies = true;
        self
    }

    /// True when the recording has no message.
    pub fn is_empty(&self) -> bool {
        self.survey.streams.is_empty()
    }

    /// Prepares a new fleet that is to apply the events.
    pub fn prepare(&self, fleet: &mut Fleet) {
        for car in &self.survey.cars() {
            self.survey.prepare(fleet, car);
        }
    }

    /// The streams of the recording.
    pub(crate) fn survey(&self) -> &Survey {
        &self.survey
    }

    fn next_event(&mut self) -> Result<Option<FleetEvent>, RecordingError> {
        loop {
            if let Some(event) = self.ready.pop_front() {
                return Ok(Some(event));
            }
            if self.ended {
                return Ok(None);
            }
            let Some(event) = self.events.next().transpose()? else {
                self.ended = true;
                for (run, messages) in std::mem::take(&mut self.late) {
                    for late in messages.queue {
                        let event = self.event_of(&run, &late, i64::MAX);
                        self.ready.extend(event);
                    }
                }
                continue;
            };
            self.add(event);
        }
    }

    fn add(&mut self, mut event: FleetEvent) {
        if let EventPayload::Clock {
            run_id: Some(run_id),
            offset,
            ..
        } = event.payload
        {
            self.offsets.insert((event.car.clone(), run_id), offset);
        }
        let Some((topic, header, _)) = message(&event) else {
            self.ready.push_back(event);
            return;
        };
        if self.survey.is_copy(&event.car, topic) {
            if self.copies {
                self.ready.push_back(event);
            }
            return;
        }
        let (run_id, published) = (header.run_id, header.published);
        let key = (event.car.clone(), run_id);
        let id = (topic, header.sequence, published);
        if self.late.get(&key).is_some_and(|late| late.ids.contains(&id)) {
            return;
        }
        while let Some(late) = self
            .late
            .get_mut(&key)
            .and_then(|late| late.queue.pop_front_if(|late| late.published < published))
        {
            let event = self.event_of(&key, &late, event.at);
            self.ready.extend(event);
        }
        event.at = self.time_of(&key, published, event.at);
        self.ready.push_back(event);
    }

    /// When a message would have arrived on a good link, by the laptop's clock \[unix ns\]: never after it did.
    fn time_of(&self, run: &(CarName, u64), published: i64, arrived: i64) -> i64 {
        /// A car does not keep its messages for longer \[ns\].
        const KEPT: i64 = 6 * 3600 * 1_000_000_000;
        let (car, run_id) = run;
        let offset = self.offsets.get(run).copied();
        match offset.or_else(|| self.survey.compared(car, *run_id)) {
            Some(offset) => published
                .saturating_sub(offset)
                .clamp(arrived.saturating_sub(KEPT), arrived),
            None => arrived,
        }
    }

    /// The event of a late message that stands before an event of the time `before` \[unix ns\].
    fn event_of(&self, run: &(CarName, u64), late: &Late, before: i64) -> Option<FleetEvent> {
        let before = before.min(self.survey.span.map_or(i64::MAX, |(_, to)| to));
        Some(FleetEvent {
            at: self.time_of(run, late.published, before),
            car: run.0.clone(),
            payload: payload(late.topic, &late.bytes).ok()?,
        })
    }
}

impl Iterator for InOrder {
    type Item = Result<FleetEvent, RecordingError>;

    fn next(&mut self) -> Option<Self::Item> {
        let next = self.next_event().transpose();
        if !matches!(next, Some(Ok(_))) {
            self.ended = true;
            self.ready.clear();
        }
        next
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Delivery;
    use crate::recording::writer::RecordingWriter;
    use protocol::{Pose, Stamps, Telemetry, encode};

    const SECOND: i64 = 1_000_000_000;

    fn pose(topic: Topic, sequence: u64, published: i64, at: i64) -> FleetEvent {
        let stamps = Stamps {
            run_id: 1,
            sequence,
            sensor: published,
            published,
        };
        let pose = Pose {
            update: sequence,
            ..crate::recording::foxglove::tests::pose()
        };
        let bytes = encode(&pose, stamps).expect("a good message");
        FleetEvent {
            at,
            car: "car-1".parse().expect("a name"),
            payload: EventPayload::Message {
                topic,
                delivery: Delivery::InOrder,
                header: Header::read(&bytes).expect("our own"),
                telemetry: Box::new(Telemetry::Pose(pose)),
                bytes: bytes.into(),
            },
        }
    }

    // A report and an export once had only what came live: 3496 of 8595 poses after cuts of two minutes.
    #[test]
    fn what_was_recovered_stands_where_it_was_published() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("session.mcap");
        let mut recording =
            RecordingWriter::new(std::fs::File::create(&path).expect("a file")).expect("begun");
        let mut write = |event: FleetEvent| recording.write(&event).expect("written");
        // The car's clock is 100 s ahead, and the link takes 10 ms.
        let arrives = |published: i64| published - 100 * SECOND + SECOND / 100;
        write(FleetEvent {
            payload: EventPayload::Clock {
                run_id: None,
                offset: 100 * SECOND,
                round_trip: SECOND / 50,
            },
            ..pose(Topic::Pose, 1, 0, 1)
        });
        for number in [1, 2, 8, 9] {
            let published = (200 + number) * SECOND;
            let at = arrives(published);
            write(pose(Topic::Pose, number as u64, published, at));
            write(pose(Topic::RecordedPose, number as u64, published, at));
        }
        for number in 3..8 {
            let published = (200 + number) * SECOND;
            write(pose(
                Topic::RecordedPose,
                number as u64,
                published,
                arrives(220 * SECOND),
            ));
        }
        recording.finish().expect("ended");
        let events = read_in_order(&path, |_| true).expect("opens");
        let read: Vec<_> = events
            .map(|event| event.expect("whole"))
            .filter_map(|event| {
                let (topic, header, _) = message(&event)?;
                Some((topic, header.sequence, event.at / SECOND))
            })
            .collect();
        let expected: Vec<_> = (1..=9)
            .map(|number| (Topic::RecordedPose, number, 100 + number as i64))
            .collect();
        assert_eq!(read, expected);
    }
}
