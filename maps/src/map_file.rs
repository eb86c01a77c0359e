//! Map files: the YAML of `map_server` beside an image.
//!
//! The rules are those of `nav2_map_server` (`map_io.cpp`). An image's brightness becomes an occupancy; two thresholds
//! make it free, occupied or unknown. Localization uses only these three states, so in `scale` and `raw` maps
//! everything between the thresholds is [`Cell::Unknown`].

use std::path::{Path, PathBuf};
use std::{env, fs};

use serde::{Deserialize, Serialize};
use serde_saphyr::options::DuplicateKeyPolicy;

use crate::image_file::{decode, encode_png};
use crate::pbstream::{PbStream, is_pbstream};
use crate::raster::Raster;
use crate::{Cell, MapError, OccupancyGrid, Pose, read_text};

/// Grey values that `map_saver` writes, which every reader's default thresholds tell apart.
const FREE: u8 = 254;
const OCCUPIED: u8 = 0;
const UNKNOWN: u8 = 205;

/// Thresholds of `map_saver`, for files that give none.
const OCCUPIED_THRESH: f64 = 0.65;
const FREE_THRESH: f64 = 0.196;

/// The YAML file of a map.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MapMetadata {
    /// The image's file, relative to the YAML file.
    pub image: String,
    /// Edge of a pixel \[m\].
    pub resolution: f64,
    /// Lower left corner of the image in `map`: x \[m\], y \[m\], yaw \[rad\].
    pub origin: [f64; 3],
    /// True when white means occupied.
    pub negate: bool,
    /// Pixels darker than this share of black are occupied, in \[0, 1\].
    pub occupied_thresh: f64,
    /// Pixels brighter than this share of black are free, in \[0, 1\].
    pub free_thresh: f64,
    /// How brightness becomes occupancy.
    pub mode: MapMode,
}

/// How `map_server` makes occupancy of brightness.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MapMode {
    /// Free, occupied or unknown; alpha counts as a colour.
    #[default]
    Trinary,
    /// Values between the thresholds are kept by `map_server` (unknown here); transparent is unknown.
    Scale,
    /// The pixel value (of 255) is the occupancy in percent; above 100 is unknown.
    Raw,
}

/// The file as people write it. Other keys are ignored, as `map_server` does.
#[derive(Deserialize)]
struct RawMetadata {
    image: Option<Scalar>,
    resolution: Option<Scalar>,
    origin: Option<Vec<Scalar>>,
    negate: Option<Scalar>,
    occupied_thresh: Option<Scalar>,
    free_thresh: Option<Scalar>,
    mode: Option<Scalar>,
}

/// A value as text, quoted or not: `map_server` makes no difference.
#[derive(Debug, Clone, Deserialize)]
struct Scalar(String);

impl Scalar {
    fn number(&self) -> Option<f64> {
        self.0.trim().parse().ok()
    }

    /// YAML's words for true and false, and 0 and 1.
    fn flag(&self) -> Option<bool> {
        match self.0.trim().to_ascii_lowercase().as_str() {
            "0" | "false" | "no" | "off" | "n" => Some(false),
            "1" | "true" | "yes" | "on" | "y" => Some(true),
            _ => None,
        }
    }
}

impl RawMetadata {
    fn parse(file: &str, yaml: &str, duplicate_keys: DuplicateKeyPolicy) -> Result<Self, MapError> {
        let options = serde_saphyr::options! { duplicate_keys: duplicate_keys };
        serde_saphyr::from_str_with_options(yaml, options)
            .map_err(|e| MapError::format(file, e.without_snippet().to_string()))
    }
}

