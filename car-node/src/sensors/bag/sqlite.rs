//! rosbag2's SQLite files (`.db3`).

use std::path::Path;

use rusqlite::limits::Limit;
use rusqlite::{Connection, OpenFlags};
use synpf::Stamp;

use super::reader::{Encoding, Fault, RECORD_LIMIT, Sink};

/// What every SQLite file begins with.
pub(super) const MAGIC: &[u8] = b"SQLite format 3\0";
const FORM: &str = "SQLite";

/// Reads the messages in the order in which they were written.
pub(super) fn read(path: &Path, sink: &mut dyn Sink) -> Result<(), Fault> {
    let mut read = 0_u64;
    read_counting(path, sink, &mut read).map_err(|fault| match fault {
        ReadFault::Sink(fault) => fault,
        ReadFault::Sqlite(error) => Fault::Damaged {
            form: FORM,
            place: format!("after {read} messages"),
            fault: error.to_string(),
            advice: "",
        },
    })
}

enum ReadFault {
    Sqlite(rusqlite::Error),
    Sink(Fault),
}

impl From<rusqlite::Error> for ReadFault {
    fn from(error: rusqlite::Error) -> Self {
        Self::Sqlite(error)
    }
}

fn read_counting(path: &Path, sink: &mut dyn Sink, read: &mut u64) -> Result<(), ReadFault> {
    let (connection, topics) = open(path)?;
    let mut wanted = std::collections::BTreeMap::new();
    for topic in topics {
        if let Some(encoding) = Encoding::named(&topic.format)
            && sink.topic(&topic.name, &topic.message_type, encoding)
        {
            wanted.insert(topic.id, topic.name);
        }
    }
    // By the row's number, as they were written: the table itself, and no index that may be missing.
    let mut statement =
        connection.prepare("SELECT topic_id, timestamp, data FROM messages ORDER BY rowid")?;
    let mut rows = statement.query([])?;
    while let Some(row) = rows.next()? {
        *read += 1;
        let Some(topic) = wanted.get(&row.get::<_, i64>(0)?) else {
            continue;
        };
        let log_time = Stamp(row.get(1)?);
        let payload = row.get_ref(2)?.as_blob().map_err(|error| {
            rusqlite::Error::FromSqlConversionFailure(2, rusqlite::types::Type::Blob, error.into())
        })?;
        sink.message(topic, log_time, payload).map_err(ReadFault::Sink)?;
    }
    Ok(())
}

/// A row of the table of topics.
struct Topic {
    id: i64,
    name: String,
    message_type: String,
    format: String,
}

/// Opens the file for reading only. A file that was never closed has its last messages in a log beside it, which SQLite
/// reads if it may write there; elsewhere the file is read as it is.
fn open(path: &Path) -> Result<(Connection, Vec<Topic>), rusqlite::Error> {
    let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    let plain = Connection::open_with_flags(path, flags).and_then(with_topics);
    if plain.is_ok() {
        return plain;
    }
    let uri = immutable(path);
    let flags = flags | OpenFlags::SQLITE_OPEN_URI;
    Connection::open_with_flags(uri, flags)
        .and_then(with_topics)
        .or(plain)
}

fn with_topics(connection: Connection) -> Result<(Connection, Vec<Topic>), rusqlite::Error> {
    connection.set_limit(Limit::SQLITE_LIMIT_LENGTH, RECORD_LIMIT as i32)?;
    let topics = connection
        .prepare("SELECT id, name, type, serialization_format FROM topics")?
        .query_map([], |row| {
            Ok(Topic {
                id: row.get(0)?,
                name: row.get(1)?,
                message_type: row.get(2)?,
                format: row.get(3)?,
            })
        })?
        .collect::<Result<_, _>>()?;
    Ok((connection, topics))
}

/// The address of a file that nobody else changes.
fn immutable(path: &Path) -> String {
    let mut uri = String::from("file:");
    for &byte in path.as_os_str().as_encoded_bytes() {
        match byte {
            b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' | b'/' | b'.' | b'-' | b'_' => uri.push(byte.into()),
            _ => {
                uri.push('%');
                uri.extend(
                    [byte >> 4, byte & 15].map(|digit| char::from_digit(digit.into(), 16).unwrap_or('0')),
                );
            }
        }
    }
    uri + "?immutable=1"
}
