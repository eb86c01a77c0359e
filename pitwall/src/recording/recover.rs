//! Repairs a recording that was cut off or damaged.

use std::collections::BTreeMap;
use std::fmt;
use std::fs::{self, File, OpenOptions};
use std::io::BufWriter;
use std::path::Path;

use mcap::records::{Channel, MessageHeader, SchemaHeader, Statistics};
use mcap::{McapError, WriteOptions, Writer};
use serde::Serialize;

use super::error::RecordingError;
use super::reader::open;
use super::salvage::{Salvage, Salvaged};

/// What was saved, and what was lost.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Recovered {
    /// Messages saved.
    pub messages: u64,
    /// Attachments saved.
    pub attachments: u64,
    /// Metadata records saved.
    pub metadata: u64,
    /// From the first saved message to the last \[s\].
    pub duration_s: f64,
    /// True when the file ended as a complete recording does.
    pub complete: bool,
    /// Each damaged place, in order.
    pub damage: Vec<Damage>,
    /// Messages, attachments and metadata records lost, by the file's own statistics; None when those cannot be read.
    pub lost: Option<u64>,
}

/// A damaged place. What is lost there was recorded between two saved messages.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Damage {
    /// Log time of the last message saved before it \[unix ns\]; None at the beginning.
    pub from: Option<u64>,
    /// Log time of the first message saved after it \[unix ns\]; None at the end.
    pub to: Option<u64>,
    /// The same as `from`, from the first saved message on \[s\].
    pub from_s: Option<f64>,
    /// The same as `to`, from the first saved message on \[s\].
    pub to_s: Option<f64>,
    /// What is wrong.
    pub reason: String,
}

impl Recovered {
    /// True when something that was in the file could not be saved, as far as that is known.
    pub fn has_losses(&self) -> bool {
        self.lost.map_or(!self.damage.is_empty(), |lost| lost > 0)
    }
}

impl fmt::Display for Damage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self.from_s, self.to_s) {
            (Some(from), Some(to)) => write!(f, "between {from:.2} s and {to:.2} s")?,
            (None, Some(_)) => f.write_str("before the first saved message")?,
            (Some(from), None) => write!(f, "after {from:.2} s")?,
            (None, None) => f.write_str("everywhere")?,
        }
        write!(f, ": {}", self.reason)
    }
}

/// Saves everything intact in `from` into the new file `to`: messages, attachments, metadata and the header's profile.
/// When there is no intact message, there is no new file.
pub fn recover(from: &Path, to: &Path) -> Result<Recovered, RecordingError> {
    let input = open(from)?;
    let output = OpenOptions::new()
        .write(true)
        .create_new(true)
        .open(to)
        .map_err(|e| RecordingError::io(to, e))?;
    let recovered = copy(&input, from, output, to);
    let nothing = match &recovered {
        Ok(recovered) if recovered.messages > 0 => return Ok(recovered.clone()),
        Ok(recovered) => {
            let reason = recovered.damage.first().map(|damage| damage.reason.clone());
            Err(RecordingError::Nothing {
                file: from.display().to_string(),
                reason: reason.unwrap_or_else(|| "it contains no message".to_owned()),
            })
        }
        Err(_) => recovered,
    };
    fs::remove_file(to).map_err(|e| RecordingError::io(to, e))?;
    nothing
}

