//! The replay buffer: what was sent, for receivers that missed it. Pure: no network, no clock.
//!
//! Messages of a stream that must be complete are kept here by their sequence numbers. A pit wall that misses some requests
//! them ([`MissingRequest`]) in pieces, at its own pace.

use std::collections::{BTreeMap, VecDeque};

use protocol::{Kept, MissingReply, MissingRequest, Resent, Topic};

/// Memory of the buffer of scans [bytes]: four minutes of scans of 1081 beams at full rate.
const MOST_SCANS: usize = 24 * 1024 * 1024;
/// Memory of each other stream's buffer [bytes]: twenty minutes of poses at full rate.
const MOST: usize = 10 * 1024 * 1024;
/// Memory that a message takes beside its bytes: its place in the queue, and the allocator's.
const EACH: usize = 40;

/// Memory that a message takes.
fn size(message: &[u8]) -> usize {
    message.len() + EACH
}

/// Messages by stream and number.
#[derive(Debug, Default)]
pub struct ReplayBuffer(BTreeMap<Topic, StreamBuffer>);

/// The messages of one stream, without gaps in their numbers.
#[derive(Debug, Default)]
struct StreamBuffer {
    /// Number of the oldest message.
    first: u64,
    messages: VecDeque<Vec<u8>>,
    bytes: usize,
}

impl ReplayBuffer {
    /// Keeps a message. The oldest ones are dropped when the buffer is full.
    pub fn keep(&mut self, topic: Topic, sequence: u64, mut bytes: Vec<u8>) {
        bytes.shrink_to_fit();
        let most = match topic {
            Topic::RecordedScan => MOST_SCANS,
            _ => MOST,
        };
        let stream = self.0.entry(topic).or_default();
        if sequence != stream.first + stream.messages.len() as u64 {
            *stream = StreamBuffer {
                first: sequence,
                ..StreamBuffer::default()
            };
        }
        stream.bytes += size(&bytes);
        stream.messages.push_back(bytes);
        while stream.bytes > most && stream.messages.len() > 1 {
            let dropped = stream.messages.pop_front().map_or(0, |oldest| size(&oldest));
            stream.bytes -= dropped;
            stream.first += 1;
        }
    }

    /// The requested messages that are kept, as many as the budget allows. `run_id` is this run of the node.
    pub fn find(&self, run_id: u64, request: &MissingRequest) -> MissingReply {
        let streams = self.0.iter().map(|(topic, stream)| Kept {
            topic: *topic,
            first: stream.first,
            last: stream.first + stream.messages.len() as u64 - 1,
        });
        let budget = request.budget.min(MissingRequest::MAX_BUDGET) as usize;
        let mut spent = 0;
        let wanted = request
            .streams
            .iter()
            .filter(|_| request.run_id == run_id)
            .filter_map(|wanted| Some((wanted.topic, &wanted.ranges, self.0.get(&wanted.topic)?)))
            .flat_map(|(topic, ranges, stream)| stream.within(ranges).map(move |bytes| (topic, bytes)));
        let messages = wanted
            .take_while(|(_, bytes)| {
                spent += bytes.len();
                spent <= budget || spent == bytes.len()
            })
            .map(|(topic, bytes)| Resent {
                topic,
                bytes: bytes.to_vec(),
            })
            .collect();
        MissingReply {
            streams: streams.collect(),
            messages,
        }
    }
}

impl StreamBuffer {
    /// The messages in these ranges, range by range.
    fn within<'a>(&'a self, ranges: &'a [[u64; 2]]) -> impl Iterator<Item = &'a [u8]> {
        let end = self.first + self.messages.len() as u64;
        ranges.iter().flat_map(move |[from, to]| {
            let from = (*from).clamp(self.first, end);
            let to = to.saturating_add(1).clamp(from, end);
            let at = |number| (number - self.first) as usize;
            self.messages.range(at(from)..at(to)).map(Vec::as_slice)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::Wanted;

    const RUN: u64 = 7;

    fn buffer(numbers: std::ops::RangeInclusive<u64>, len: usize) -> ReplayBuffer {
        let mut buffer = ReplayBuffer::default();
        for number in numbers {
            buffer.keep(Topic::Event, number, vec![number as u8; len]);
        }
        buffer
    }

    fn request(buffer: &ReplayBuffer, run_id: u64, ranges: &[[u64; 2]], budget: u32) -> MissingReply {
        let request = MissingRequest {
            run_id,
            streams: vec![Wanted {
                topic: Topic::Event,
                ranges: ranges.to_vec(),
            }],
            budget,
        };
        buffer.find(RUN, &request)
    }

    fn numbers(reply: &MissingReply) -> Vec<u8> {
        reply.messages.iter().map(|message| message.bytes[0]).collect()
    }

    #[test]
    fn missing_messages_come_in_order_and_within_the_budget() {
        let buffer = buffer(1..=9, 100);
        let reply = request(&buffer, RUN, &[[2, 3], [6, 20]], 1000);
        assert_eq!(numbers(&reply), [2, 3, 6, 7, 8, 9]);
        let kept = Kept {
            topic: Topic::Event,
            first: 1,
            last: 9,
        };
        assert_eq!(reply.streams, [kept]);
        assert_eq!(
            numbers(&request(&buffer, RUN, &[[2, 3], [6, 20]], 399)),
            [2, 3, 6]
        );
        assert_eq!(
            numbers(&request(&buffer, RUN, &[[4, 9]], 0)),
            [4],
            "at least one is sent"
        );
    }

    #[test]
    fn absurd_requests_get_what_is_kept() {
        let buffer = buffer(5..=6, 1);
        for ranges in [[0, u64::MAX], [0, 5], [6, 6], [7, u64::MAX], [0, 4]] {
            let expected: Vec<u8> = (5..=6)
                .filter(|n| (ranges[0]..=ranges[1]).contains(n))
                .map(|n| n as u8)
                .collect();
            assert_eq!(numbers(&request(&buffer, RUN, &[ranges], u32::MAX)), expected);
        }
        let other = request(&buffer, RUN + 1, &[[0, 9]], u32::MAX);
        assert_eq!(other.messages, [], "numbers of another run of the node");
        assert_eq!((other.streams[0].first, other.streams[0].last), (5, 6));
    }

    #[test]
    fn the_oldest_are_dropped_when_it_is_full() {
        let buffer = buffer(1..=30, (1 << 20) - EACH);
        let reply = request(&buffer, RUN, &[[1, 30]], 0);
        assert_eq!((reply.streams[0].first, reply.streams[0].last), (21, 30));
        assert_eq!(numbers(&reply), [21]);
    }

    #[test]
    fn small_messages_count_with_the_memory_that_they_take() {
        let buffer = buffer(1..=200_000, 80);
        let kept = request(&buffer, RUN, &[], 0).streams[0];
        assert_eq!(kept.last - kept.first + 1, (MOST / (80 + EACH)) as u64);
    }
}