impl MapMetadata {
    /// Reads the YAML; `file` names it in errors. Of a key that is given twice, the first value counts, as in
    /// `map_server`.
    pub fn parse(file: &str, yaml: &str) -> Result<Self, MapError> {
        let raw = RawMetadata::parse(file, yaml, DuplicateKeyPolicy::FirstWins)?;
        let missing = |key| MapError::key(file, key, "missing");
        let number = |key, value: &Scalar| {
            value
                .number()
                .ok_or_else(|| MapError::key(file, key, format!("{:?} is not a number", value.0)))
        };
        let origin = raw.origin.ok_or_else(|| missing("origin"))?;
        let origin: Vec<f64> = origin
            .iter()
            .map(|value| number("origin", value))
            .collect::<Result<_, _>>()?;
        let origin = <[f64; 3]>::try_from(origin.as_slice())
            .ok()
            .filter(|origin| origin.iter().all(|v| v.is_finite()))
            .ok_or_else(|| {
                let fault = format!("{origin:?} should be three finite numbers: x [m], y [m], yaw [rad]");
                MapError::key(file, "origin", fault)
            })?;
        let resolution = number(
            "resolution",
            &raw.resolution.ok_or_else(|| missing("resolution"))?,
        )?;
        // Not `<= 0.0`: NaN must fail too.
        if !(resolution.is_finite() && resolution > 0.0) {
            let fault = format!("{resolution} should be a positive length in metres");
            return Err(MapError::key(file, "resolution", fault));
        }
        let share = |key, value: Option<Scalar>, default| {
            let value = value.map_or(Ok(default), |value| number(key, &value))?;
            if (0.0..=1.0).contains(&value) {
                Ok(value)
            } else {
                Err(MapError::key(file, key, format!("{value} should lie in [0, 1]")))
            }
        };
        let occupied_thresh = share("occupied_thresh", raw.occupied_thresh, OCCUPIED_THRESH)?;
        let free_thresh = share("free_thresh", raw.free_thresh, FREE_THRESH)?;
        if free_thresh > occupied_thresh {
            let fault = format!("{free_thresh} is above occupied_thresh {occupied_thresh}");
            return Err(MapError::key(file, "free_thresh", fault));
        }
        let negate = raw.negate.map_or(Ok(false), |value| {
            value
                .flag()
                .ok_or_else(|| MapError::key(file, "negate", format!("{} should be 0 or 1", value.0)))
        })?;
        let mode = raw.mode.map_or(Ok(MapMode::Trinary), |value| {
            match value.0.trim().to_ascii_lowercase().as_str() {
                "trinary" => Ok(MapMode::Trinary),
                "scale" => Ok(MapMode::Scale),
                "raw" => Ok(MapMode::Raw),
                _ => {
                    let fault = format!("{:?} should be trinary, scale or raw", value.0);
                    Err(MapError::key(file, "mode", fault))
                }
            }
        })?;
        Ok(Self {
            image: raw.image.ok_or_else(|| missing("image"))?.0,
            resolution,
            origin,
            negate,
            occupied_thresh,
            free_thresh,
            mode,
        })
    }

    /// Share of a pixel that is wall, in \[0, 1\]; None where the image says that nobody knows.
    fn occupancy(&self, image: &Raster, index: usize) -> Option<f64> {
        match self.mode {
            MapMode::Raw => {
                let percent = (image.brightness(index) * 255.0).round();
                (percent <= 100.0).then_some(percent / 100.0)
            }
            MapMode::Scale if !image.opaque(index) => None,
            MapMode::Scale => Some(self.darkness(image.brightness(index))),
            MapMode::Trinary => Some(self.darkness(image.brightness_with_alpha(index))),
        }
    }

    fn cell(&self, occupancy: Option<f64>) -> Cell {
        match occupancy {
            Some(occupancy) if occupancy > self.occupied_thresh => Cell::Occupied,
            Some(occupancy) if occupancy < self.free_thresh => Cell::Free,
            _ => Cell::Unknown,
        }
    }

    fn darkness(&self, brightness: f64) -> f64 {
        if self.negate { brightness } else { 1.0 - brightness }
    }
}

impl OccupancyGrid {
    /// Reads a map: `path` is the YAML file, which names the image, or a state of Cartographer (`.pbstream`).
    pub fn load(path: impl AsRef<Path>) -> Result<Self, MapError> {
        let path = path.as_ref();
        if is_pbstream(path) {
            return PbStream::load(path)?.paint();
        }
        let file = path.display().to_string();
        let yaml = read_text(path)?;
        let metadata = MapMetadata::parse(&file, &yaml)?;
        let image = find_image(path, &yaml, &metadata)?;
        let bytes = fs::read(&image).map_err(|e| {
            let fault = format!("{}: {e}", image.display());
            MapError::key(&file, "image", fault)
        })?;
        Self::decode(&metadata, &image.display().to_string(), &bytes)
    }

