//! What a recording says about its session, for people and for other tools: metadata and attachments.
//!
//! | record | when | content |
//! |---|---|---|
//! | metadata `pitwall.session` | first | version, host, operator, start |
//! | metadata `pitwall.set` | a set comes in force | car, name, revision, who, values |
//! | metadata `pitwall.cars` | last | of each car: version, source, map, host, clock offset, runs |
//! | metadata `pitwall.streams` | last | what was received of each stream, and what is missing |
//! | attachments `MAP.pgm`, `MAP.yaml`, `MAP-raceline.csv` | a car's map is known | the map as map_server reads it |

use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};

use mcap::Attachment;
use mcap::records::Metadata;
use protocol::{CarInfo, CarName, MapReply, Params};

/// Name of the metadata record about the session.
const SESSION: &str = "pitwall.session";
const SET: &str = "pitwall.set";
const CARS: &str = "pitwall.cars";

/// What is known about the cars of a session.
#[derive(Debug, Default)]
pub(super) struct Session {
    infos: BTreeMap<CarName, CarInfo>,
    /// The car's clock minus the laptop's, and the round-trip time \[ns\].
    clocks: BTreeMap<CarName, (i64, i64)>,
    runs: BTreeMap<CarName, BTreeSet<u64>>,
    /// The sets that the file has, by car, name and revision.
    sets: BTreeSet<(CarName, String, u64)>,
    /// The maps that the file has.
    maps: BTreeSet<String>,
}

impl Session {
    /// Beyond this many, sets and runs are left out.
    const MOST: usize = 10_000;

    /// Forgets which sets and maps the file has, because another file begins.
    pub(super) fn begin_file(&mut self) {
        self.sets.clear();
        self.maps.clear();
    }

    pub(super) fn on_info(&mut self, car: &CarName, info: &CarInfo) {
        self.infos.insert(car.clone(), info.clone());
    }

    pub(super) fn on_clock(&mut self, car: &CarName, offset: i64, round_trip: i64) {
        self.clocks.insert(car.clone(), (offset, round_trip));
    }

    pub(super) fn on_run(&mut self, car: &CarName, run_id: u64) {
        if self.runs.get(car).is_some_and(|runs| runs.contains(&run_id)) {
            return;
        }
        let runs = self.runs.entry(car.clone()).or_default();
        if runs.len() < Self::MOST {
            runs.insert(run_id);
        }
    }

    /// The metadata about a set; None if the file has it.
    pub(super) fn on_set(&mut self, car: &CarName, params: &Params) -> Option<Metadata> {
        let key = (car.clone(), params.set.name.clone(), params.revision);
        if self.sets.len() >= Self::MOST || !self.sets.insert(key) {
            return None;
        }
        let values = serde_json::to_string(&params.set.values).unwrap_or_default();
        Some(metadata(
            SET,
            [
                ("car", car.to_string()),
                ("name", params.set.name.clone()),
                ("revision", params.revision.to_string()),
                ("who", params.who.clone()),
                ("values", values),
            ],
        ))
    }

    /// The files of a map; none if the recording has them.
    pub(super) fn on_map(&mut self, map: &MapReply, at: i64) -> Vec<Attachment<'static>> {
        let name = file_name(&map.name);
        if self.maps.len() >= Self::MOST || !self.maps.insert(name.clone()) {
            return Vec::new();
        }
        let attachment = |file: String, media_type: &str, data: Vec<u8>| Attachment {
            log_time: at.max(0) as u64,
            create_time: at.max(0) as u64,
            name: file,
            media_type: media_type.to_owned(),
            data: Cow::Owned(data),
        };
        let mut files = vec![
            attachment(format!("{name}.pgm"), "image/x-portable-graymap", image(map)),
            attachment(
                format!("{name}.yaml"),
                "application/yaml",
                description(map, &name),
            ),
        ];
        if let Some(raceline) = &map.raceline {
            let mut text = "# x_m,y_m\n".to_owned();
            for [x, y] in &raceline.points {
                text.push_str(&[x.to_string(), y.to_string()].join(","));
                text.push('\n');
            }
            files.push(attachment(
                format!("{name}-raceline.csv"),
                "text/csv",
                text.into_bytes(),
            ));
        }
        files
    }

    /// The metadata about the session.
    pub(super) fn first(started: i64, operator: &str) -> Metadata {
        metadata(
            SESSION,
            [
                ("pitwall", env!("CARGO_PKG_VERSION").to_owned()),
                ("host", sysinfo::System::host_name().unwrap_or_default()),
                ("operator", operator.to_owned()),
                ("started", utc(started)),
            ],
        )
    }

    /// The metadata about the cars.
    pub(super) fn last(&self) -> Metadata {
        let mut cars: BTreeSet<_> = self.runs.keys().collect();
        cars.extend(self.infos.keys());
        let describe = |car: &CarName| {
            let clock = self.clocks.get(car);
            let json = serde_json::json!({
                "info": self.infos.get(car),
                "clock_offset_ns": clock.map(|(offset, _)| offset),
                "round_trip_ns": clock.map(|(_, round_trip)| round_trip),
                "runs": self.runs.get(car),
            });
            (car.to_string(), json.to_string())
        };
        Metadata {
            name: CARS.to_owned(),
            metadata: cars.into_iter().map(describe).collect(),
        }
    }
}

