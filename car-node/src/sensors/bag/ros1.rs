//! ROS 1 bags, format 2.0 (<http://wiki.ros.org/Bags/Format/2.0>), read from front to back: neither the index nor the end of
//! the file is needed.

use std::collections::HashMap;
use std::io::{self, Read};

use synpf::Stamp;

use super::reader::{Encoding, Fault, RECORD_LIMIT, Sink};

/// What every ROS 1 bag begins with.
pub(super) const MAGIC: &[u8] = b"#ROSBAG V";
const VERSION: &[u8] = b"2.0\n";
const FORM: &str = "ROS 1";
const REINDEX: &str = " (`rosbag reindex` makes a whole file of it)";
/// The header of a record names a topic and little else \[bytes\].
const HEADER_LIMIT: usize = 1 << 20;

/// What kind of record it is.
mod op {
    pub(super) const MESSAGE: u8 = 2;
    pub(super) const BAG_HEADER: u8 = 3;
    pub(super) const CHUNK: u8 = 5;
    pub(super) const CONNECTION: u8 = 7;
}

/// Reads the messages in the order in which they were written.
pub(super) fn read(source: impl Read, sink: &mut dyn Sink) -> Result<(), Fault> {
    let mut bag = Bag {
        sink,
        connections: HashMap::new(),
    };
    let mut records = Records { source, position: 0 };
    let mut magic = [0; MAGIC.len() + VERSION.len()];
    records.fill(&mut magic).map_err(|fault| fault.at(0))?;
    if !magic.ends_with(VERSION) {
        return Err(Fault::Damaged {
            form: FORM,
            place: "at its beginning".into(),
            fault: format!(
                "version {:?} is not 2.0",
                String::from_utf8_lossy(&magic[MAGIC.len()..]).trim_end()
            ),
            advice: " (`rosbag fix` makes a bag of version 2.0 of it)",
        });
    }
    loop {
        let begin = records.position;
        match records.next() {
            Ok(Some(record)) => bag.take(&record).map_err(|fault| fault.at(begin))?,
            Ok(None) => return Ok(()),
            Err(fault) => return Err(fault.at(begin)),
        }
    }
}

/// What is wrong with a record.
enum Wrong {
    /// The file ends within it.
    CutOff,
    Damaged(String),
    /// The fault is not the record's.
    Other(Fault),
}

impl From<io::Error> for Wrong {
    fn from(error: io::Error) -> Self {
        Self::Other(error.into())
    }
}

impl Wrong {
    /// The fault with its place in the file.
    fn at(self, position: u64) -> Fault {
        let place = format!("in the record at byte {position}");
        match self {
            Self::CutOff => Fault::CutOff {
                form: FORM,
                place,
                advice: REINDEX,
            },
            Self::Damaged(fault) => Fault::Damaged {
                form: FORM,
                place,
                fault,
                advice: "",
            },
            Self::Other(fault) => fault,
        }
    }
}

/// A record: its fields and its data.
struct Record {
    header: Vec<u8>,
    data: Vec<u8>,
}

impl Record {
    /// A field of the header.
    fn field(&self, name: &str) -> Result<&[u8], Wrong> {
        find(&self.header, name)?.ok_or_else(|| Wrong::Damaged(format!("it has no field {name:?}")))
    }

    fn number(&self, name: &str) -> Result<u32, Wrong> {
        let bytes = self.field(name)?;
        let bytes = bytes
            .try_into()
            .map_err(|_| Wrong::Damaged(format!("field {name:?} has {} bytes and not 4", bytes.len())))?;
        Ok(u32::from_le_bytes(bytes))
    }

    fn text(&self, name: &str) -> Result<String, Wrong> {
        Ok(String::from_utf8_lossy(self.field(name)?).into_owned())
    }

    fn op(&self) -> Result<u8, Wrong> {
        match self.field("op")? {
            [op] => Ok(*op),
            other => Err(Wrong::Damaged(format!("field \"op\" has {} bytes", other.len()))),
        }
    }
}

/// A field of a list of `name=value`, each behind its length.
fn find<'a>(mut fields: &'a [u8], name: &str) -> Result<Option<&'a [u8]>, Wrong> {
    while !fields.is_empty() {
        let (length, rest) = fields
            .split_first_chunk()
            .ok_or_else(|| Wrong::Damaged("a field without its length".into()))?;
        let length = u32::from_le_bytes(*length) as usize;
        let (field, rest) = rest.split_at_checked(length).ok_or_else(|| {
            Wrong::Damaged(format!("a field of {length} bytes where {} are left", rest.len()))
        })?;
        fields = rest;
        if let Some(value) = field.strip_prefix(name.as_bytes())
            && let Some(value) = value.strip_prefix(b"=")
        {
            return Ok(Some(value));
        }
    }
    Ok(None)
}

/// Records one after the other, in the file or in a chunk.
struct Records<R> {
    source: R,
    position: u64,
}

impl<R: Read> Records<R> {
    /// The next record; None at the end.
    fn next(&mut self) -> Result<Option<Record>, Wrong> {
        let Some(length) = self.length(true)? else {
            return Ok(None);
        };
        let header = self.bytes(length, HEADER_LIMIT)?;
        let length = self.length(false)?.ok_or(Wrong::CutOff)?;
        let data = self.bytes(length, RECORD_LIMIT)?;
        Ok(Some(Record { header, data }))
    }