    /// A map that did not come from files: the text of its YAML and the bytes of its image.
    pub fn from_parts(yaml: &str, image: &[u8]) -> Result<Self, MapError> {
        let metadata = MapMetadata::parse("map.yaml", yaml)?;
        Self::decode(&metadata, &metadata.image, image)
    }

    fn decode(metadata: &MapMetadata, file: &str, image: &[u8]) -> Result<Self, MapError> {
        let image = decode(file, image)?;
        let (width, height) = (image.width, image.height);
        // The image's first row is the map's last.
        let (cells, occupancy) = (0..height)
            .rev()
            .flat_map(|row| (0..width).map(move |column| row * width + column))
            .map(|index| {
                let occupancy = metadata.occupancy(&image, index);
                (metadata.cell(occupancy), grey(occupancy.unwrap_or(0.5)))
            })
            .unzip();
        let [x, y, yaw] = metadata.origin;
        Ok(Self {
            width,
            height,
            resolution: metadata.resolution,
            origin: Pose::new(x, y, yaw),
            cells,
            occupancy,
        })
    }

    /// The YAML that goes with [`OccupancyGrid::to_png`], naming the image `image`.
    pub fn to_yaml(&self, image: &str) -> String {
        // `{:?}` writes a float so that it reads back as itself, and quotes the name where it must.
        format!(
            "image: {image:?}\nresolution: {:?}\norigin: [{:?}, {:?}, {:?}]\nnegate: 0\noccupied_thresh: 0.65\n\
             free_thresh: 0.196\nmode: trinary\n",
            self.resolution, self.origin.x, self.origin.y, self.origin.heading
        )
    }

    /// The map as an 8-bit grey PNG: 255 less the occupancy, or, where that would read back as another state,
    /// the grey value of `map_saver`.
    pub fn to_png(&self) -> Vec<u8> {
        let pixel = |(&cell, &occupancy): (&Cell, &u8)| {
            let share = f64::from(occupancy) / 255.0;
            let (free, occupied) = (share < FREE_THRESH, share > OCCUPIED_THRESH);
            match cell {
                Cell::Free if !free => FREE,
                Cell::Occupied if !occupied => OCCUPIED,
                Cell::Unknown if free || occupied => UNKNOWN,
                _ => 255 - occupancy,
            }
        };
        let rows = self
            .cells
            .chunks_exact(self.width)
            .zip(self.occupancy.chunks_exact(self.width));
        let grey: Vec<u8> = rows
            .rev()
            .flat_map(|(cells, occupancy)| cells.iter().zip(occupancy).map(pixel))
            .collect();
        encode_png(self.width, self.height, &grey)
    }
}

/// The image's path. A relative one begins at the YAML file's folder, `~/` at the home folder.
fn find_image(yaml_file: &Path, yaml: &str, metadata: &MapMetadata) -> Result<PathBuf, MapError> {
    let file = yaml_file.display().to_string();
    let folder = yaml_file.parent().unwrap_or(Path::new(""));
    let first = resolve(
        &file,
        folder,
        &metadata.image,
        env::var_os("HOME").map(PathBuf::from),
    )?;
    if first.exists() {
        return Ok(first);
    }
    // Other readers take the last of several images. Where the first does not exist, the last was meant.
    let last = RawMetadata::parse(&file, yaml, DuplicateKeyPolicy::LastWins)?.image;
    let last = last.map(|image| resolve(&file, folder, &image.0, None));
    Ok(match last {
        Some(Ok(last)) if last.exists() => last,
        _ => first,
    })
}

/// An image's path, with a leading `~/` replaced by the home folder.
fn resolve(file: &str, folder: &Path, image: &str, home: Option<PathBuf>) -> Result<PathBuf, MapError> {
    match image.strip_prefix("~/") {
        Some(rest) => home.map(|home| home.join(rest)).ok_or_else(|| {
            let fault = format!("{image}: the home folder is not known: HOME is not set");
            MapError::key(file, "image", fault)
        }),
        None => Ok(folder.join(image)),
    }
}

