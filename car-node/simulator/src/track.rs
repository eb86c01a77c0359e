//! A track: the true walls, and the map and raceline that the car is given.

use std::fs;
use std::io::ErrorKind;
use std::path::Path;

use maps::{MapError, OccupancyGrid, Raceline, read_text};

use crate::{SpeedParams, Walls, slowed_to};

/// Limits of the simulated car on a line that was made for another car and whose bends may begin abruptly. They are a
/// little lower than on its own lines. Even so, it spins on taped tyres, also on its true pose.
const FOREIGN: SpeedParams = SpeedParams {
    lateral: 4.4,
    drive: 3.7,
    brake: 3.5,
    top: 7.6,
};

/// The tracks that ship, by name.
pub const BUNDLED: [&str; 4] = ["club", "hall", "park", "mirror"];

/// A track to race on.
#[derive(Debug, Clone)]
pub struct Track {
    /// Its name.
    pub name: String,
    /// The map that the localizer gets.
    pub grid: OccupancyGrid,
    /// The line that the driver follows.
    pub raceline: Raceline,
    /// The true walls.
    pub walls: Walls,
}

impl Track {
    /// Reads `map.yaml`, `raceline.csv` and `walls.csv` from a folder, or a map file and the files beside it. `raceline`
    /// names another file for the line, in any format that [`Raceline::parse`] reads.
    ///
    /// Without `walls.csv`, as for the map of a real track, the walls are taken from the map. The raceline, which was made
    /// for another car, is then slowed to the limits of the simulated one.
    pub fn load(path: impl AsRef<Path>, raceline: Option<&Path>) -> Result<Self, MapError> {
        let path = path.as_ref();
        let (folder, map) = if path.is_dir() {
            (path, path.join("map.yaml"))
        } else {
            (path.parent().unwrap_or(Path::new("")), path.to_owned())
        };
        let grid = OccupancyGrid::load(map)?;
        let beside = folder.join("raceline.csv");
        let mut line = Raceline::load(raceline.unwrap_or(&beside))?;
        let walls = folder.join("walls.csv");
        let walls = if walls.exists() {
            Walls::parse(&walls.display().to_string(), &read_text(&walls)?)?
        } else {
            line = slowed_to(&line, &FOREIGN);
            Walls::from_grid(&grid)
        };
        let name = folder
            .file_name()
            .map_or("track".into(), |name| name.to_string_lossy());
        Ok(Self {
            name: name.into_owned(),
            grid,
            raceline: line,
            walls,
        })
    }

    /// Writes the track's files and its description `track.yaml` into a folder, which is made if needed. It writes all files
    /// or none: older files are replaced only when every new one is on the disk.
    pub fn save(&self, folder: impl AsRef<Path>, description: &str) -> Result<(), MapError> {
        let folder = folder.as_ref();
        let (yaml, png) = (self.grid.to_yaml("map.png"), self.grid.to_png());
        let (line, walls) = (self.raceline.to_csv(), self.walls.to_csv());
        let files = [
            ("track.yaml", description.as_bytes()),
            ("map.png", &png),
            ("raceline.csv", line.as_bytes()),
            ("walls.csv", walls.as_bytes()),
            // Last, because a folder with this file counts as a track.
            ("map.yaml", yaml.as_bytes()),
        ];
        let fault = |path: &Path, source| MapError::Read {
            file: path.display().to_string(),
            source,
        };
        let new = !folder.exists();
        fs::create_dir_all(folder).map_err(|source| fault(folder, source))?;
        let part = |name: &str| folder.join(format!(".{name}.part"));
        let written = files.iter().try_for_each(|(name, bytes)| {
            let path = folder.join(name);
            if path.is_dir() {
                return Err(fault(&path, ErrorKind::IsADirectory.into()));
            }
            fs::write(part(name), bytes).map_err(|source| fault(&path, source))
        });
        if written.is_err() {
            // A file that cannot be removed was not written.
            for (name, _) in &files {
                fs::remove_file(part(name)).ok();
            }
            if new {
                fs::remove_dir(folder).ok();
            }
            return written;
        }
        files.iter().try_for_each(|(name, _)| {
            let path = folder.join(name);
            fs::rename(part(name), &path).map_err(|source| fault(&path, source))
        })
    }

    /// A track that ships, by name (one of [`BUNDLED`]). It is part of the program; no file is read.
    pub fn bundled(name: &str) -> Option<Self> {
        macro_rules! files {
            ($name:literal) => {
                [
                    include_bytes!(concat!("../../../maps/tracks/", $name, "/map.yaml")).as_slice(),
                    include_bytes!(concat!("../../../maps/tracks/", $name, "/map.png")),
                    include_bytes!(concat!("../../../maps/tracks/", $name, "/raceline.csv")),
                    include_bytes!(concat!("../../../maps/tracks/", $name, "/walls.csv")),
                ]
            };
        }
        let [yaml, png, line, walls] = match name {
            "club" => files!("club"),
            "hall" => files!("hall"),
            "park" => files!("park"),
            "mirror" => files!("mirror"),
            _ => return None,
        };
        let text = |bytes| str::from_utf8(bytes).expect("bundled files are text");
        Some(Self {
            name: name.to_owned(),
            grid: OccupancyGrid::from_parts(text(yaml), png).expect("bundled maps are valid"),
            raceline: Raceline::parse(name, text(line)).expect("bundled racelines are valid"),
            walls: Walls::parse(name, text(walls)).expect("bundled walls are valid"),
        })
    }

    /// A bundled track by name, or else the one at that path ([`Track::load`]).
    pub fn find(name_or_path: &str, raceline: Option<&Path>) -> Result<Self, MapError> {
        let Some(mut track) = Self::bundled(name_or_path) else {
            return Self::load(name_or_path, raceline);
        };
        if let Some(path) = raceline {
            track.raceline = Raceline::load(path)?;
        }
        Ok(track)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_track_is_saved_whole_or_not_at_all() {
        let track = Track::bundled("club").expect("it ships");
        let place = std::env::temp_dir().join(format!("track-{}", std::process::id()));
        let names = |folder: &Path| -> Vec<String> {
            let entries = fs::read_dir(folder).expect("a folder");
            let mut names: Vec<_> = entries
                .map(|entry| {
                    entry
                        .expect("an entry")
                        .file_name()
                        .to_string_lossy()
                        .into_owned()
                })
                .collect();
            names.sort();
            names
        };
        // A folder where a file should go: nothing is written beside it, and the error names it.
        let blocked = place.join("blocked");
        fs::create_dir_all(blocked.join("walls.csv")).expect("a folder");
        let error = track.save(&blocked, "name: x").expect_err("a folder in the way");
        assert!(error.to_string().contains("walls.csv: "), "{error}");
        assert_eq!(names(&blocked), ["walls.csv"]);

        let free = place.join("free");
        track.save(&free, "name: x").expect("room on the disk");
        assert_eq!(
            names(&free),
            ["map.png", "map.yaml", "raceline.csv", "track.yaml", "walls.csv"]
        );
        let back = Track::load(&free, None).expect("what was written");
        assert_eq!(back.grid.cells, track.grid.cells);
        fs::remove_dir_all(&place).expect("our own folder");
    }
}
