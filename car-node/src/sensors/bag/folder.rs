//! The files of a bag: one file, or a folder with `metadata.yaml`, as rosbag2 leaves it.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::BagError;
use super::reader::Encoding;

/// What a bag consists of.
#[derive(Debug, Default, PartialEq)]
pub(super) struct Contents {
    /// In the order in which they were recorded.
    pub(super) files: Vec<PathBuf>,
    /// Topics with their types that the metadata lists, with messages or without.
    pub(super) topics: Vec<(String, String, Encoding)>,
    /// What the user should know.
    pub(super) note: Option<String>,
}

const METADATA: &str = "metadata.yaml";
const EXTENSIONS: [&str; 3] = ["mcap", "db3", "bag"];

#[derive(Deserialize)]
struct Metadata {
    rosbag2_bagfile_information: Information,
}

#[derive(Deserialize)]
struct Information {
    relative_file_paths: Vec<String>,
    #[serde(default)]
    topics_with_message_count: Vec<Topic>,
}

#[derive(Deserialize)]
struct Topic {
    topic_metadata: TopicMetadata,
}

#[derive(Deserialize)]
struct TopicMetadata {
    name: String,
    r#type: String,
    serialization_format: String,
}

/// Finds the files of a bag.
pub(super) fn files(path: &Path) -> Result<Contents, BagError> {
    let folder = if path.is_dir() {
        path
    } else if path.file_name().is_some_and(|name| name == METADATA) {
        path.parent().unwrap_or(Path::new(""))
    } else {
        return Ok(Contents {
            files: vec![path.into()],
            ..Contents::default()
        });
    };
    let metadata = folder.join(METADATA);
    if !metadata.exists() {
        return by_name(folder, None);
    }
    match read_metadata(&metadata) {
        Ok(information) => listed(folder, information),
        // A recorder that was killed leaves an empty one.
        Err(fault) => by_name(
            folder,
            Some(format!("{METADATA}: {fault}; the files are taken by their names")),
        ),
    }
}

fn read_metadata(path: &Path) -> Result<Information, String> {
    let text = maps::read_text(path).map_err(|error| error.to_string())?;
    let metadata: Metadata = serde_saphyr::from_str(&text).map_err(|error| error.to_string())?;
    Ok(metadata.rosbag2_bagfile_information)
}

