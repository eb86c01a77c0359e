//! The defects, each in up to three grades.

use std::fmt;
use std::str::FromStr;

use serde::Serialize;

/// What a defect damages.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Part {
    /// The map does not show the walls as they are.
    Map,
    /// There are people, boards and cars that the map does not have.
    Surroundings,
    /// The laser scanner measures wrongly, or it is a lesser one.
    Laser,
    /// Wheel odometry is wrong.
    Odometry,
    /// The gyroscope is wrong.
    Gyro,
    /// Stamps and arrivals are wrong.
    Clock,
    /// The car is carried away.
    Car,
}

impl fmt::Display for Part {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Map => "map",
            Self::Surroundings => "surroundings",
            Self::Laser => "laser",
            Self::Odometry => "odometry",
            Self::Gyro => "gyroscope",
            Self::Clock => "clock",
            Self::Car => "car",
        })
    }
}

/// How bad a defect is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Grade {
    /// As on a good day.
    Mild,
    /// As on a bad day. A defect without grades has this one.
    Medium,
    /// Worse than should be raced with.
    Severe,
}

impl Grade {
    /// All of them, mildest first.
    pub const ALL: [Self; 3] = [Self::Mild, Self::Medium, Self::Severe];
}

impl fmt::Display for Grade {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Mild => "mild",
            Self::Medium => "medium",
            Self::Severe => "severe",
        })
    }
}

macro_rules! kinds {
    ($($(#[$doc:meta])* $kind:ident = $name:literal, $part:ident, $sizes:expr, $unit:literal, $text:literal;)*) => {
        /// The kinds of defects. [`DefectKind::text`] explains each of them.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
        #[serde(rename_all = "kebab-case")]
        pub enum DefectKind {
            $(#[doc = $text] $(#[$doc])* $kind,)*
        }

        impl DefectKind {
            /// All of them, in the order in which they are reported.
            pub const ALL: &'static [Self] = &[$(Self::$kind,)*];

            /// Its name on the command line.
            pub fn name(self) -> &'static str {
                match self { $(Self::$kind => $name,)* }
            }

            /// What it damages.
            pub fn part(self) -> Part {
                match self { $(Self::$kind => Part::$part,)* }
            }

            /// What it does, in words.
            pub fn text(self) -> &'static str {
                match self { $(Self::$kind => $text,)* }
            }

            /// Its size for each grade, in [`Self::unit`]; one size for a defect without grades.
            fn sizes(self) -> &'static [f64] {
                match self { $(Self::$kind => &$sizes,)* }
            }

            /// The unit of its size, as text.
            fn unit(self) -> &'static str {
                match self { $(Self::$kind => $unit,)* }
            }
        }
    };
}

