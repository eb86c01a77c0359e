//! Reads the intact records of a damaged MCAP file.
//!
//! [`Salvage`] walks from record to record. Where a record is damaged it searches byte by byte for the next intact one.
//! Chunks are verified by their checksum before anything in them is used. Record lengths are checked against the file
//! and against [`RECORD_LIMIT`] before memory is allocated.

use std::borrow::Borrow;
use std::collections::BTreeSet;
use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;

use mcap::records::{Channel, MessageHeader, Metadata, SchemaHeader, Statistics, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{Attachment, MAGIC};

/// The largest record and the largest decompressed chunk that is read \[bytes\].
const RECORD_LIMIT: usize = 256 * 1024 * 1024;

/// Opcode and length of a record \[bytes\].
const PREFIX: u64 = 9;

/// An intact record, or a place where something is lost.
#[derive(Debug)]
pub(super) enum Salvaged {
    Header {
        profile: String,
        library: String,
    },
    Schema(SchemaHeader, Vec<u8>),
    Channel(Channel),
    Message(MessageHeader, Vec<u8>),
    Attachment(Attachment<'static>),
    Metadata(Metadata),
    Private {
        opcode: u8,
        data: Vec<u8>,
    },
    /// The end of the data; what follows is the summary.
    DataEnd,
    Statistics(Statistics),
    /// Bytes that could not be used, and why.
    Damage(String),
    /// The file ended with its end mark.
    Complete,
}

/// Walks through the records of a file.
pub(super) struct Salvage<F> {
    file: F,
    len: u64,
    at: u64,
    filter: Filter,
}

/// Leaves out the messages of some channels, before they are copied.
struct Filter {
    wanted: Box<dyn Fn(&Channel) -> bool + Send>,
    unwanted: BTreeSet<u16>,
}

impl Filter {
    /// Notes a channel, and passes its record on.
    fn note(&mut self, record: Option<Salvaged>) -> Option<Salvaged> {
        if let Some(Salvaged::Channel(channel)) = &record {
            if (self.wanted)(channel) {
                self.unwanted.remove(&channel.id);
            } else {
                self.unwanted.insert(channel.id);
            }
        }
        record
    }

    /// True for a message that is left out.
    fn leaves_out(&self, opcode: u8, body: &[u8]) -> bool {
        opcode == op::MESSAGE
            && !self.unwanted.is_empty()
            && body
                .first_chunk()
                .is_some_and(|channel| self.unwanted.contains(&u16::from_le_bytes(*channel)))
    }
}

impl<F: Borrow<File>> Salvage<F> {
    /// Begins after the start mark, which the caller has checked.
    pub(super) fn new(file: F) -> io::Result<Self> {
        Ok(Self {
            len: file.borrow().metadata()?.len(),
            file,
            at: MAGIC.len() as u64,
            filter: Filter {
                wanted: Box::new(|_| true),
                unwanted: BTreeSet::new(),
            },
        })
    }

    /// Leaves out the messages of channels that are not wanted.
    pub(super) fn only(mut self, wanted: impl Fn(&Channel) -> bool + Send + 'static) -> Self {
        self.filter.wanted = Box::new(wanted);
        self
    }

    /// The next records: one, or all those of a chunk. Empty at the end of the file. Chunks are skipped without
    /// `chunks`.
    pub(super) fn next(&mut self, chunks: bool) -> io::Result<Vec<Salvaged>> {
        loop {
            if self.at >= self.len {
                return Ok(Vec::new());
            }
            if self.at_end_mark(self.at)? {
                self.at = self.len;
                return Ok(vec![Salvaged::Complete]);
            }
            let Some((opcode, body)) = self.record(self.at)? else {
                return Ok(vec![self.skip_damage()?]);
            };
            let end = self.at + PREFIX + body.len() as u64;
            self.at = end;
            if opcode == op::CHUNK {
                if chunks {
                    let records = read_chunk(&body, &mut self.filter);
                    // Empty is the end of the file.
                    if !records.is_empty() {
                        return Ok(records);
                    }
                }
            } else if !self.filter.leaves_out(opcode, &body)
                && let Some(record) = self.filter.note(parse(opcode, &body))
            {
                return Ok(vec![record]);
            }
        }
    }

    /// Moves to the next intact record.
    fn skip_damage(&mut self) -> io::Result<Salvaged> {
        const BLOCK: u64 = 1 << 20;
        let from = self.at;
        let cut_off = self.is_cut_off(from)?;
        let mut at = from + 1;
        'search: while at < self.len {
            let block = self.bytes(at, BLOCK.min(self.len - at))?;
            for (offset, opcode) in block.iter().enumerate() {
                let candidate = at + offset as u64;
                if !(op::FOOTER..=op::DATA_END).contains(opcode) {
                    continue;
                }
                // Most candidates are ruled out by their length, without reading more.
                let fits = match block.get(offset + 1..offset + PREFIX as usize) {
                    Some(len) => fits(len, candidate, self.len),
                    None => true,
                };
                if fits && self.is_intact(candidate)? {
                    at = candidate;
                    break 'search;
                }
            }
            at += block.len() as u64;
        }
        self.at = at.min(self.len);
        Ok(Salvaged::Damage(if cut_off && self.at == self.len {
            format!(
                "the file was cut off, {} bytes at its end are no whole record",
                self.len - from
            )
        } else {
            format!("{} bytes at offset {from} are damaged", self.at - from)
        }))
    }

    /// True when an intact record begins here, and another one or the end mark follows it.
    fn is_intact(&self, at: u64) -> io::Result<bool> {
        match self.record(at)? {
            Some((_, body)) => self.plausible(at + PREFIX + body.len() as u64),
            None => Ok(false),
        }
    }

    /// True when a known record of a possible length begins here, or the file ends here.
    fn plausible(&self, at: u64) -> io::Result<bool> {
        if at == self.len || self.at_end_mark(at)? {
            return Ok(true);
        }
        if self.len < at + PREFIX {
            return Ok(false);
        }
        let prefix = self.bytes(at, PREFIX)?;
        Ok(is_known(prefix[0]) && fits(&prefix[1..], at, self.len))
    }

    /// True when the record here has a known opcode and goes on beyond the end of the file.
    fn is_cut_off(&self, at: u64) -> io::Result<bool> {
        if self.len < at + PREFIX {
            return Ok(true);
        }
        let prefix = self.bytes(at, PREFIX)?;
        Ok(is_known(prefix[0]) && !fits(&prefix[1..], at, self.len))
    }

    /// Opcode and body of the record here; None where there is no intact one.
    fn record(&self, at: u64) -> io::Result<Option<(u8, Vec<u8>)>> {
        if self.len < at + PREFIX {
            return Ok(None);
        }
        let prefix = self.bytes(at, PREFIX)?;
        let opcode = prefix[0];
        if !is_known(opcode) || !fits(&prefix[1..], at, self.len) {
            return Ok(None);
        }
        let body = self.bytes(at + PREFIX, length(&prefix[1..]))?;
        let intact = match after_fields(opcode, &body) {
            None => false,
            Some(rest) if is_exact(opcode) => rest == 0,
            // Its fields do not give its length, so what follows must prove it.
            Some(_) => self.plausible(at + PREFIX + body.len() as u64)?,
        };
        Ok(intact.then_some((opcode, body)))
    }

    fn at_end_mark(&self, at: u64) -> io::Result<bool> {
        let mark = MAGIC.len() as u64;
        Ok(at + mark == self.len && self.bytes(at, mark)? == MAGIC)
    }

    fn bytes(&self, at: u64, len: u64) -> io::Result<Vec<u8>> {
        let mut bytes = vec![0; len as usize];
        self.file.borrow().read_exact_at(&mut bytes, at)?;
        Ok(bytes)
    }
}

fn is_known(opcode: u8) -> bool {
    (op::HEADER..=op::DATA_END).contains(&opcode) || opcode >= 0x80
}

fn length(bytes: &[u8]) -> u64 {
    bytes
        .iter()
        .rev()
        .fold(0, |length, byte| length << 8 | u64::from(*byte))
}

/// True when a record at `at` with this length ends within the file and is not too long.
fn fits(len: &[u8], at: u64, file: u64) -> bool {
    let len = length(len);
    len <= RECORD_LIMIT as u64 && at + PREFIX + len <= file
}

/// Takes fields off the front of a record's body.
struct Fields<'a>(&'a [u8]);