/// The files that the metadata lists.
fn listed(folder: &Path, information: Information) -> Result<Contents, BagError> {
    let fault = |fault: String| BagError::Folder {
        path: folder.join(METADATA),
        fault,
    };
    if information.relative_file_paths.is_empty() {
        return Err(fault("relative_file_paths is empty: there is no file".into()));
    }
    let find = |name: &String| {
        let name = Path::new(name);
        // Old versions wrote the folder's name in front. A folder may have been renamed since.
        let places = [
            Some(folder.join(name)),
            folder.parent().map(|parent| parent.join(name)),
            name.file_name().map(|name| folder.join(name)),
        ];
        let found = places.into_iter().flatten().find(|place| place.is_file());
        found.ok_or_else(|| fault(format!("{} is not there", folder.join(name).display())))
    };
    let files = information.relative_file_paths.iter().map(find);
    Ok(Contents {
        files: files.collect::<Result<_, _>>()?,
        topics: information
            .topics_with_message_count
            .into_iter()
            .filter_map(|topic| {
                let TopicMetadata {
                    name,
                    r#type,
                    serialization_format,
                } = topic.topic_metadata;
                Some((name, r#type, Encoding::named(&serialization_format)?))
            })
            .collect(),
        note: None,
    })
}

/// The bag in a folder without metadata: one file, or the parts of one bag, which differ in their number.
fn by_name(folder: &Path, note: Option<String>) -> Result<Contents, BagError> {
    let fault = |fault: String| BagError::Folder {
        path: folder.into(),
        fault,
    };
    let entries = fs::read_dir(folder).map_err(|source| BagError::Open {
        path: folder.into(),
        source,
    })?;
    let mut files: Vec<(String, u64, PathBuf)> = entries
        .filter_map(|entry| {
            let path = entry.ok()?.path();
            let (stem, number) = split_name(&path)?;
            path.is_file().then_some((stem, number, path))
        })
        .collect();
    files.sort();
    let stems: BTreeSet<&String> = files.iter().map(|(stem, ..)| stem).collect();
    match stems.len() {
        0 => Err(fault(format!(
            "there is no {METADATA} and no .mcap, .db3 or .bag file in this folder"
        ))),
        1 => Ok(Contents {
            files: files.into_iter().map(|(.., path)| path).collect(),
            topics: Vec::new(),
            note,
        }),
        _ => {
            let names: Vec<_> = files
                .iter()
                .filter_map(|(.., path)| Some(path.file_name()?.to_string_lossy()))
                .collect();
            Err(fault(format!(
                "several bags and no {METADATA} in this folder: give one of {}",
                names.join(", ")
            )))
        }
    }
}

/// `drive_12.mcap.zstd` is part 12 of `drive.mcap`. None for a file that is no bag by its name.
fn split_name(path: &Path) -> Option<(String, u64)> {
    let name = path.file_name()?.to_str()?;
    let (stem, extension) = name.strip_suffix(".zstd").unwrap_or(name).rsplit_once('.')?;
    if !EXTENSIONS.contains(&extension) {
        return None;
    }
    Some(
        match stem.rsplit_once('_').map(|(stem, number)| (stem, number.parse())) {
            Some((stem, Ok(number))) => (format!("{stem}.{extension}"), number),
            _ => (format!("{stem}.{extension}"), 0),
        },
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder(files: &[(&str, &str)]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().expect("a folder");
        for (name, content) in files {
            fs::write(folder.path().join(name), content).expect("written");
        }
        folder
    }

    fn names(path: &Path) -> Vec<String> {
        let name = |path: &PathBuf| path.file_name().expect("a file").to_string_lossy().into_owned();
        files(path).expect("a bag").files.iter().map(name).collect()
    }

    #[test]
    fn the_metadata_gives_the_order_and_topics_without_messages() {
        let text = "rosbag2_bagfile_information:\n  version: 5\n  relative_file_paths:\n    - old/b.db3\n    - a.db3\n  \
                    topics_with_message_count:\n    - topic_metadata:\n        name: /odom\n        \
                    type: nav_msgs/msg/Odometry\n        serialization_format: cdr\n        \
                    offered_qos_profiles: \"\"\n      message_count: 0\n";
        let folder = folder(&[(METADATA, text), ("a.db3", ""), ("b.db3", "")]);
        assert_eq!(names(folder.path()), ["b.db3", "a.db3"]);
        assert_eq!(names(&folder.path().join(METADATA)), ["b.db3", "a.db3"]);
        let topic = (
            "/odom".to_owned(),
            "nav_msgs/msg/Odometry".to_owned(),
            Encoding::Cdr,
        );
        assert_eq!(files(folder.path()).expect("a bag").topics, [topic]);
        fs::remove_file(folder.path().join("a.db3")).expect("removed");
        let text = files(folder.path()).expect_err("a file is gone").to_string();
        assert!(
            text.contains("a.db3 is not there") && text.contains(METADATA),
            "{text}"
        );
    }

    #[test]
    fn without_metadata_the_parts_of_one_bag_are_taken_in_the_order_of_their_numbers() {
        let parts = [
            ("d_10.mcap", ""),
            ("d_9.mcap", ""),
            ("d_0.mcap.zstd", ""),
            ("notes.txt", ""),
        ];
        assert_eq!(
            names(folder(&parts).path()),
            ["d_0.mcap.zstd", "d_9.mcap", "d_10.mcap"]
        );
        let killed = folder(&[(METADATA, ""), ("d_0.db3", "")]);
        assert_eq!(names(killed.path()), ["d_0.db3"]);
        assert!(
            files(killed.path())
                .expect("a bag")
                .note
                .is_some_and(|note| note.contains(METADATA))
        );
        let two = files(folder(&[("hq.mcap", ""), ("lq.mcap", "")]).path());
        let text = two.expect_err("which one?").to_string();
        assert!(text.contains("hq.mcap, lq.mcap"), "{text}");
        let none = files(folder(&[]).path()).expect_err("none").to_string();
        assert!(none.contains(".db3"), "{none}");
    }
}
