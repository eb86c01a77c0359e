//! A track: what is true (walls) and what the car is given (map and raceline).

use std::fs;
use std::path::Path;

use maps::{MapError, OccupancyGrid, Raceline};

use crate::Walls;

/// A track to race on.
#[derive(Debug, Clone)]
pub struct Track {
    /// What to call it.
    pub name: String,
    /// The map that the localizer gets.
    pub grid: OccupancyGrid,
    /// The line that the driver follows.
    pub raceline: Raceline,
    /// The walls as they are.
    pub walls: Walls,
}

impl Track {
    /// Reads `map.yaml`, `raceline.csv` and `walls.csv` from a folder, or a map file and what lies beside it. Without
    /// `walls.csv`, as for the map of a real track, the walls are taken from the map.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, MapError> {
        let path = path.as_ref();
        let (folder, map) = if path.is_dir() {
            (path, path.join("map.yaml"))
        } else {
            (path.parent().unwrap_or(Path::new("")), path.to_owned())
        };
        let grid = OccupancyGrid::load(map)?;
        let raceline = Raceline::load(folder.join("raceline.csv"))?;
        let walls = folder.join("walls.csv");
        let walls = if walls.exists() {
            let file = walls.display().to_string();
            match fs::read_to_string(&walls) {
                Ok(csv) => Walls::parse(&file, &csv)?,
                Err(source) => return Err(MapError::Read { file, source }),
            }
        } else {
            Walls::from_grid(&grid)
        };
        let name = folder
            .file_name()
            .map_or("track".into(), |name| name.to_string_lossy());
        Ok(Self {
            name: name.into_owned(),
            grid,
            raceline,
            walls,
        })
    }

    /// Writes the four files into a folder, which is made if need be.
    pub fn save(&self, folder: impl AsRef<Path>) -> Result<(), MapError> {
        let folder = folder.as_ref();
        let write = |name: &str, bytes: &[u8]| {
            let path = folder.join(name);
            fs::write(&path, bytes).map_err(|source| MapError::Read {
                file: path.display().to_string(),
                source,
            })
        };
        fs::create_dir_all(folder).map_err(|source| MapError::Read {
            file: folder.display().to_string(),
            source,
        })?;
        write("map.yaml", self.grid.to_yaml("map.png").as_bytes())?;
        write("map.png", &self.grid.to_png())?;
        write("raceline.csv", self.raceline.to_csv().as_bytes())?;
        write("walls.csv", self.walls.to_csv().as_bytes())
    }

    /// A track that ships, by name (one of [`BUNDLED`](crate::BUNDLED)). It is part of the program: no file is read.
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

    /// A bundled track by name, or else the one at that path.
    pub fn find(name_or_path: &str) -> Result<Self, MapError> {
        match Self::bundled(name_or_path) {
            Some(track) => Ok(track),
            None => Self::load(name_or_path),
        }
    }
}