impl<'a> Fields<'a> {
    fn take(&mut self, count: usize) -> Option<&'a [u8]> {
        let (taken, rest) = self.0.split_at_checked(count)?;
        self.0 = rest;
        Some(taken)
    }

    /// Bytes after their own length, which has `width` bytes.
    fn sized(&mut self, width: usize) -> Option<&'a [u8]> {
        let len = length(self.take(width)?);
        self.take(usize::try_from(len).ok()?)
    }
}

/// The rest of a body after all of its fields; None where the fields do not fit.
fn after_fields(opcode: u8, body: &[u8]) -> Option<usize> {
    let mut fields = Fields(body);
    match opcode {
        op::HEADER | op::METADATA => {
            fields.sized(4)?;
            fields.sized(4)?;
        }
        op::FOOTER => drop(fields.take(20)?),
        op::SCHEMA => {
            fields.take(2)?;
            fields.sized(4)?;
            fields.sized(4)?;
            fields.sized(4)?;
        }
        op::CHANNEL => {
            fields.take(4)?;
            fields.sized(4)?;
            fields.sized(4)?;
            fields.sized(4)?;
        }
        op::MESSAGE => drop(fields.take(22)?),
        op::CHUNK => {
            fields.take(28)?;
            let compression = fields.sized(4)?;
            if ![&b""[..], b"zstd", b"lz4"].contains(&compression) {
                return None;
            }
            fields.sized(8)?;
        }
        op::MESSAGE_INDEX => {
            fields.take(2)?;
            fields.sized(4)?;
        }
        op::ATTACHMENT => {
            fields.take(16)?;
            fields.sized(4)?;
            fields.sized(4)?;
            fields.sized(8)?;
            fields.take(4)?;
        }
        op::STATISTICS => {
            fields.take(42)?;
            fields.sized(4)?;
        }
        op::DATA_END => drop(fields.take(4)?),
        _ => {}
    }
    Some(fields.0.len())
}

