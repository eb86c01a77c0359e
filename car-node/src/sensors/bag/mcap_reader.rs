//! Reads the messages of an MCAP file from a disk that may have damaged it.
//!
//! `mcap::io::MessageReader` trusts the lengths in the file: a damaged one takes all memory or panics. This reader limits
//! lengths, verifies the checksum of a chunk before it uses the chunk, and parses only the records that it needs.

use std::collections::VecDeque;
use std::io::{self, Read};
use std::sync::Arc;

use mcap::read::ChannelAccumulator;
use mcap::records::{Record, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{Channel, McapError, McapResult, Message};

use super::reader::RECORD_LIMIT;

/// The most that is read at once \[bytes\], so that a damaged length takes no more memory than the file has.
const BLOCK: usize = 1 << 20;

/// The messages of a file, in the order in which they were written. The first error is the last item.
pub(super) struct McapReader<R> {
    source: R,
    records: LinearReader,
    channels: ChannelAccumulator<'static>,
    /// Messages of the current chunk.
    messages: VecDeque<Message<'static>>,
    /// Channels that nobody has taken yet.
    new_channels: Vec<Arc<Channel<'static>>>,
    progress: Progress,
    /// Bytes read of the file.
    position: u64,
    /// The end of the messages was reached.
    in_summary: bool,
}

#[derive(Clone, Copy, PartialEq)]
enum Progress {
    Data,
    /// The summary repeats schemas and channels and has no messages.
    Summary,
    Done,
}

impl<R: Read> McapReader<R> {
    pub(super) fn new(source: R) -> Self {
        Self {
            source,
            records: LinearReader::new_with_options(options().with_emit_chunks(true)),
            channels: ChannelAccumulator::default(),
            messages: VecDeque::new(),
            new_channels: Vec::new(),
            progress: Progress::Data,
            position: 0,
            in_summary: false,
        }
    }

    /// The channels that have appeared since the last call.
    pub(super) fn take_channels(&mut self) -> Vec<Arc<Channel<'static>>> {
        std::mem::take(&mut self.new_channels)
    }

    /// How much of the file has been read \[bytes\].
    pub(super) fn position(&self) -> u64 {
        self.position
    }

    /// True when all messages have been read and only the summary is left.
    pub(super) fn in_summary(&self) -> bool {
        self.in_summary
    }

    /// Reads until there is a message or the file ends.
    fn fill(&mut self) -> McapResult<()> {
        while self.messages.is_empty() && self.progress != Progress::Done {
            let mut source = Counted {
                source: &mut self.source,
                position: &mut self.position,
            };
            let Some((opcode, body)) = next_record(&mut self.records, &mut source)? else {
                self.progress = Progress::Done;
                return Ok(());
            };
            match opcode {
                op::DATA_END => {
                    self.progress = Progress::Summary;
                    self.in_summary = true;
                }
                // What it repeats and what is damaged of it does not matter; a channel without messages may be new.
                _ if self.progress == Progress::Summary => {
                    if matches!(opcode, op::SCHEMA | op::CHANNEL) {
                        self.read_record(opcode, &body).ok();
                    }
                }
                op::CHUNK => self.read_chunk(&body)?,
                _ => self.read_record(opcode, &body)?,
            }
        }
        Ok(())
    }

    /// Reads a chunk with a reader that cannot go beyond the chunk's end.
    fn read_chunk(&mut self, body: &[u8]) -> McapResult<()> {
        /// Length of the fields before the data, without the name of the compression \[bytes\].
        const FIXED_FIELDS: usize = 40;
        // Without what follows the data. Otherwise a damaged size of the data makes the library's reader panic.
        let Record::Chunk { header, data } = mcap::parse_record(op::CHUNK, body)? else {
            return Ok(());
        };
        let body = &body[..FIXED_FIELDS + header.compression.len() + data.len()];
        let options = options().with_skip_start_magic(true).with_skip_end_magic(true);
        let mut records = LinearReader::new_with_options(options);
        let prefix = [&[op::CHUNK][..], &(body.len() as u64).to_le_bytes()].concat();
        let mut source = prefix.chain(body);
        while let Some((opcode, body)) = next_record(&mut records, &mut source)? {
            self.read_record(opcode, &body)?;
        }
        Ok(())
    }

    fn read_record(&mut self, opcode: u8, body: &[u8]) -> McapResult<()> {
        if !matches!(opcode, op::SCHEMA | op::CHANNEL | op::MESSAGE) {
            return Ok(());
        }
        match mcap::parse_record(opcode, body)? {
            Record::Schema { header, data } => self.channels.add_schema_from_slice(header, &data),
            Record::Channel(channel) => {
                let id = channel.id;
                let known = self.channels.get(id).is_some();
                self.channels.add_channel(channel)?;
                self.new_channels.extend(self.channels.get(id).filter(|_| !known));
                Ok(())
            }
            Record::Message { header, data } => {
                let unknown = || McapError::UnknownChannel(header.sequence, header.channel_id);
                let channel = self.channels.get(header.channel_id).ok_or_else(unknown)?;
                self.messages.push_back(Message {
                    channel,
                    sequence: header.sequence,
                    log_time: header.log_time,
                    publish_time: header.publish_time,
                    data: data.into_owned().into(),
                });
                Ok(())
            }
            _ => Ok(()),
        }
    }
}

impl<R: Read> Iterator for McapReader<R> {
    type Item = McapResult<Message<'static>>;

