//! Requests for the recordings on a car.
//!
//! ```text
//! pit wall --- list | read a piece | checksum ---> car
//!          <-- files | bytes | checksum ---------
//! ```
//!
//! A file has a number and no name, so that nothing in a message is a path. Numbers count up and are never used again while a
//! younger file exists. The pit wall decides the pace: a reply is one message of bounded length.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::{CarName, Invalid, Message, Schema};

/// A request about the recordings on a car.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FilesRequest {
    /// List the recordings, ascending.
    List {
        /// Only those with a higher number.
        after: u64,
    },
    /// Read a piece of a recording.
    Read {
        /// Its number.
        number: u64,
        /// Where the piece begins \[bytes\].
        offset: u64,
        /// Its length, at most [`FilesRequest::MAX_READ`]; the reply is shorter at the end of the file \[bytes\].
        length: u32,
    },
    /// Compute the checksum of a recording's first bytes.
    Checksum {
        /// Its number.
        number: u64,
        /// How many bytes.
        length: u64,
    },
}

impl FilesRequest {
    /// Longest piece in one reply \[bytes\].
    pub const MAX_READ: u32 = 64 * 1024;
}

/// The reply to a [`FilesRequest`].
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FilesReply {
    /// Recordings on the car.
    Files {
        /// Ascending by number, at most [`FilesReply::MAX_FILES`].
        files: Vec<FileInfo>,
        /// True when there are more.
        more: bool,
    },
    /// A piece of a recording.
    Bytes {
        /// Its number.
        number: u64,
        /// Where the piece begins \[bytes\].
        offset: u64,
        /// The piece; empty at the end of the file.
        bytes: Vec<u8>,
    },
    /// A checksum.
    Checksum {
        /// The recording's number.
        number: u64,
        /// How many bytes it is of.
        length: u64,
        /// XXH3, 64 bits, seed 0.
        xxh3: u64,
    },
    /// The request cannot be answered.
    Refused {
        /// Why, in words.
        fault: String,
    },
}

impl FilesReply {
    /// Most files in one reply.
    pub const MAX_FILES: usize = 512;
    /// Longest fault \[bytes\].
    pub const MAX_FAULT: usize = 1024;
}

/// A recording on a car.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct FileInfo {
    /// Its number.
    pub number: u64,
    /// When it was begun, by the car's clock then \[unix ns\].
    pub started: i64,
    /// Its length; of a file being written, as far as it is safely on the disk \[bytes\].
    pub bytes: u64,
    /// False while it is being written.
    pub finished: bool,
}

/// The name of a recording on a car's disk, and of its copy at the pit wall: `000012_20260630-141500_car-1.mcap`. Names sort by
/// number, whatever the car's clock was.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct FileName {
    /// The recording's number.
    pub number: u64,
    /// When it was begun, by the car's clock then, in whole seconds \[unix ns\].
    pub started: i64,
    /// The car.
    pub car: CarName,
}

/// Not the name of a car's recording.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} is not the name of a car's recording, such as 000012_20260630-141500_car-1.mcap")]
pub struct FileNameError(String);

/// A time for people \[unix ns\]: `2026-06-30 14:15:00`, in UTC.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct UtcTime(pub i64);

impl UtcTime {
    /// Year, month, day, hours, minutes and seconds.
    fn parts(self) -> [i64; 6] {
        let seconds = self.0.div_euclid(SECOND);
        let (year, month, day) = date(seconds.div_euclid(DAY));
        let time = seconds.rem_euclid(DAY);
        [year, month, day, time / 3600, time / 60 % 60, time % 60]
    }
}

impl fmt::Display for UtcTime {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [year, month, day, hours, minutes, seconds] = self.parts();
        f.pad(&format!(
            "{year:04}-{month:02}-{day:02} {hours:02}:{minutes:02}:{seconds:02}"
        ))
    }
}

impl fmt::Display for FileName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [year, month, day, hours, minutes, seconds] = UtcTime(self.started).parts();
        let Self { number, car, .. } = self;
        write!(
            f,
            "{number:06}_{year:04}{month:02}{day:02}-{hours:02}{minutes:02}{seconds:02}_{car}.mcap"
        )
    }
}

impl FromStr for FileName {
    type Err = FileNameError;

    fn from_str(name: &str) -> Result<Self, FileNameError> {
        let parse = || {
            let mut parts = name.strip_suffix(".mcap")?.splitn(3, '_');
            let (number, started, car) = (parts.next()?, parts.next()?, parts.next()?);
            let (day, time) = started.split_once('-')?;
            let digits = |text: &str| {
                let only_digits = text.bytes().all(|byte| byte.is_ascii_digit());
                only_digits.then(|| text.parse::<i64>().ok()).flatten()
            };
            let (day, time) = (digits(day)?, digits(time)?);
            let days = days(day / 10_000, day / 100 % 100, day % 100);
            let seconds = time / 10_000 * 3600 + time / 100 % 100 * 60 + time % 100;
            Some(Self {
                number: digits(number)?.try_into().ok()?,
                started: days.checked_mul(DAY)?.checked_add(seconds)?.checked_mul(SECOND)?,
                car: car.parse().ok()?,
            })
        };
        // One way to write each name: what is formatted differently is another file.
        parse()
            .filter(|parsed| parsed.to_string() == name)
            .ok_or_else(|| FileNameError(name.to_owned()))
    }
}

