//! The channels of a lap.

use serde::{Serialize, Serializer};

/// A value over the track coordinate.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[repr(usize)]
pub enum Channel {
    /// Speed over ground \[m/s\].
    Speed,
    /// Distance from the raceline, left positive \[m\].
    Lateral,
    /// Heading of the car minus that of the raceline \[rad\].
    HeadingError,
    /// Yaw rate, left positive \[rad/s\].
    YawRate,
    /// Greatest standard deviation of the position \[m\].
    Sigma,
    /// Share of the beams that end at a wall of the map.
    Alignment,
    /// Mean distance of the end points from the walls \[m\].
    Residual,
    /// Standard deviation of the particles along the track \[m\].
    SpreadAlong,
    /// Standard deviation of the particles across the track \[m\].
    SpreadAcross,
    /// Share of odometry's distance that was not driven.
    Slip,
    /// Distance by which the last scan corrected the pose \[m\].
    Correction,
    /// Share of the beams that are longer than in the map.
    LongBeams,
    /// Share of the beams that are shorter than in the map.
    ShortBeams,
    /// Age of a pose when it was published, 99th percentile \[ms\].
    Age,
    /// Time of a filter update, 99th percentile over a second \[ms\].
    UpdateTime,
}

/// Which values of a channel are worse.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Worse {
    /// High ones.
    High,
    /// Low ones.
    Low,
    /// Those far from zero.
    Far,
    /// None: it is a measurement, not a fault.
    Neither,
}

/// The fields of a [`ChannelInfo`] in their order.
type Row = (
    &'static str,
    &'static str,
    &'static str,
    f64,
    u8,
    f64,
    &'static [f64],
    Worse,
);

/// How a channel is drawn and packed.
#[derive(Debug, Clone, Copy, Serialize)]
pub(crate) struct ChannelInfo {
    /// Its name in the data.
    pub(crate) name: &'static str,
    /// Its name for a reader.
    pub(crate) label: &'static str,
    /// Its unit for a reader.
    pub(crate) unit: &'static str,
    /// Factor from the channel's own unit to the reader's.
    pub(crate) factor: f64,
    /// Digits for a reader.
    pub(crate) digits: u8,
    /// Step of the packed numbers.
    pub(crate) step: f64,
    /// The health monitor's limits for a warning and for an alarm, in the channel's own unit.
    pub(crate) limits: &'static [f64],
    pub(crate) worse: Worse,
}

impl Channel {
    /// All channels, in the order of their numbers.
    pub const ALL: [Self; 15] = [
        Self::Speed,
        Self::Lateral,
        Self::HeadingError,
        Self::YawRate,
        Self::Sigma,
        Self::Alignment,
        Self::Residual,
        Self::SpreadAlong,
        Self::SpreadAcross,
        Self::Slip,
        Self::Correction,
        Self::LongBeams,
        Self::ShortBeams,
        Self::Age,
        Self::UpdateTime,
    ];
    /// Number of channels.
    pub const COUNT: usize = Self::ALL.len();

    /// The channel called `name`.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|channel| channel.info().name == name)
    }

    /// Its name in the data.
    pub fn name(self) -> &'static str {
        self.info().name
    }

    /// How it is drawn and packed. The limits are those that the health monitor has by default.
    #[allow(clippy::too_many_lines, reason = "one entry for each channel")]
    pub(crate) fn info(self) -> ChannelInfo {
        const NONE: &[f64] = &[];
        let deg = 180.0 / std::f64::consts::PI;
        let (name, label, unit, factor, digits, step, limits, worse): Row = match self {
            Self::Speed => ("speed", "speed", "m/s", 1.0, 2, 1e-3, NONE, Worse::Neither),
            Self::Lateral => ("lateral", "lateral error", "cm", 100.0, 1, 1e-3, NONE, Worse::Far),
            Self::HeadingError => (
                "heading_error",
                "heading error",
                "°",
                deg,
                1,
                2e-4,
                NONE,
                Worse::Far,
            ),
            Self::YawRate => (
                "yaw_rate",
                "yaw rate",
                "rad/s",
                1.0,
                2,
                1e-3,
                NONE,
                Worse::Neither,
            ),
            Self::Sigma => (
                "sigma",
                "sigma of the pose",
                "cm",
                100.0,
                1,
                5e-4,
                NONE,
                Worse::High,
            ),
            Self::Alignment => (
                "alignment",
                "alignment",
                "%",
                100.0,
                1,
                1e-4,
                &[0.6, 0.45],
                Worse::Low,
            ),
            Self::Residual => (
                "residual",
                "residual",
                "cm",
                100.0,
                1,
                1e-4,
                &[0.25, 0.35],
                Worse::High,
            ),
            Self::SpreadAlong => (
                "spread_along",
                "spread along",
                "cm",
                100.0,
                1,
                5e-4,
                &[0.4],
                Worse::High,
            ),
            Self::SpreadAcross => (
                "spread_across",
                "spread across",
                "cm",
                100.0,
                1,
                5e-4,
                &[0.15],
                Worse::High,
            ),
            Self::Slip => ("slip", "slip", "%", 100.0, 1, 1e-3, &[0.08, 0.2], Worse::Far),
            Self::Correction => (
                "correction",
                "correction per scan",
                "cm",
                100.0,
                1,
                5e-4,
                NONE,
                Worse::High,
            ),
            Self::LongBeams => (
                "long_beams",
                "beams too long",
                "%",
                100.0,
                1,
                1e-4,
                NONE,
                Worse::High,
            ),
            Self::ShortBeams => (
                "short_beams",
                "beams too short",
                "%",
                100.0,
                1,
                1e-4,
                NONE,
                Worse::High,
            ),
            Self::Age => ("age", "age of the pose", "ms", 1.0, 1, 0.1, NONE, Worse::High),
            Self::UpdateTime => (
                "update_time",
                "update time p99",
                "ms",
                1.0,
                2,
                1e-2,
                &[20.0],
                Worse::High,
            ),
        };
        ChannelInfo {
            name,
            label,
            unit,
            factor,
            digits,
            step,
            limits,
            worse,
        }
    }
}

impl Serialize for Channel {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_channel_is_found_by_its_name_and_number() {
        for (number, channel) in Channel::ALL.into_iter().enumerate() {
            assert_eq!(channel as usize, number);
            assert_eq!(Channel::named(channel.name()), Some(channel));
        }
    }
}