    /// A length; None where the source ends before it, if it `may_end`.
    fn length(&mut self, may_end: bool) -> Result<Option<usize>, Wrong> {
        let mut bytes = Vec::new();
        self.source.by_ref().take(4).read_to_end(&mut bytes)?;
        self.position += bytes.len() as u64;
        match bytes[..] {
            [] if may_end => Ok(None),
            [a, b, c, d] => Ok(Some(u32::from_le_bytes([a, b, c, d]) as usize)),
            _ => Err(Wrong::CutOff),
        }
    }

    /// So many bytes. Memory is taken as they come, so that a damaged length takes no more than the file has.
    fn bytes(&mut self, length: usize, limit: usize) -> Result<Vec<u8>, Wrong> {
        if length > limit {
            return Err(Wrong::Damaged(format!(
                "a length of {length} bytes; {limit} are allowed"
            )));
        }
        let mut bytes = Vec::new();
        self.source.by_ref().take(length as u64).read_to_end(&mut bytes)?;
        self.position += bytes.len() as u64;
        if bytes.len() == length {
            Ok(bytes)
        } else {
            Err(Wrong::CutOff)
        }
    }

    fn fill(&mut self, into: &mut [u8]) -> Result<(), Wrong> {
        let bytes = self.bytes(into.len(), into.len())?;
        into.copy_from_slice(&bytes);
        Ok(())
    }
}

struct Bag<'a> {
    sink: &'a mut dyn Sink,
    /// Topics by the number of their connection; None for one that is not wanted.
    connections: HashMap<u32, Option<String>>,
}

impl Bag<'_> {
    fn take(&mut self, record: &Record) -> Result<(), Wrong> {
        match record.op()? {
            op::BAG_HEADER => match find(&record.header, "encryptor")? {
                Some(by) if !by.is_empty() => Err(Wrong::Damaged("it is encrypted".into())),
                _ => Ok(()),
            },
            op::CONNECTION => self.connect(record),
            op::MESSAGE => self.message(record),
            op::CHUNK => self.chunk(record),
            // Indices, which only help to jump to a time.
            _ => Ok(()),
        }
    }

    fn connect(&mut self, record: &Record) -> Result<(), Wrong> {
        let topic = record.text("topic")?;
        let message_type = find(&record.data, "type")?
            .ok_or_else(|| Wrong::Damaged(format!("the connection of {topic} has no type")))?;
        let message_type = String::from_utf8_lossy(message_type);
        let wanted = self.sink.topic(&topic, &message_type, Encoding::Ros1);
        self.connections
            .insert(record.number("conn")?, wanted.then_some(topic));
        Ok(())
    }

    fn message(&mut self, record: &Record) -> Result<(), Wrong> {
        let connection = record.number("conn")?;
        let topic = self.connections.get(&connection).ok_or_else(|| {
            Wrong::Damaged(format!("a message of connection {connection}, which is unknown"))
        })?;
        let Some(topic) = topic else {
            return Ok(());
        };
        let time = record.field("time")?;
        let [a, b, c, d, e, f, g, h] = time[..] else {
            return Err(Wrong::Damaged(format!("field \"time\" has {} bytes", time.len())));
        };
        let seconds = i64::from(u32::from_le_bytes([a, b, c, d]));
        let nanoseconds = i64::from(u32::from_le_bytes([e, f, g, h]));
        let log_time = Stamp(seconds * 1_000_000_000 + nanoseconds);
        self.sink
            .message(topic, log_time, &record.data)
            .map_err(Wrong::Other)
    }

    fn chunk(&mut self, record: &Record) -> Result<(), Wrong> {
        let size = record.number("size")? as usize;
        if size > RECORD_LIMIT {
            return Err(Wrong::Damaged(format!(
                "a chunk of {size} bytes; {RECORD_LIMIT} are allowed"
            )));
        }
        let data = &record.data[..];
        let compression = record.text("compression")?;
        let unpacked = match compression.as_str() {
            "none" => None,
            "bz2" => Some(unpack(bzip2::read::MultiBzDecoder::new(data), size)),
            "lz4" => Some(lz4::Decoder::new(data).and_then(|decoder| unpack(decoder, size))),
            _ => return Err(Wrong::Damaged(format!("compression {compression:?} is unknown"))),
        };
        let unpacked = unpacked
            .transpose()
            .map_err(|error| Wrong::Damaged(format!("{compression}: {error}")))?;
        let chunk = unpacked.as_deref().unwrap_or(data);
        if chunk.len() != size {
            let found = chunk.len();
            return Err(Wrong::Damaged(format!(
                "a chunk of {found} bytes that should have {size}"
            )));
        }
        let mut records = Records {
            source: chunk,
            position: 0,
        };
        loop {
            let begin = records.position;
            let inner = |wrong| match wrong {
                Wrong::CutOff => {
                    Wrong::Damaged(format!("byte {begin} of the chunk: the record goes beyond it"))
                }
                Wrong::Damaged(fault) => Wrong::Damaged(format!("byte {begin} of the chunk: {fault}")),
                Wrong::Other(fault) => Wrong::Other(fault),
            };
            let Some(record) = records.next().map_err(inner)? else {
                return Ok(());
            };
            // A chunk within a chunk is damage.
            if record.op().map_err(inner)? == op::CHUNK {
                return Err(inner(Wrong::Damaged("a chunk within a chunk".into())));
            }
            self.take(&record).map_err(inner)?;
        }
    }
}

/// Decompresses at most one byte more than there should be.
fn unpack(source: impl Read, size: usize) -> io::Result<Vec<u8>> {
    let mut unpacked = Vec::new();
    source.take(size as u64 + 1).read_to_end(&mut unpacked)?;
    Ok(unpacked)
}