kinds! {
    WallMissing = "wall-missing", Map, [3.0, 6.0, 24.0], "m", "Stretches of wall of up to 6 m are missing on the map.";
    WallMoved = "wall-moved", Map, [10.0, 20.0, 40.0], "cm", "Stretches of wall of 3 m stand elsewhere than on the map: one, three or six of them.";
    RaggedWalls = "ragged-walls", Map, [10.0, 30.0, 50.0], "%", "Cells at the walls' faces are added or missing, as in a poor map of SLAM.";
    ThickWalls = "thick-walls", Map, [1.0, 2.0, 4.0], "cells", "Walls on the map are thicker than they are.";
    CoarseCells = "coarse-cells", Map, [2.0, 3.0, 4.0], "times", "The cells of the map are larger.";
    BentMap = "bent-map", Map, [5.0, 10.0, 20.0], "cm", "The map is bent by this amplitude; poses count against the bent map.";
    ScaledMap = "scaled-map", Map, [0.5, 1.0, 2.0], "%", "The map is too large; poses count against the scaled map.";
    Specks = "specks", Map, [0.2, 1.0, 5.0], "%", "Single cells of the map are wrong, anywhere.";

    Boards = "boards", Surroundings, [10.0, 20.0, 40.0], "%", "Boards stand 10 cm inside the walls over this share of them.";
    People = "people", Surroundings, [10.0, 20.0, 40.0], "%", "People at the barrier hide this share of the walls.";
    Cars = "cars", Surroundings, [1.0, 2.0, 3.0], "cars", "Cars drive close by: one ahead, two ahead, or three that nearly touch.";

    RangeNoise = "range-noise", Laser, [3.0, 5.0, 10.0], "cm", "Ranges have more noise, by this standard deviation.";
    Dropout = "dropout", Laser, [20.0, 50.0, 80.0], "%", "Beams have no return, at random.";
    ShortReturns = "short-returns", Laser, [2.0, 10.0, 30.0], "%", "Beams return from dust or rain before the wall, at random.";
    RangeBias = "range-bias", Laser, [1.0, 3.0, 6.0], "cm", "Ranges are too long.";
    LaserTurned = "laser-turned", Laser, [0.5, 1.0, 2.0], "deg", "The laser is mounted turned from where it is said to be.";
    BlockedSector = "blocked-sector", Laser, [30.0, 60.0, 120.0], "deg", "A part of the car blocks a sector of the view, at the front left.";
    FewBeams = "few-beams", Laser, [180.0, 90.0, 40.0], "beams", "The scanner has fewer beams over the same view.";
    SlowScans = "slow-scans", Laser, [20.0, 10.0, 5.0], "Hz", "The scanner is slower.";
    NarrowView = "narrow-view", Laser, [180.0, 120.0, 90.0], "deg", "The scanner sees less to the sides.";
    ShortRange = "short-range", Laser, [10.0, 6.0, 4.0], "m", "The scanner has a shorter range.";
    NoTimeIncrement = "no-time-increment", Laser, [40.0, 20.0, 10.0], "Hz", "The scanner sweeps while the car moves, and does not state the time between beams.";
    FrozenScans = "frozen-scans", Laser, [0.2, 0.5, 1.0], "s", "The scanner repeats a scan under new stamps, every 10 s.";

    WheelScale = "wheel-scale", Odometry, [1.1, 1.2, 1.4], "times", "Odometry's distance is too long, as with wheels of another size.";
    WheelSpin = "wheel-spin", Odometry, [0.2, 0.5, 1.0], "s", "The wheels spin at twice the speed, every 5 s while the car drives.";
    WheelLock = "wheel-lock", Odometry, [0.2, 0.5, 1.0], "s", "The wheels lock, every 5 s while the car drives.";
    TurnScale = "turn-scale", Odometry, [0.9, 0.8, 0.5], "times", "Odometry turns too little.";
    TurnBias = "turn-bias", Odometry, [0.05, 0.1, 0.3], "rad/s", "Odometry turns while the car drives straight on.";
    Creep = "creep", Odometry, [0.05, 0.1, 0.2], "m/s", "Odometry moves backwards by this speed, also at standstill.";
    OdometryNoise = "odometry-noise", Odometry, [1.0, 3.0, 5.0], "cm", "Odometry's position has noise, by this standard deviation.";
    OdometrySlow = "odometry-slow", Odometry, [20.0, 10.0, 5.0], "Hz", "Odometry comes at a lower rate.";
    OdometryGap = "odometry-gap", Odometry, [0.1, 0.3, 1.0], "s", "No odometry arrives for this time, every 10 s.";
    OdometryLate = "odometry-late", Odometry, [20.0, 50.0, 100.0], "ms", "Odometry is stamped late, and arrives late.";
    TwistZero = "twist-zero", Odometry, [1.0], "", "Odometry's twist is all zero.";
    PoseZero = "pose-zero", Odometry, [1.0], "", "Odometry's pose is all zero.";

    GyroBias = "gyro-bias", Gyro, [0.05, 0.1, 0.3], "rad/s", "The gyroscope has a bias.";
    GyroDegrees = "gyro-degrees", Gyro, [1.0], "", "The gyroscope reports deg/s.";
    GyroFlipped = "gyro-flipped", Gyro, [1.0], "", "The gyroscope turns the wrong way.";
    GyroZero = "gyro-zero", Gyro, [1.0], "", "The gyroscope always reads zero.";
    GyroNone = "gyro-none", Gyro, [1.0], "", "The gyroscope does not report.";

    ScanJitter = "scan-jitter", Clock, [5.0, 10.0, 20.0], "ms", "The stamps of scans are off by up to this time, at random.";
    LateStamps = "late-stamps", Clock, [10.0, 20.0, 50.0], "ms", "Scans are stamped late, as at the end of a sweep.";
    Bursts = "bursts", Clock, [60.0, 100.0, 200.0], "ms", "Odometry arrives in bursts.";

    Kidnap = "kidnap", Car, [1.0, 2.0, 4.0], "s driven", "The car is carried on over this part of its way, once, and odometry does not notice.";
}

impl fmt::Display for DefectKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

