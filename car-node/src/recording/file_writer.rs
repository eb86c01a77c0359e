//! Writes one file of a recording.

use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::io::BufWriter;
use std::path::Path;

use mcap::records::{MessageHeader, Metadata};
use mcap::{McapError, WriteOptions, Writer};
use protocol::{CarInfo, CarName, Key, Topic, ros};
use serde_json::json;
use synpf::Stamp;

use super::recorder::Entry;
use super::ros_channels::RosMessage;

/// What each file begins with.
#[derive(Debug, Clone)]
pub struct FileHead {
    /// The car.
    pub car: CarName,
    /// This run of the node.
    pub run_id: u64,
    /// The map, encoded as a message.
    pub map: Vec<u8>,
    /// What runs on the car.
    pub info: CarInfo,
}

/// A file being written.
pub(super) struct FileWriter {
    writer: Writer<BufWriter<File>>,
    sync: File,
    channels: HashMap<String, u16>,
    schemas: HashMap<&'static str, u16>,
    head: FileHead,
}

impl FileWriter {
    /// Begins the file with the head.
    pub(super) fn new(file: File, head: FileHead, now: Stamp) -> Result<Self, McapError> {
        let sync = file.try_clone()?;
        let options = WriteOptions::new()
            .profile("")
            .library(concat!("car-node ", env!("CARGO_PKG_VERSION")));
        let mut file = Self {
            writer: options.create(BufWriter::new(file))?,
            sync,
            channels: HashMap::new(),
            schemas: HashMap::new(),
            head,
        };
        file.write_head(now)?;
        Ok(file)
    }

    fn write_head(&mut self, now: Stamp) -> Result<(), McapError> {
        let FileHead {
            car,
            run_id,
            map,
            info,
        } = self.head.clone();
        let entries = [
            ("car", car.to_string()),
            ("run_id", run_id.to_string()),
            ("version", info.version.clone()),
            ("map", info.map.clone()),
            ("source", info.source.clone()),
            ("host", info.host.clone()),
        ];
        self.writer.write_metadata(&Metadata {
            name: "car-node.run".to_owned(),
            metadata: entries
                .map(|(key, value)| (key.to_owned(), value))
                .into_iter()
                .collect(),
        })?;
        let note = format!("pitwall/{car}/note");
        for (sequence, content) in [
            (1, json!({"note": "appeared"})),
            (2, json!({"note": "info", "info": info})),
        ] {
            let channel = self.channel(&note, "json", None)?;
            self.write_to(channel, sequence, now.0, content.to_string().as_bytes())?;
        }
        let mount = info.base_link_from_laser;
        let map_key = Key::new(car, Topic::Map).to_string();
        let channel = self.channel(&map_key, Key::RECORDED_ENCODING, None)?;
        self.write_to(channel, 0, now.0, &map)?;
        self.write_ros(now.0, &RosMessage::Mount(now, mount))
    }

    pub(super) fn write(&mut self, entry: &Entry) -> Result<(), McapError> {
        match entry {
            Entry::Message {
                topic,
                sequence,
                published,
                bytes,
            } => {
                let key = Key::new(self.head.car.clone(), *topic).to_string();
                let channel = self.channel(&key, Key::RECORDED_ENCODING, None)?;
                self.write_to(channel, *sequence as u32, *published, bytes)
            }
            Entry::Ros { at, message } => self.write_ros(*at, message),
        }
    }

    fn write_ros(&mut self, at: i64, message: &RosMessage) -> Result<(), McapError> {
        let (topic, schema) = message.channel();
        let channel = self.channel(topic, "cdr", Some(schema))?;
        self.write_to(channel, 0, at, &message.to_cdr())
    }

    fn channel(
        &mut self,
        topic: &str,
        encoding: &str,
        schema: Option<&'static str>,
    ) -> Result<u16, McapError> {
        if let Some(&channel) = self.channels.get(topic) {
            return Ok(channel);
        }
        let schema = match schema {
            None => 0,
            Some(name) => {
                if let Some(&schema) = self.schemas.get(name) {
                    schema
                } else {
                    let schema = self
                        .writer
                        .add_schema(name, "ros2msg", ros::definition(name).as_bytes())?;
                    self.schemas.insert(name, schema);
                    schema
                }
            }
        };
        let channel = self
            .writer
            .add_channel(schema, topic, encoding, &BTreeMap::new())?;
        self.channels.insert(topic.to_owned(), channel);
        Ok(channel)
    }

    fn write_to(&mut self, channel_id: u16, sequence: u32, at: i64, data: &[u8]) -> Result<(), McapError> {
        let time = at.max(0) as u64;
        let header = MessageHeader {
            channel_id,
            sequence,
            log_time: time,
            publish_time: time,
        };
        self.writer.write_to_known_channel(&header, data)
    }

    /// Writes all of it to the disk. Returns the length of the file, all of which is safe.
    pub(super) fn sync(&mut self) -> Result<u64, McapError> {
        self.writer.flush()?;
        self.sync.sync_data()?;
        Ok(self.sync.metadata()?.len())
    }

    /// Completes the file, and writes all of it to the disk. Returns its length.
    pub(super) fn finish(mut self) -> Result<u64, McapError> {
        self.writer.finish()?;
        drop(self.writer);
        self.sync.sync_all()?;
        Ok(self.sync.metadata()?.len())
    }
}

/// The error with the file's name.
pub(super) fn describe(path: &Path, error: &McapError) -> String {
    format!("{}: {error}", path.display())
}