fn copy(input: &File, from: &Path, output: File, to: &Path) -> Result<Recovered, RecordingError> {
    let read = |e| RecordingError::io(from, e);
    let written = |e| RecordingError::mcap(to, e);
    // The summary repeats all schemas and channels, for chunks behind a damaged one that defined them.
    let mut definitions = Definitions::default();
    let mut header = (String::new(), String::new());
    let mut walk = Salvage::new(input).map_err(read)?;
    loop {
        let records = walk.next(false).map_err(read)?;
        if records.is_empty() {
            break;
        }
        for record in records {
            match record {
                Salvaged::Header { profile, library } => header = (profile, library),
                Salvaged::Schema(header, data) => drop(definitions.schemas.insert(header.id, (header, data))),
                Salvaged::Channel(channel) => drop(definitions.channels.insert(channel.id, channel)),
                _ => {}
            }
        }
    }
    let (profile, library) = header;
    let options = WriteOptions::new().profile(profile).library(library);
    let mut copy = Copy {
        writer: options.create(BufWriter::new(output)).map_err(written)?,
        definitions,
        messages: 0,
        attachments: 0,
        metadata: 0,
        span: None,
        last: None,
        complete: false,
        in_summary: false,
        damage: Vec::new(),
        statistics: None,
    };
    let mut walk = Salvage::new(input).map_err(read)?;
    loop {
        let records = walk.next(true).map_err(read)?;
        if records.is_empty() {
            break;
        }
        for record in records {
            copy.add(record).map_err(written)?;
        }
    }
    copy.writer.finish().map_err(written)?;
    Ok(copy.recovered())
}

/// Schemas and channels by id.
#[derive(Default)]
struct Definitions {
    schemas: BTreeMap<u16, (SchemaHeader, Vec<u8>)>,
    channels: BTreeMap<u16, Channel>,
}

/// A recovery in progress.
struct Copy {
    writer: Writer<BufWriter<File>>,
    definitions: Definitions,
    messages: u64,
    attachments: u64,
    metadata: u64,
    /// Log times of the earliest and the latest message saved \[unix ns\].
    span: Option<(u64, u64)>,
    /// Log time of the last message saved \[unix ns\].
    last: Option<u64>,
    complete: bool,
    in_summary: bool,
    damage: Vec<Damage>,
    statistics: Option<Statistics>,
}

impl Copy {
    fn add(&mut self, record: Salvaged) -> Result<(), McapError> {
        match record {
            Salvaged::Header { .. } => {}
            Salvaged::DataEnd => self.in_summary = true,
            // The writer makes the summary anew.
            Salvaged::Schema(..) | Salvaged::Channel(_) if self.in_summary => {}
            Salvaged::Schema(header, data) => {
                let added = self
                    .writer
                    .add_schema_with_id(header.id, &header.name, &header.encoding, &data);
                self.note(added)?;
            }
            Salvaged::Channel(channel) => {
                let added = self.add_channel(&channel);
                self.note(added)?;
            }
            Salvaged::Message(header, data) => {
                let mut written = self.writer.write_to_known_channel(&header, &data);
                if let Err(McapError::UnknownChannel(..)) = written
                    && let Some(channel) = self.definitions.channels.get(&header.channel_id).cloned()
                {
                    let added = self.add_channel(&channel);
                    if self.note(added)?.is_some() {
                        written = self.writer.write_to_known_channel(&header, &data);
                    }
                }
                if self.note(written)?.is_some() {
                    self.saved(&header);
                }
            }
            Salvaged::Attachment(attachment) => {
                self.writer.attach(&attachment)?;
                self.attachments += 1;
            }
            Salvaged::Metadata(metadata) => {
                self.writer.write_metadata(&metadata)?;
                self.metadata += 1;
            }
            Salvaged::Private { opcode, data } => {
                self.writer.write_private_record(opcode, &data, <_>::default())?;
            }
            Salvaged::Statistics(statistics) => self.statistics = Some(statistics),
            Salvaged::Damage(reason) => self.add_damage(reason),
            Salvaged::Complete => self.complete = true,
        }
        Ok(())
    }

    fn add_channel(&mut self, channel: &Channel) -> Result<u16, McapError> {
        if let Some((header, data)) = self.definitions.schemas.get(&channel.schema_id) {
            // Fails when the file has defined this id differently; then its own definition stays.
            self.writer
                .add_schema_with_id(header.id, &header.name, &header.encoding, data)
                .ok();
        }
        self.writer.add_channel_with_id(
            channel.id,
            channel.schema_id,
            &channel.topic,
            &channel.message_encoding,
            &channel.metadata,
        )
    }

