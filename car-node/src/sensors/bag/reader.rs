//! What every form of bag has in common: topics, messages, faults. Opens a file by its first bytes, whatever its name is.

use std::fs::File;
use std::io::{self, BufReader, Read, Seek, Write};
use std::path::Path;

use mcap::McapError;
use synpf::Stamp;

use super::mcap_reader::McapReader;
use super::{ros1, sqlite};

/// How the bytes of a message are laid out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Encoding {
    /// ROS 2.
    Cdr,
    /// ROS 1.
    Ros1,
}

impl Encoding {
    /// By the name that MCAP and rosbag2 give it; None for one that is not read.
    pub(super) fn named(name: &str) -> Option<Self> {
        match name {
            "cdr" => Some(Self::Cdr),
            "ros1" => Some(Self::Ros1),
            _ => None,
        }
    }
}

/// Takes what a bag contains, in the order in which it is in the file.
pub(super) trait Sink {
    /// A topic of the bag, with or without messages. Returns true if its messages are wanted. May be called again.
    fn topic(&mut self, name: &str, message_type: &str, encoding: Encoding) -> bool;
    /// A message of a topic that is wanted.
    fn message(&mut self, topic: &str, log_time: Stamp, payload: &[u8]) -> Result<(), Fault>;
    /// Messages taken so far.
    fn taken(&self) -> u64;
}

/// Why a file cannot be read, or not to its end.
#[derive(Debug, thiserror::Error)]
pub(super) enum Fault {
    /// The file does not read.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// Not a file of this form, or damaged.
    #[error("not a readable {form} file {place}: {fault}{advice}")]
    Damaged {
        /// The form of the file.
        form: &'static str,
        /// Where in the file.
        place: String,
        /// What is wrong there.
        fault: String,
        /// What helps.
        advice: &'static str,
    },
    /// The file ends before it should. What came before is whole.
    #[error("the {form} file is cut off {place}{advice}")]
    CutOff {
        /// The form of the file.
        form: &'static str,
        /// Where in the file.
        place: String,
        /// What helps.
        advice: &'static str,
    },
    /// A message does not decode.
    #[error("{topic}: message {number}: {fault}")]
    Message {
        /// The topic.
        topic: String,
        /// Counted on the topic, from 1.
        number: usize,
        /// What is wrong with it.
        fault: String,
    },
    /// More than fits into memory.
    #[error("more than {} GiB of scans and odometry; give a part of the drive", .0 >> 30)]
    TooLarge(u64),
}

/// The largest message, record or decompressed chunk that is read \[bytes\].
pub(super) const RECORD_LIMIT: usize = 256 * 1024 * 1024;
/// The largest file that a compressed file may become \[bytes\].
const FILE_LIMIT: u64 = 64 << 30;

const MCAP: &[u8] = b"\x89MCAP0\r\n";
const ZSTD: &[u8] = b"\x28\xb5\x2f\xfd";
/// Enough to recognize every form \[bytes\].
const LONGEST_MAGIC: usize = 16;

/// Reads one file of any form: MCAP, SQLite, ROS 1, each also as a whole compressed by zstd.
pub(super) fn read_file(path: &Path, sink: &mut dyn Sink) -> Result<(), Fault> {
    let mut file = BufReader::new(File::open(path)?);
    let magic = first_bytes(&mut file)?;
    if magic.starts_with(sqlite::MAGIC) {
        return sqlite::read(path, sink);
    }
    if !magic.starts_with(ZSTD) {
        return read_stream(&magic, magic.chain(file), sink);
    }
    let damaged = |error: io::Error| Fault::Damaged {
        form: "zstd",
        place: "at its beginning".into(),
        fault: error.to_string(),
        advice: "",
    };
    let mut plain = zstd::stream::read::Decoder::new(magic.chain(file)).map_err(damaged)?;
    let magic = first_bytes(&mut plain).map_err(damaged)?;
    if magic.starts_with(sqlite::MAGIC) {
        // SQLite needs a file that it can seek in.
        let mut unpacked = tempfile::NamedTempFile::new()?;
        let written = io::copy(&mut magic.chain(plain).take(FILE_LIMIT), &mut unpacked).map_err(damaged)?;
        if written == FILE_LIMIT {
            return Err(Fault::TooLarge(FILE_LIMIT));
        }
        unpacked.flush()?;
        unpacked.rewind()?;
        return sqlite::read(unpacked.path(), sink);
    }
    read_stream(&magic, magic.chain(plain), sink)
}

fn first_bytes(source: &mut impl Read) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    source.take(LONGEST_MAGIC as u64).read_to_end(&mut bytes)?;
    Ok(bytes)
}

fn read_stream(magic: &[u8], source: impl Read, sink: &mut dyn Sink) -> Result<(), Fault> {
    if magic.starts_with(ros1::MAGIC) {
        ros1::read(source, sink)
    } else if magic.starts_with(MCAP) {
        read_mcap(source, sink)
    } else if magic.is_empty() {
        Err(Fault::Damaged {
            form: "bag",
            place: "at its beginning".into(),
            fault: "it is empty".into(),
            advice: "",
        })
    } else {
        Err(Fault::Damaged {
            form: "bag",
            place: "at its beginning".into(),
            fault: "it is neither MCAP, nor rosbag2's SQLite (.db3), nor a ROS 1 bag".into(),
            advice: "",
        })
    }
}

fn read_mcap(source: impl Read, sink: &mut dyn Sink) -> Result<(), Fault> {
    const FORM: &str = "MCAP";
    let mut reader = McapReader::new(source);
    let mut read = 0_u64;
    loop {
        let message = reader.next();
        // A channel stands before its messages, or, without any, in the summary.
        for channel in reader.take_channels() {
            if let Some(encoding) = Encoding::named(&channel.message_encoding) {
                let schema = channel.schema.as_ref().map_or("", |schema| &schema.name);
                sink.topic(&channel.topic, schema, encoding);
            }
        }
        let Some(message) = message else {
            return Ok(());
        };
        let message = match message {
            Ok(message) => message,
            // The messages are all there.
            Err(error) if reader.in_summary() => {
                tracing::debug!(%error, "the summary of an MCAP file is damaged");
                return Ok(());
            }
            Err(McapError::UnexpectedEof) => {
                return Err(Fault::CutOff {
                    form: FORM,
                    place: format!("after {read} messages"),
                    advice: " (`mcap recover` saves what is intact)",
                });
            }
            Err(error) => {
                return Err(Fault::Damaged {
                    form: FORM,
                    place: format!("after {read} messages, before byte {}", reader.position()),
                    fault: error.to_string(),
                    advice: "",
                });
            }
        };
        read += 1;
        let channel = &message.channel;
        let Some(encoding) = Encoding::named(&channel.message_encoding) else {
            continue;
        };
        let schema = channel.schema.as_ref().map_or("", |schema| &schema.name);
        if sink.topic(&channel.topic, schema, encoding) {
            let log_time = Stamp(i64::try_from(message.log_time).unwrap_or(i64::MAX));
            sink.message(&channel.topic, log_time, &message.data)?;
        }
    }
}

/// A message as its publisher sent it. rosbag2 can compress each by itself; CDR never begins with the bytes that zstd begins
/// with.
pub(super) fn plain_message(payload: &[u8]) -> io::Result<Option<Vec<u8>>> {
    if !payload.starts_with(ZSTD) {
        return Ok(None);
    }
    let mut plain = Vec::new();
    zstd::stream::read::Decoder::new(payload)?
        .take(RECORD_LIMIT as u64)
        .read_to_end(&mut plain)?;
    Ok(Some(plain))
}