    fn next(&mut self) -> Option<Self::Item> {
        let filled = if self.progress == Progress::Done {
            Ok(())
        } else {
            self.fill()
        };
        if let Err(error) = filled {
            self.progress = Progress::Done;
            self.messages.clear();
            return Some(Err(error));
        }
        self.messages.pop_front().map(Ok)
    }
}

/// Counts what is read.
struct Counted<'a, R> {
    source: &'a mut R,
    position: &'a mut u64,
}

impl<R: Read> Read for Counted<'_, R> {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        let read = self.source.read(into)?;
        *self.position += read as u64;
        Ok(read)
    }
}

fn options() -> LinearReaderOptions {
    LinearReaderOptions::default()
        .with_record_length_limit(RECORD_LIMIT)
        .with_prevalidate_chunk_crcs(true)
}

/// The opcode and the body of the next record; None at the end.
fn next_record(records: &mut LinearReader, source: &mut impl Read) -> McapResult<Option<(u8, Vec<u8>)>> {
    while let Some(event) = records.next_event() {
        match event? {
            LinearReadEvent::Record { opcode, data } => return Ok(Some((opcode, data.to_vec()))),
            LinearReadEvent::ReadRequest(wanted) => {
                let read = loop {
                    match source.read(records.insert(wanted.min(BLOCK))) {
                        Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                        read => break read?,
                    }
                };
                records.notify_read(read);
            }
        }
    }
    Ok(None)
}

#[cfg(test)]
mod tests {
    use super::*;
    use mcap::records::MessageHeader;
    use mcap::{Compression, WriteOptions};
    use std::borrow::Cow;
    use std::collections::BTreeMap;
    use std::io::Cursor;

    /// Files of six messages and an attachment: compressed, in plain chunks with and without checksums, without chunks.
    fn files() -> Vec<Vec<u8>> {
        let plain = || WriteOptions::new().compression(None).chunk_size(Some(100));
        [
            WriteOptions::new()
                .compression(Some(Compression::Zstd))
                .chunk_size(Some(100)),
            plain(),
            plain().calculate_chunk_crcs(false),
            plain().use_chunks(false),
        ]
        .map(|options| {
            let mut writer = options.create(Cursor::new(Vec::new())).expect("begun");
            let schema = writer.add_schema("text", "text", b"any").expect("added");
            let channel = writer
                .add_channel(schema, "/chatter", "text", &BTreeMap::new())
                .expect("added");
            for number in 0..6 {
                let header = MessageHeader {
                    channel_id: channel,
                    sequence: number,
                    log_time: number.into(),
                    publish_time: 0,
                };
                writer
                    .write_to_known_channel(&header, &[number as u8; 50])
                    .expect("written");
            }
            let attachment = mcap::Attachment {
                log_time: 1,
                create_time: 1,
                name: "notes.txt".into(),
                media_type: "text/plain".into(),
                data: Cow::Borrowed(b"wet track"),
            };
            writer.attach(&attachment).expect("written");
            writer.finish().expect("ended");
            writer.into_inner().into_inner()
        })
        .into()
    }

    /// Reads a file to its end or to its fault; returns the number of messages and the fault.
    fn read(bytes: &[u8]) -> (usize, Option<McapError>) {
        let mut messages = 0;
        let mut reader = McapReader::new(bytes);
        while let Some(message) = reader.next() {
            match message {
                Ok(_) => messages += 1,
                Err(error) => {
                    assert!(reader.next().is_none(), "nothing follows an error");
                    return (messages, Some(error));
                }
            }
        }
        (messages, None)
    }

    #[test]
    fn every_message_is_read_as_the_reader_of_the_library_does() {
        for bytes in files() {
            let expected: Vec<_> = mcap::io::MessageReader::new(&bytes[..])
                .map(|message| message.expect("whole"))
                .collect();
            let messages: Vec<_> = McapReader::new(&bytes[..])
                .map(|message| message.expect("whole"))
                .collect();
            assert_eq!((messages.len(), &messages), (6, &expected));
        }
    }

    #[test]
    fn a_file_that_is_cut_off_anywhere_is_an_error() {
        for bytes in files() {
            for len in 0..bytes.len() {
                assert!(read(&bytes[..len]).1.is_some(), "cut at {len}");
            }
        }
    }

    // With damaged lengths, the reader of the library aborted for lack of memory or panicked.
    #[test]
    fn any_flipped_byte_gives_messages_or_an_error_and_never_a_panic() {
        for bytes in files() {
            for at in 0..bytes.len() {
                for flip in [1 << (at % 8), 0xff] {
                    let mut damaged = bytes.clone();
                    damaged[at] ^= flip;
                    read(&damaged);
                }
            }
        }
    }

    #[test]
    fn an_attachment_that_is_too_short_for_its_fields_is_skipped() {
        for bytes in files() {
            let name = bytes
                .windows(9)
                .position(|part| part == b"notes.txt")
                .expect("there");
            let begin = name - 20 - 9;
            assert_eq!(bytes[begin], op::ATTACHMENT);
            let len = u64::from_le_bytes(bytes[begin + 1..begin + 9].try_into().expect("eight")) as usize;
            // Its fields without the checksum: the parser of the library panics here.
            let mut short = bytes[..begin + 9 + len - 9 - 4].to_vec();
            short[begin + 1..begin + 9].copy_from_slice(&(len as u64 - 9 - 4).to_le_bytes());
            short.extend_from_slice(&bytes[begin + 9 + len..]);
            assert_eq!(read(&short).0, 6);
        }
    }
}