impl FromStr for DefectKind {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Self::ALL
            .iter()
            .copied()
            .find(|kind| kind.name() == text)
            .ok_or_else(|| {
                let names: Vec<_> = Self::ALL.iter().map(|kind| kind.name()).collect();
                format!("no defect {text:?}; there are {}", names.join(", "))
            })
    }
}

impl DefectKind {
    /// The defect in each of its grades, mildest first.
    pub fn grades(self) -> impl Iterator<Item = Defect> {
        let graded = self.sizes().len() == Grade::ALL.len();
        Grade::ALL
            .into_iter()
            .filter(move |grade| graded || *grade == Grade::Medium)
            .map(move |grade| Defect { kind: self, grade })
    }
}

/// A kind of defect in one grade. As text: `range-noise:severe`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub struct Defect {
    /// Its kind.
    pub kind: DefectKind,
    /// Its grade.
    pub grade: Grade,
}

impl Defect {
    /// Its size, in the unit of its kind.
    pub fn size(self) -> f64 {
        match self.kind.sizes() {
            [size] => *size,
            sizes => sizes[self.grade as usize],
        }
    }

    /// Its size with the unit, as `5 cm`; empty for a defect without grades.
    pub fn size_text(self) -> String {
        match self.kind.sizes() {
            [_] => String::new(),
            _ => match (self.size(), self.kind.unit().strip_suffix("s")) {
                (size, Some(one)) if size.to_bits() == 1.0f64.to_bits() && !one.is_empty() => {
                    format!("{size} {one}")
                }
                (size, _) => format!("{size} {}", self.kind.unit()),
            },
        }
    }
}

impl fmt::Display for Defect {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}", self.kind, self.grade)
    }
}

/// A choice of defects: a kind, or one grade of it. As text: `range-noise` or `range-noise:severe`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DefectChoice {
    /// The kind.
    pub kind: DefectKind,
    /// The grade; None where none is given.
    pub grade: Option<Grade>,
}

impl FromStr for DefectChoice {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (name, grade) = match text.split_once(':') {
            None => (text, None),
            Some((name, grade)) => (name, Some(grade)),
        };
        let kind: DefectKind = name.parse()?;
        let grade = grade.map(|grade| {
            let known = kind.grades().map(|defect| defect.grade);
            known.into_iter().find(|g| g.to_string() == grade).ok_or_else(|| {
                let grades: Vec<_> = kind.grades().map(|defect| defect.grade.to_string()).collect();
                format!("no grade {grade:?} of {kind}; there is {}", grades.join(", "))
            })
        });
        Ok(Self {
            kind,
            grade: grade.transpose()?,
        })
    }
}

impl DefectChoice {
    /// The defects that it names: one, or all grades of the kind.
    pub fn defects(self) -> impl Iterator<Item = Defect> {
        self.kind
            .grades()
            .filter(move |defect| self.grade.is_none_or(|grade| grade == defect.grade))
    }

    /// One defect: of the grade that is given, else medium.
    pub fn one(self) -> Defect {
        Defect {
            kind: self.kind,
            grade: self.grade.unwrap_or(Grade::Medium),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_defect_has_a_name_of_its_own_and_one_or_three_grades() {
        for (index, kind) in DefectKind::ALL.iter().enumerate() {
            assert_eq!(kind.name().parse(), Ok(*kind));
            assert!(
                DefectKind::ALL[..index]
                    .iter()
                    .all(|other| other.part() <= kind.part())
            );
            let defects: Vec<_> = kind.grades().collect();
            assert!(defects.len() == 1 || defects.len() == 3, "{kind}");
            for defect in defects {
                let choice: DefectChoice = defect.to_string().parse().expect("its own text");
                assert_eq!(choice.one(), defect);
                assert!(defect.size() > 0.0);
            }
        }
    }

    #[test]
    fn a_choice_is_a_kind_or_a_grade_of_it() {
        let all: DefectChoice = "people".parse().expect("a kind");
        assert_eq!(all.defects().count(), 3);
        assert_eq!(all.one().grade, Grade::Medium);
        let one: DefectChoice = "people:severe".parse().expect("a grade");
        assert_eq!(one.defects().map(Defect::size_text).collect::<Vec<_>>(), ["40 %"]);
        for (text, part) in [
            ("flood", "no defect \"flood\""),
            ("people:awful", "there is mild, medium, severe"),
            ("twist-zero:mild", "there is medium"),
            ("", "wall-missing"),
        ] {
            let error = text.parse::<DefectChoice>().expect_err(text);
            assert!(error.contains(part), "{error}");
        }
    }
}