/// True for records whose fields fill the body exactly.
fn is_exact(opcode: u8) -> bool {
    let open = matches!(
        opcode,
        op::MESSAGE | op::CHUNK_INDEX | op::ATTACHMENT_INDEX | op::METADATA_INDEX | op::SUMMARY_OFFSET
    );
    !open && opcode < 0x80
}

/// A record outside chunks; None for one that the writer makes anew.
fn parse(opcode: u8, body: &[u8]) -> Option<Salvaged> {
    use mcap::records::Record;
    if opcode >= 0x80 {
        let data = body.to_vec();
        return Some(Salvaged::Private { opcode, data });
    }
    let record = match mcap::parse_record(opcode, body) {
        Ok(record) => record,
        Err(error) => return Some(Salvaged::Damage(error.to_string())),
    };
    Some(match record {
        Record::Header(header) => Salvaged::Header {
            profile: header.profile,
            library: header.library,
        },
        Record::Schema { header, data } => Salvaged::Schema(header, data.into_owned()),
        Record::Channel(channel) => Salvaged::Channel(channel),
        Record::Message { header, data } => Salvaged::Message(header, data.into_owned()),
        Record::Attachment { header, data, .. } => Salvaged::Attachment(Attachment {
            log_time: header.log_time,
            create_time: header.create_time,
            name: header.name,
            media_type: header.media_type,
            data: data.into_owned().into(),
        }),
        Record::Metadata(metadata) => Salvaged::Metadata(metadata),
        Record::Statistics(statistics) => Salvaged::Statistics(statistics),
        Record::DataEnd(_) => Salvaged::DataEnd,
        _ => return None,
    })
}

/// The records of a chunk. A chunk with a wrong checksum gives none; one without a checksum gives those before the fault.
fn read_chunk(body: &[u8], filter: &mut Filter) -> Vec<Salvaged> {
    let options = LinearReaderOptions::default()
        .with_record_length_limit(RECORD_LIMIT)
        .with_prevalidate_chunk_crcs(true)
        .with_skip_start_magic(true)
        .with_skip_end_magic(true);
    let mut reader = LinearReader::new_with_options(options);
    let record = [&[op::CHUNK][..], &(body.len() as u64).to_le_bytes(), body].concat();
    let mut unread = &record[..];
    let mut records = Vec::new();
    while let Some(event) = reader.next_event() {
        match event {
            Ok(LinearReadEvent::ReadRequest(wanted)) => {
                let (read, rest) = unread.split_at(wanted.min(unread.len()));
                reader.insert(read.len()).copy_from_slice(read);
                reader.notify_read(read.len());
                unread = rest;
            }
            Ok(LinearReadEvent::Record { opcode, data }) => {
                if after_fields(opcode, data).is_some() {
                    if !filter.leaves_out(opcode, data) {
                        records.extend(filter.note(parse(opcode, data)));
                    }
                } else {
                    let text = format!("a record of kind {opcode} in a chunk is damaged");
                    records.push(Salvaged::Damage(text));
                }
            }
            Err(error) => {
                records.push(Salvaged::Damage(format!("a chunk is damaged: {error}")));
                break;
            }
        }
    }
    records
}