/// An occupancy in \[0, 1\] as a grey value, 255 all wall.
fn grey(occupancy: f64) -> u8 {
    (occupancy * 255.0).round() as u8
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const YAML: &str = "image: map.pgm\nresolution: 0.05\norigin: [1.0, 2.0, 3.1]\nnegate: 0\n\
                        occupied_thresh: 0.65\nfree_thresh: 0.196\n";

    fn cells(yaml: &str, image: &[u8]) -> Vec<Cell> {
        OccupancyGrid::from_parts(yaml, image).expect("a valid map").cells
    }

    #[test]
    fn the_image_s_last_row_is_row_zero() {
        let grid = OccupancyGrid::from_parts(YAML, b"P2 2 2 255 0 205 254 255").expect("a valid map");
        assert_eq!(
            grid.cells,
            [Cell::Free, Cell::Free, Cell::Occupied, Cell::Unknown]
        );
        assert_eq!(grid.origin, Pose::new(1.0, 2.0, 3.1));
        // Turned by nearly pi, the grid lies to the lower left of its origin.
        assert_eq!(grid.at([0.975, 1.925]), Cell::Occupied);
    }

    #[test]
    fn negate_swaps_black_and_white() {
        let yaml = YAML.replace("negate: 0", "negate: 1");
        assert_eq!(cells(&yaml, b"P2 2 1 255 255 0"), [Cell::Occupied, Cell::Free]);
        let yaml = YAML.replace("negate: 0", "negate: true");
        assert_eq!(cells(&yaml, b"P2 1 1 255 255"), [Cell::Occupied]);
    }

    #[test]
    fn values_may_be_quoted_and_modes_capital() {
        for (from, to) in [
            ("negate: 0", "negate: \"0\""),
            ("negate: 0", "negate: 'no'"),
            ("negate: 0", "negate: False"),
            ("negate: 0", "negate: 0\nmode: Trinary"),
            ("0.05", "\"0.05\""),
            ("[1.0, 2.0, 3.1]", "['1', \"2.0\", 3.1]"),
            ("0.65", "'0.65'"),
        ] {
            let yaml = YAML.replace(from, to);
            let grid = OccupancyGrid::from_parts(&yaml, b"P2 2 1 255 0 255").expect("a valid map");
            assert_eq!(grid.cells, [Cell::Occupied, Cell::Free], "{to}");
            assert!((grid.resolution - 0.05).abs() < 1e-12 && (grid.origin.x - 1.0).abs() < 1e-12);
        }
    }

    #[test]
    fn of_a_key_given_twice_the_first_counts() {
        let metadata = MapMetadata::parse("map.yaml", &format!("{YAML}resolution: 0.1\nn_obs: 4\n"));
        assert!((metadata.expect("a valid map").resolution - 0.05).abs() < 1e-12);
    }

    #[test]
    fn of_two_images_the_one_that_exists_is_read() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let yaml = folder.path().join("map.yaml");
        fs::write(&yaml, format!("image: old.pgm\n{YAML}")).expect("writable");
        fs::write(folder.path().join("map.pgm"), b"P2 1 1 255 0").expect("writable");
        let grid = OccupancyGrid::load(&yaml).expect("the second image is there");
        assert_eq!(grid.cells, [Cell::Occupied]);
        fs::write(folder.path().join("old.pgm"), b"P2 1 1 255 255").expect("writable");
        let grid = OccupancyGrid::load(&yaml).expect("both images are there");
        assert_eq!(grid.cells, [Cell::Free]);
    }

    #[test]
    fn a_tilde_is_the_home_folder() {
        let resolve = |image, home: Option<&str>| {
            resolve("map.yaml", Path::new("/maps"), image, home.map(PathBuf::from))
        };
        let paths = [
            ("~/hall/map.png", "/home/ann/hall/map.png"),
            ("hall/map.png", "/maps/hall/map.png"),
            ("/srv/map.png", "/srv/map.png"),
        ];
        for (image, path) in paths {
            assert_eq!(
                resolve(image, Some("/home/ann")).expect("a path"),
                Path::new(path)
            );
        }
        let error = resolve("~/map.png", None).expect_err("no home");
        assert!(
            error.to_string().starts_with("map.yaml: image: ~/map.png: "),
            "{error}"
        );
    }

    #[test]
    fn raw_values_are_percent() {
        let yaml = format!("{YAML}mode: raw\n");
        assert_eq!(
            cells(&yaml, b"P2 5 1 255 0 19 50 66 101"),
            [
                Cell::Free,
                Cell::Free,
                Cell::Unknown,
                Cell::Occupied,
                Cell::Unknown
            ]
        );
    }

    #[test]
    fn scale_keeps_what_is_clear() {
        let yaml = format!("{YAML}mode: scale\n");
        assert_eq!(
            cells(&yaml, b"P2 3 1 255 0 127 255"),
            [Cell::Occupied, Cell::Unknown, Cell::Free]
        );
    }

    #[test]
    fn thresholds_are_strict_as_in_map_server() {
        // 1 - 0.5 is exactly 0.5: neither above nor below.
        let yaml = YAML.replace("0.65", "0.5").replace("0.196", "0.5");
        assert_eq!(
            cells(&yaml, b"P2 3 1 10 4 5 6"),
            [Cell::Occupied, Cell::Unknown, Cell::Free]
        );
    }

    #[test]
    fn faults_name_file_and_key() {
        for (from, to, expected) in [
            ("resolution: 0.05", "", "map.yaml: resolution: missing"),
            ("resolution: 0.05", "resolution: -1", "map.yaml: resolution: -1"),
            (
                "resolution: 0.05",
                "resolution: .nan",
                "map.yaml: resolution: \".nan\" is not a number",
            ),
            (
                "resolution: 0.05",
                "resolution: five",
                "map.yaml: resolution: \"five\" is not a number",
            ),
            ("image: map.pgm", "", "map.yaml: image: missing"),
            ("[1.0, 2.0, 3.1]", "[1.0, 2.0]", "map.yaml: origin: "),
            ("[1.0, 2.0, 3.1]", "[1.0, .inf, 0]", "map.yaml: origin: "),
            ("negate: 0", "negate: 2", "map.yaml: negate: 2"),
            ("0.65", "1.65", "map.yaml: occupied_thresh: 1.65"),
            ("0.196", "0.7", "map.yaml: free_thresh: 0.7"),
            ("negate: 0", "mode: grey", "map.yaml: mode: \"grey\""),
        ] {
            let error = OccupancyGrid::from_parts(&YAML.replace(from, to), b"P2 1 1 255 0")
                .expect_err("a fault in the YAML");
            assert!(
                error.to_string().starts_with(expected),
                "{error} should start with {expected}"
            );
        }
        let error = OccupancyGrid::from_parts(YAML, b"").expect_err("no image");
        assert!(error.to_string().starts_with("map.pgm: "), "{error}");
        let error = OccupancyGrid::from_parts("- a list", b"").expect_err("not a map");
        assert!(error.to_string().starts_with("map.yaml: "), "{error}");
    }

    #[test]
    fn files_beside_each_other() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let yaml = folder.path().join("track.yaml");
        fs::write(&yaml, YAML).expect("writable");
        let error = OccupancyGrid::load(&yaml).expect_err("no image yet");
        assert!(error.to_string().contains("track.yaml: image: "), "{error}");
        fs::write(folder.path().join("map.pgm"), b"P5 2 1 255\n\x00\xfe").expect("writable");
        let grid = OccupancyGrid::load(&yaml).expect("a valid map");
        assert_eq!(grid.cells, [Cell::Occupied, Cell::Free]);
        let error = OccupancyGrid::load(folder.path().join("absent.yaml")).expect_err("no file");
        assert!(error.to_string().contains("absent.yaml"), "{error}");
    }

    fn any_grid() -> impl Strategy<Value = OccupancyGrid> {
        let cell = prop_oneof![Just(Cell::Free), Just(Cell::Occupied), Just(Cell::Unknown)];
        (
            1_usize..12,
            1_usize..12,
            0.001..1.0,
            (-9.0..9.0, -9.0..9.0, -3.0..3.0),
        )
            .prop_flat_map(move |(width, height, resolution, (x, y, yaw))| {
                proptest::collection::vec(cell.clone(), width * height).prop_map(move |cells| {
                    OccupancyGrid::new(width, height, resolution, Pose::new(x, y, yaw), cells)
                })
            })
    }

    proptest! {
        #[test]
        fn what_is_saved_reads_back(grid in any_grid()) {
            let back = OccupancyGrid::from_parts(&grid.to_yaml("a map.png"), &grid.to_png());
            prop_assert_eq!(back.expect("just written"), grid);
        }
    }
}