const SECOND: i64 = 1_000_000_000;
const DAY: i64 = 86_400;
/// Days of the Gregorian calendar in 400 years.
const ERA: i64 = 146_097;
/// From the first of March of the year 0 to 1970-01-01 \[days\].
const EPOCH: i64 = 719_468;

/// Year, month and day of a number of days since 1970-01-01. Years begin in March, so that the day of the leap year is their last.
fn date(days: i64) -> (i64, i64, i64) {
    let days = days + EPOCH;
    let (era, day) = (days.div_euclid(ERA), days.rem_euclid(ERA));
    let year = (day - day / 1460 + day / 36_524 - day / (ERA - 1)) / 365;
    let day = day - (365 * year + year / 4 - year / 100);
    // March to July have 153 days, and so have August to December.
    let month = (5 * day + 2) / 153;
    let day = day - (153 * month + 2) / 5 + 1;
    let month = if month < 10 { month + 3 } else { month - 9 };
    (400 * era + year + i64::from(month <= 2), month, day)
}

/// The inverse of [`date`].
fn days(year: i64, month: i64, day: i64) -> i64 {
    let year = year - i64::from(month <= 2);
    let month = (month + 9).rem_euclid(12);
    let (era, year) = (year.div_euclid(400), year.rem_euclid(400));
    era * ERA + 365 * year + year / 4 - year / 100 + (153 * month + 2) / 5 + day - 1 - EPOCH
}

impl Message for FilesRequest {
    const SCHEMA: Schema = Schema::FilesRequest;
    const MAX_LEN: usize = 64;

    fn validate(&self) -> Result<(), Invalid> {
        match self {
            Self::Read { length, .. } => {
                Invalid::unless_at_most("length", *length as usize, Self::MAX_READ as usize)
            }
            Self::List { .. } | Self::Checksum { .. } => Ok(()),
        }
    }
}

impl Message for FilesReply {
    const SCHEMA: Schema = Schema::FilesReply;
    /// The longest piece with its place.
    const MAX_LEN: usize = 128 * 1024;

    fn validate(&self) -> Result<(), Invalid> {
        match self {
            Self::Files { files, .. } => {
                Invalid::unless_at_most("files", files.len(), Self::MAX_FILES)?;
                if let Some(pair) = files.windows(2).find(|pair| pair[0].number >= pair[1].number) {
                    let fault = format!("{} after {}", pair[1].number, pair[0].number);
                    return Err(Invalid::new("number", fault));
                }
                Ok(())
            }
            Self::Bytes { bytes, .. } => {
                Invalid::unless_at_most("bytes", bytes.len(), FilesRequest::MAX_READ as usize)
            }
            Self::Refused { fault } => Invalid::unless_at_most("fault", fault.len(), Self::MAX_FAULT),
            Self::Checksum { .. } => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_name_has_the_number_the_time_and_the_car() {
        let name = FileName {
            number: 12,
            started: 1_782_828_900 * SECOND,
            car: "car-1".parse().expect("a name"),
        };
        assert_eq!(name.to_string(), "000012_20260630-141500_car-1.mcap");
        assert_eq!("000012_20260630-141500_car-1.mcap".parse(), Ok(name));
    }

    #[test]
    fn other_files_are_not_a_cars_recordings() {
        for name in [
            "",
            "session.mcap",
            "12_20260630-141500_car-1.mcap",
            "000012_20260630-141500_car-1.mcap.part",
            "000012_20260230-141500_car-1.mcap",
            "000012_20260630-251500_car-1.mcap",
            "000012_20260630-141500_../x.mcap",
            "+00012_20260630-141500_car-1.mcap",
            "000012_99999999999999999-141500_car-1.mcap",
        ] {
            assert!(name.parse::<FileName>().is_err(), "{name}");
        }
    }

    proptest! {
        #[test]
        fn parse_undoes_format(number in 0..i64::MAX as u64, seconds in 0..253_402_300_800_i64) {
            let name = FileName { number, started: seconds * SECOND.min(i64::MAX / seconds.max(1)), car: CarName::new("car-1").expect("a good name") };
            let whole = FileName { started: name.started.div_euclid(SECOND) * SECOND, ..name };
            prop_assert_eq!(whole.to_string().parse(), Ok(whole));
        }
    }
}
