//! Poses over time as CSV: the output of `evaluate --poses`, and ground truth from other tools.

use std::fs::File;
use std::path::Path;

use csv::{ReaderBuilder, StringRecord, Trim};
use maps::{MapError, PbStream, Pose, wrap_angle};
use synpf::Stamp;

use crate::sensors::bag::StampedPoses;

/// Columns of poses of `base_link`.
const BASE_LINK: [&str; 4] = ["stamp_s", "x_m", "y_m", "heading_rad"];

/// Columns of poses of the laser.
const LASER: [&str; 4] = ["stamp_s", "laser_x_m", "laser_y_m", "laser_yaw_rad"];

/// Why a file of poses cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum PoseFileError {
    /// The file cannot be read, or a line of it is no CSV.
    #[error("{file}: {source}")]
    Read {
        /// Its path.
        file: String,
        /// The cause.
        source: csv::Error,
    },
    /// Its first line does not name the columns of a pose.
    #[error("{file}: no columns {}, nor {}", BASE_LINK.join(","), LASER.join(","))]
    Columns {
        /// Its path.
        file: String,
    },
    /// A value is no number.
    #[error("{file}, line {line}: {column}: {value:?} is no finite number")]
    Value {
        /// Its path.
        file: String,
        /// Counted from 1.
        line: u64,
        /// The column's name.
        column: &'static str,
        /// Its text.
        value: String,
    },
}

/// Between two nodes that are closer than this \[m, rad\] the car stood. Cartographer adds one every 5 s then.
const STOOD: [f64; 2] = [0.02, 0.02];
/// The longest such pause that is filled \[s\].
const LONGEST_PAUSE: f64 = 5.5;
/// In a pause there is a pose this often \[s\].
const PAUSE_STEP: f64 = 0.1;

/// Reads the trajectory of a Cartographer state, as poses of `base_link`: that is the tracking frame unless a team has chosen
/// the IMU's. While the car stood, poses between the nodes are added.
///
/// # Errors
/// When the file cannot be read.
pub fn read_trajectory(path: &Path) -> Result<StampedPoses, MapError> {
    let state = PbStream::load(path)?;
    let mut poses = StampedPoses::new();
    for node in state.nodes() {
        let stamp = Stamp(node.stamp);
        if let Some(&(last, pose)) = poses.last() {
            let pause: f64 = stamp.since(last);
            let stood = pose.distance(node.pose) < STOOD[0]
                && wrap_angle(node.pose.heading - pose.heading).abs() < STOOD[1];
            if stood && pause < LONGEST_PAUSE {
                let steps = (pause / PAUSE_STEP).floor() as usize;
                poses.extend((1..steps).map(|step| (last.plus(PAUSE_STEP * step as f64), pose)));
            }
        }
        poses.push((stamp, node.pose));
    }
    Ok(poses)
}

/// Reads poses of `base_link` in `map`. The first line, with or without a `#`, names the columns: `stamp_s x_m y_m
/// heading_rad` of `base_link`, or `stamp_s laser_x_m laser_y_m laser_yaw_rad` of the laser, which is mounted at
/// `base_link_from_laser`. Other columns are ignored. Stamps are those of the messages \[s\].
///
/// # Errors
/// When the file cannot be read, names no such columns, or a value is no number.
pub fn read_poses(path: &Path, base_link_from_laser: Pose) -> Result<StampedPoses, PoseFileError> {
    let file = path.display().to_string();
    let of_file = |source| PoseFileError::Read {
        file: file.clone(),
        source,
    };
    let mut reader = ReaderBuilder::new()
        .trim(Trim::All)
        .from_reader(File::open(path).map_err(|error| of_file(error.into()))?);
    let names = reader.headers().map_err(of_file)?;
    let place = |column: &str| {
        let is_it = |name: &str| name.trim_start_matches(['#', ' ']) == column;
        names.iter().position(is_it)
    };
    let places = |columns: [&'static str; 4]| {
        let found = columns.map(|column| place(column).map(|index| (column, index)));
        let [Some(stamp), Some(x), Some(y), Some(heading)] = found else {
            return None;
        };
        Some([stamp, x, y, heading])
    };
    let (columns, laser_from_base_link) = match (places(BASE_LINK), places(LASER)) {
        (Some(columns), _) => (columns, Pose::IDENTITY),
        (None, Some(columns)) => (columns, base_link_from_laser.inverse()),
        (None, None) => return Err(PoseFileError::Columns { file }),
    };
    let mut poses = StampedPoses::new();
    let mut record = StringRecord::new();
    while reader.read_record(&mut record).map_err(of_file)? {
        let mut values = [0.0; 4];
        for (value, (column, index)) in values.iter_mut().zip(columns) {
            let text = record.get(index).unwrap_or_default();
            let number = text.parse().ok().filter(|number: &f64| number.is_finite());
            *value = number.ok_or_else(|| PoseFileError::Value {
                file: file.clone(),
                line: record.position().map_or(0, csv::Position::line),
                column,
                value: text.to_owned(),
            })?;
        }
        let [stamp, x, y, heading] = values;
        let pose = Pose::new(x, y, heading) * laser_from_base_link;
        poses.push((Stamp((stamp * 1e9).round() as i64), pose));
    }
    Ok(poses)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<StampedPoses, String> {
        let folder = tempfile::tempdir().expect("folder");
        let path = folder.path().join("truth.csv");
        std::fs::write(&path, text).expect("writes");
        let poses = read_poses(&path, Pose::new(0.27, 0.0, 0.0));
        poses.map_err(|error| {
            error
                .to_string()
                .replace(&path.display().to_string(), "truth.csv")
        })
    }

    #[test]
    fn the_columns_decide_whose_poses_they_are() {
        let own = read("stamp_s,x_m,y_m,heading_rad\n1.5,2,3,0.1\n").expect("reads");
        assert_eq!(own, [(Stamp(1_500_000_000), Pose::new(2.0, 3.0, 0.1))]);
        let laser =
            "# stamp_s, laser_x_m, laser_y_m, laser_yaw_rad, fit\n-1, 2, 3, 1.5707963267948966, 0.9\n";
        let [(stamp, pose)] = read(laser).expect("reads")[..] else {
            panic!("one line, one pose");
        };
        assert_eq!(stamp, Stamp(-1_000_000_000));
        assert!(pose.distance(Pose::new(2.0, 2.73, 1.57)) < 1e-9, "{pose:?}");
    }

    #[test]
    fn faults_name_file_line_and_column() {
        let fault = |text: &str| read(text).expect_err("has a fault");
        assert!(fault("").starts_with("truth.csv: no columns stamp_s,x_m,y_m,heading_rad, nor "));
        assert!(fault("1.0,2.0,3.0,0.5\n").starts_with("truth.csv: no columns "));
        let header = "stamp_s,x_m,y_m,heading_rad";
        assert_eq!(
            fault(&format!("{header}\n1,2,3,4\n2,2,nan,4\n")),
            "truth.csv, line 3: y_m: \"nan\" is no finite number"
        );
        assert!(fault(&format!("{header}\n1,2,3\n")).contains("line: 2"));
        assert!(
            read_poses(Path::new("/no/such.csv"), Pose::IDENTITY)
                .is_err_and(|error| { error.to_string().starts_with("/no/such.csv: ") })
        );
    }
}