    /// Handles the outcome of a write. A disk error ends the recovery. A record that the writer rejects is damage.
    fn note<T>(&mut self, outcome: Result<T, McapError>) -> Result<Option<T>, McapError> {
        match outcome {
            Ok(value) => Ok(Some(value)),
            Err(McapError::Io(error)) => Err(McapError::Io(error)),
            Err(error) => {
                let reason = error.to_string();
                let repeated = self.damage.last().is_some_and(|damage| damage.reason == reason);
                if !repeated {
                    self.add_damage(reason);
                }
                Ok(None)
            }
        }
    }

    fn saved(&mut self, header: &MessageHeader) {
        let time = header.log_time;
        for damage in self
            .damage
            .iter_mut()
            .rev()
            .take_while(|damage| damage.to.is_none())
        {
            damage.to = Some(time);
        }
        self.messages += 1;
        self.last = Some(time);
        self.span = Some(
            self.span
                .map_or((time, time), |(a, b)| (a.min(time), b.max(time))),
        );
    }

    fn add_damage(&mut self, reason: String) {
        self.damage.push(Damage {
            from: self.last,
            to: None,
            from_s: None,
            to_s: None,
            reason,
        });
    }

    fn recovered(mut self) -> Recovered {
        let (first, last) = self.span.unwrap_or_default();
        let seconds = |time: u64| (time as f64 - first as f64) * 1e-9;
        for damage in &mut self.damage {
            damage.from_s = damage.from.map(seconds);
            damage.to_s = damage.to.map(seconds);
        }
        // Statistics whose numbers contradict each other are damaged themselves.
        let statistics = self.statistics.as_ref().filter(|statistics| {
            let counted = statistics
                .channel_message_counts
                .values()
                .try_fold(0_u64, |sum, count| sum.checked_add(*count));
            counted == Some(statistics.message_count)
        });
        let lost = statistics.map(|statistics| {
            let lost = |recorded: u64, saved: u64| recorded.saturating_sub(saved);
            lost(statistics.message_count, self.messages)
                + lost(statistics.attachment_count.into(), self.attachments)
                + lost(statistics.metadata_count.into(), self.metadata)
        });
        Recovered {
            messages: self.messages,
            attachments: self.attachments,
            metadata: self.metadata,
            duration_s: (last - first) as f64 * 1e-9,
            complete: self.complete,
            damage: self.damage,
            lost,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recording::read_events;
    use crate::recording::reader::tests::small_recording;
    use std::path::PathBuf;

    struct Case {
        _folder: tempfile::TempDir,
        file: PathBuf,
        to: PathBuf,
    }

    impl Case {
        fn new() -> Self {
            let folder = tempfile::tempdir().expect("a folder");
            let [file, to] = ["file", "to"].map(|name| folder.path().join(name));
            Self {
                _folder: folder,
                file,
                to,
            }
        }

        fn recover(&self, bytes: &[u8]) -> Result<Recovered, RecordingError> {
            fs::write(&self.file, bytes).expect("written");
            fs::remove_file(&self.to).ok();
            recover(&self.file, &self.to)
        }

        /// The numbers of the events that the recovered file holds.
        fn numbers(&self) -> Vec<u64> {
            read_events(&self.to)
                .expect("opens")
                .map(|event| event.expect("whole").at as u64)
                .collect()
        }
    }

    /// The message of an error, which names the file as `FILE`.
    fn fault<T>(result: Result<T, RecordingError>, file: &Path) -> String {
        let error = result.err().expect("a fault");
        error.to_string().replace(&file.display().to_string(), "FILE")
    }

    /// Where the records of this kind begin and end in a file.
    fn records(bytes: &[u8], kind: u8) -> Vec<std::ops::Range<usize>> {
        let (mut at, mut found) = (mcap::MAGIC.len(), Vec::new());
        while at + 9 <= bytes.len() - mcap::MAGIC.len() {
            let len = u64::from_le_bytes(bytes[at + 1..at + 9].try_into().expect("eight"));
            let end = at + 9 + len as usize;
            if bytes[at] == kind {
                found.push(at..end);
            }
            at = end;
        }
        found
    }

    #[test]
    fn a_file_of_another_kind_is_an_error_and_leaves_nothing_behind() {
        let case = Case::new();
        let (file, to) = (&case.file, &case.to);
        let text = fault(recover(file, to), file);
        assert!(text.starts_with("FILE: No such file"), "{text}");
        for content in ["", "hello", "a text that is longer than the magic bytes"] {
            fs::write(file, content).expect("written");
            let foreign = "FILE is not a recording: it does not start as an MCAP file does";
            assert_eq!(fault(recover(file, to), file), foreign);
            assert_eq!(fault(read_events(file), file), foreign);
        }
        assert!(!to.exists());
    }

    #[test]
    fn a_file_without_records_names_the_repair_and_has_nothing_to_save() {
        let case = Case::new();
        fs::write(&case.file, mcap::MAGIC).expect("written");
        let first = read_events(&case.file)
            .expect("a beginning")
            .next()
            .expect("a fault");
        let text = fault(first, &case.file);
        assert!(
            text.ends_with("`pitwall recover FILE` saves the intact part"),
            "{text}"
        );
        let text = fault(recover(&case.file, &case.to), &case.file);
        assert!(text.starts_with("FILE: nothing can be saved"), "{text}");
        assert!(!case.to.exists());
    }

    #[test]
    fn a_whole_file_is_copied_with_everything_in_it() {
        let case = Case::new();
        let bytes = small_recording();
        let recovered = case.recover(&bytes).expect("saved");
        assert_eq!(case.numbers(), (0..100).collect::<Vec<_>>());
        assert!(!recovered.has_losses() && recovered.damage.is_empty() && recovered.complete);
        assert_eq!((recovered.attachments, recovered.metadata), (1, 2));
        assert_eq!(recovered.lost, Some(0));
        let [before, after] = [&bytes, &fs::read(&case.to).expect("readable")].map(|bytes| {
            let summary = mcap::Summary::read(bytes).expect("whole").expect("a summary");
            let stats = summary.stats.expect("statistics");
            (
                stats.message_count,
                stats.attachment_count,
                stats.metadata_count,
                stats.channel_message_counts,
            )
        });
        assert_eq!(before, after);
    }

    #[test]
    fn the_profile_of_another_program_is_kept() {
        let case = Case::new();
        let options = WriteOptions::new().profile("ros2").library("libmcap");
        let mut writer = options.create(std::io::Cursor::new(Vec::new())).expect("begun");
        let channel = writer
            .add_channel(0, "/chatter", "json", &BTreeMap::new())
            .expect("added");
        let header = MessageHeader {
            channel_id: channel,
            sequence: 1,
            log_time: 5,
            publish_time: 5,
        };
        writer.write_to_known_channel(&header, b"{}").expect("written");
        writer.finish().expect("ended");
        case.recover(&writer.into_inner().into_inner()).expect("saved");
        let saved = fs::read(&case.to).expect("readable");
        let first = mcap::read::LinearReader::new(&saved)
            .expect("whole")
            .next()
            .expect("a record");
        let Ok(mcap::records::Record::Header(header)) = first else {
            panic!("{first:?}");
        };
        assert_eq!(
            (header.profile.as_str(), header.library.as_str()),
            ("ros2", "libmcap")
        );
    }

    #[test]
    fn everything_behind_a_damaged_chunk_is_saved_and_the_loss_is_reported() {
        let case = Case::new();
        let mut bytes = small_recording();
        let chunk = records(&bytes, 6)[3].clone();
        bytes[chunk.end - 20] ^= 0x10;
        assert!(
            {
                fs::write(&case.file, &bytes).expect("written");
                read_events(&case.file)
                    .expect("opens")
                    .any(|event| event.is_err())
            },
            "a reader verifies the checksum"
        );
        let recovered = case.recover(&bytes).expect("saved");
        let numbers = case.numbers();
        assert_eq!(numbers, (0..30).chain(40..100).collect::<Vec<_>>());
        assert_eq!((recovered.attachments, recovered.metadata), (1, 2));
        assert_eq!((recovered.lost, recovered.has_losses()), (Some(20), true));
        let [damage] = &recovered.damage[..] else {
            panic!("{recovered:?}");
        };
        assert_eq!((damage.from, damage.to), (Some(29), Some(40)));
    }

    #[test]
    fn channels_that_the_damaged_first_chunk_defined_are_known_from_the_summary() {
        let case = Case::new();
        let mut bytes = small_recording();
        let chunk = records(&bytes, 6)[0].clone();
        bytes[chunk.end - 20] ^= 0x10;
        case.recover(&bytes).expect("saved");
        assert_eq!(case.numbers(), (10..100).collect::<Vec<_>>());
    }

    #[test]
    fn a_damaged_length_takes_no_memory_and_costs_its_record_only() {
        let case = Case::new();
        let whole = small_recording();
        for kind in [6, 7, 9, 12] {
            let record = records(&whole, kind)[0].clone();
            for byte in 1..9 {
                let mut bytes = whole.clone();
                bytes[record.start + byte] ^= 0x55;
                let recovered = case.recover(&bytes).expect("saved");
                let saved = case.numbers().len();
                assert!(saved >= 90, "kind {kind}, byte {byte}: {saved}, {recovered:?}");
                fs::write(&case.file, &bytes).expect("written");
                assert!(read_events(&case.file).expect("opens").count() <= 101);
            }
        }
    }

    #[test]
    fn any_damage_costs_one_chunk_and_never_a_panic() {
        let case = Case::new();
        let whole = small_recording();
        let chunks = records(&whole, 6);
        let data_end = records(&whole, 15)[0].end;
        let mut dice = 7_u64;
        let mut roll = move |sides: usize| {
            dice = dice.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            (dice >> 33) as usize % sides
        };
        let begin = mcap::MAGIC.len();
        for _ in 0..200 {
            let mut bytes = whole.clone();
            let at = begin + roll(bytes.len() - begin);
            bytes[at] ^= 1 << roll(8);
            let outcome = case.recover(&bytes);
            let recovered = outcome.unwrap_or_else(|error| panic!("a flip at {at}: {error}"));
            let numbers = case.numbers();
            let damaged = chunks.iter().position(|chunk| chunk.contains(&at));
            let expected = (0..100).filter(|number| damaged != Some(number / 10));
            let missing: Vec<_> = expected
                .filter(|number| !numbers.contains(&(*number as u64)))
                .collect();
            assert!(missing.is_empty(), "a flip at {at}: {missing:?}, {recovered:?}");
            if damaged.is_none() && at < data_end {
                assert!(recovered.attachments + recovered.metadata >= 1, "a flip at {at}");
            }
            fs::write(&case.file, &bytes).expect("written");
            read_events(&case.file).map(Iterator::count).expect("opens");
        }
        for _ in 0..50 {
            let len = roll(whole.len());
            let complete = chunks.iter().filter(|chunk| chunk.end <= len).count();
            match case.recover(&whole[..len]) {
                Ok(recovered) => {
                    assert!(!recovered.complete);
                    assert_eq!(case.numbers().len(), 10 * complete, "cut at {len}: {recovered:?}");
                }
                Err(error) => assert_eq!(complete, 0, "cut at {len}: {error}"),
            }
        }
    }
}