fn metadata<const N: usize>(name: &str, values: [(&str, String); N]) -> Metadata {
    Metadata {
        name: name.to_owned(),
        metadata: values
            .into_iter()
            .map(|(key, value)| (key.to_owned(), value))
            .collect(),
    }
}

/// The grid as an image, its upper row first: walls are black, what is unknown is grey.
fn image(map: &MapReply) -> Vec<u8> {
    let cells = map.occupancy();
    let mut image = format!("P5\n{} {}\n255\n", map.width, map.height).into_bytes();
    for row in cells.chunks(map.width.max(1) as usize).rev() {
        image.extend(row.iter().map(|cell| match cell {
            0 => 254,
            100 => 0,
            _ => 205,
        }));
    }
    image
}

fn description(map: &MapReply, name: &str) -> Vec<u8> {
    let MapReply {
        resolution, origin, ..
    } = map;
    format!(
        "image: {name}.pgm\nmode: trinary\nresolution: {resolution}\norigin: [{}, {}, {}]\nnegate: 0\n\
         occupied_thresh: 0.65\nfree_thresh: 0.196\n",
        origin.x, origin.y, origin.heading
    )
    .into_bytes()
}

/// A name that is safe as the name of a file: letters, digits, `-` and `_`.
fn file_name(name: &str) -> String {
    let safe = |c: char| {
        if c.is_ascii_alphanumeric() || c == '_' {
            c
        } else {
            '-'
        }
    };
    let name: String = name.chars().take(64).map(safe).collect();
    if name.is_empty() { "map".to_owned() } else { name }
}

/// The name of a recording that starts at `at` \[unix ns\]: `2026-11-28T19-30-55Z-club.mcap`. Names sort by time.
pub fn session_name(at: i64, track: Option<&str>) -> String {
    let time = utc(at).replace(':', "-");
    match track.filter(|track| !track.is_empty()) {
        Some(track) => format!("{time}-{}.mcap", file_name(track)),
        None => format!("{time}.mcap"),
    }
}

/// `2026-11-28T19:30:55Z`.
fn utc(unix_ns: i64) -> String {
    let seconds = unix_ns.div_euclid(1_000_000_000);
    let (days, second) = (seconds.div_euclid(86_400), seconds.rem_euclid(86_400));
    // Years that begin in March, so that the leap day is the last; eras of 400 years.
    let days = days + 719_468;
    let (era, day) = (days.div_euclid(146_097), days.rem_euclid(146_097));
    let year = (day - day / 1460 + day / 36_524 - day / 146_096) / 365;
    let day = day - (365 * year + year / 4 - year / 100);
    let month = (5 * day + 2) / 153;
    let (day, month) = (day - (153 * month + 2) / 5 + 1, (month + 2) % 12 + 1);
    let year = year + era * 400 + i64::from(month <= 2);
    let (hour, minute, second) = (second / 3600, second / 60 % 60, second % 60);
    format!("{year:04}-{month:02}-{day:02}T{hour:02}:{minute:02}:{second:02}Z")
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::{Cell, Pose2};

    #[test]
    fn dates_are_those_of_the_calendar() {
        for (seconds, date) in [
            (0, "1970-01-01T00:00:00Z"),
            (951_782_400, "2000-02-29T00:00:00Z"),
            (1_795_894_255, "2026-11-28T19:30:55Z"),
            (4_107_542_399, "2100-02-28T23:59:59Z"),
            (4_107_542_400, "2100-03-01T00:00:00Z"),
            (-1, "1969-12-31T23:59:59Z"),
        ] {
            assert_eq!(utc(seconds * 1_000_000_000), date);
        }
    }

    #[test]
    fn names_sort_by_time_and_are_safe() {
        let at = 1_795_894_255_000_000_000;
        assert_eq!(session_name(at, Some("club")), "2026-11-28T19-30-55Z-club.mcap");
        assert_eq!(
            session_name(at, Some("../a b")),
            "2026-11-28T19-30-55Z----a-b.mcap"
        );
        assert_eq!(session_name(at, None), "2026-11-28T19-30-55Z.mcap");
    }

    #[test]
    fn a_map_is_attached_once_as_map_server_reads_it() {
        let map = MapReply {
            name: "club".into(),
            width: 2,
            height: 2,
            resolution: 0.05,
            origin: Pose2::default(),
            runs: MapReply::pack([Cell::Occupied, Cell::Free, Cell::Unknown, Cell::Unknown]),
            raceline: None,
        };
        let mut session = Session::default();
        let files = session.on_map(&map, 5);
        let names: Vec<_> = files.iter().map(|file| file.name.as_str()).collect();
        assert_eq!(names, ["club.pgm", "club.yaml"]);
        assert_eq!(files[0].data[..], *b"P5\n2 2\n255\n\xcd\xcd\x00\xfe");
        let folder = tempfile::tempdir().expect("a folder");
        for file in &files {
            std::fs::write(folder.path().join(&file.name), &file.data).expect("written");
        }
        let grid = maps::OccupancyGrid::load(folder.path().join("club.yaml")).expect("a map");
        assert_eq!((grid.width, grid.height), (2, 2));
        assert!(session.on_map(&map, 6).is_empty());
        session.begin_file();
        assert_eq!(session.on_map(&map, 7).len(), 2);
    }
}
