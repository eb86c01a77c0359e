//! The messages of ROS 1: packed little-endian values without alignment, strings and lists behind their length.
//!
//! The types are those of ROS 2, which differ in one thing: a ROS 1 `Header` begins with a number that nobody uses.

use std::fmt;

use serde::de::{self, DeserializeOwned, DeserializeSeed, SeqAccess, Visitor};
use serde::forward_to_deserialize_any;

/// The type with a number in front.
const HEADER: &str = "Header";

/// Why a payload is not the message it should be.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub(super) struct Ros1Error(String);

impl de::Error for Ros1Error {
    fn custom<T: fmt::Display>(text: T) -> Self {
        Self(text.to_string())
    }
}

/// Decodes a message, which must use every byte.
pub(super) fn decode<T: DeserializeOwned>(payload: &[u8]) -> Result<T, Ros1Error> {
    let mut bytes = Bytes { rest: payload };
    let message = T::deserialize(&mut bytes)?;
    if bytes.rest.is_empty() {
        Ok(message)
    } else {
        let left = bytes.rest.len();
        Err(Ros1Error(format!("{left} bytes are left of {}", payload.len())))
    }
}

struct Bytes<'de> {
    rest: &'de [u8],
}

impl<'de> Bytes<'de> {
    fn take(&mut self, count: usize) -> Result<&'de [u8], Ros1Error> {
        let (taken, rest) = self.rest.split_at_checked(count).ok_or_else(|| {
            let left = self.rest.len();
            Ros1Error(format!("{count} bytes are needed where {left} are left"))
        })?;
        self.rest = rest;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], Ros1Error> {
        let (taken, rest) = self.rest.split_first_chunk().ok_or_else(|| {
            let left = self.rest.len();
            Ros1Error(format!("{N} bytes are needed where {left} are left"))
        })?;
        self.rest = rest;
        Ok(*taken)
    }

    fn length(&mut self) -> Result<usize, Ros1Error> {
        Ok(u32::from_le_bytes(self.array()?) as usize)
    }
}

/// A number of values one after the other.
struct Values<'a, 'de> {
    bytes: &'a mut Bytes<'de>,
    left: usize,
}

impl<'de> SeqAccess<'de> for Values<'_, 'de> {
    type Error = Ros1Error;

    fn next_element_seed<T: DeserializeSeed<'de>>(&mut self, seed: T) -> Result<Option<T::Value>, Ros1Error> {
        if self.left == 0 {
            return Ok(None);
        }
        self.left -= 1;
        seed.deserialize(&mut *self.bytes).map(Some)
    }

    fn size_hint(&self) -> Option<usize> {
        // A damaged length takes no more memory than the message has bytes.
        Some(self.left.min(self.bytes.rest.len()))
    }
}

macro_rules! numbers {
    ($($method:ident $visit:ident $number:ty),*) => {
        $(fn $method<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Ros1Error> {
            visitor.$visit(<$number>::from_le_bytes(self.array()?))
        })*
    };
}

impl<'de> de::Deserializer<'de> for &mut Bytes<'de> {
    type Error = Ros1Error;

    numbers! {
        deserialize_i8 visit_i8 i8, deserialize_u8 visit_u8 u8,
        deserialize_i16 visit_i16 i16, deserialize_u16 visit_u16 u16,
        deserialize_i32 visit_i32 i32, deserialize_u32 visit_u32 u32,
        deserialize_i64 visit_i64 i64, deserialize_u64 visit_u64 u64,
        deserialize_f32 visit_f32 f32, deserialize_f64 visit_f64 f64
    }

    fn deserialize_any<V: Visitor<'de>>(self, _: V) -> Result<V::Value, Ros1Error> {
        Err(Ros1Error("a type that no message of ROS 1 has".into()))
    }

    fn deserialize_bool<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Ros1Error> {
        visitor.visit_bool(self.array::<1>()?[0] != 0)
    }

    fn deserialize_str<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Ros1Error> {
        let length = self.length()?;
        let text = std::str::from_utf8(self.take(length)?);
        visitor.visit_borrowed_str(text.map_err(|error| Ros1Error(format!("a string: {error}")))?)
    }

    fn deserialize_string<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Ros1Error> {
        self.deserialize_str(visitor)
    }

    fn deserialize_seq<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Ros1Error> {
        let left = self.length()?;
        visitor.visit_seq(Values { bytes: self, left })
    }

    fn deserialize_tuple<V: Visitor<'de>>(self, left: usize, visitor: V) -> Result<V::Value, Ros1Error> {
        visitor.visit_seq(Values { bytes: self, left })
    }

    fn deserialize_struct<V: Visitor<'de>>(
        self,
        name: &'static str,
        fields: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, Ros1Error> {
        if name == HEADER {
            self.take(4)?;
        }
        self.deserialize_tuple(fields.len(), visitor)
    }

    forward_to_deserialize_any! {
        i128 u128 char bytes byte_buf option unit unit_struct newtype_struct tuple_struct map enum identifier ignored_any
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros2::messages::{Imu, LaserScan, RosOdometry, TfMessage};

    fn header(frame: &str) -> Vec<u8> {
        let mut bytes = 77_u32.to_le_bytes().to_vec();
        bytes.extend(5_u32.to_le_bytes());
        bytes.extend(6_u32.to_le_bytes());
        bytes.extend((frame.len() as u32).to_le_bytes());
        bytes.extend(frame.as_bytes());
        bytes
    }

    #[test]
    fn a_scan_laid_out_by_hand_is_read_and_nothing_less_or_more() {
        let mut bytes = header("laser");
        for value in [-1.0_f32, 1.0, 0.5, 0.001, 0.025, 0.02, 30.0] {
            bytes.extend(value.to_le_bytes());
        }
        bytes.extend(2_u32.to_le_bytes());
        bytes.extend(1.5_f32.to_le_bytes());
        bytes.extend(f32::INFINITY.to_le_bytes());
        bytes.extend(0_u32.to_le_bytes());
        let scan: LaserScan = decode(&bytes).expect("whole");
        assert_eq!((scan.header.stamp.sec, scan.header.stamp.nanosec), (5, 6));
        assert_eq!(scan.header.frame_id, "laser");
        assert_eq!(scan.ranges, [1.5, f32::INFINITY]);
        for length in 0..bytes.len() {
            assert!(decode::<LaserScan>(&bytes[..length]).is_err(), "cut at {length}");
        }
        bytes.push(0);
        assert!(decode::<LaserScan>(&bytes).is_err(), "one byte too many");
    }

    #[test]
    fn odometry_and_gyroscopes_have_arrays_without_a_length() {
        let numbers = |count: usize| (0..count).flat_map(|i| (i as f64).to_le_bytes());
        let mut bytes = header("odom");
        bytes.extend(4_u32.to_le_bytes());
        bytes.extend(b"base");
        bytes.extend(numbers(7 + 36 + 6 + 36));
        let odometry: RosOdometry = decode(&bytes).expect("whole");
        assert_eq!(odometry.child_frame_id, "base");
        assert!((odometry.pose.orientation.w - 6.0).abs() < 1e-12);
        assert!((odometry.linear.x - 43.0).abs() < 1e-12);
        assert!((odometry.twist_covariance[5][5] - 84.0).abs() < 1e-12);
        let mut bytes = header("imu");
        bytes.extend(numbers(4 + 9 + 3 + 9 + 3 + 9));
        let imu: Imu = decode(&bytes).expect("whole");
        assert!((imu.angular_velocity.z - 15.0).abs() < 1e-12);
    }

    #[test]
    fn a_length_beyond_the_message_is_refused_at_once() {
        assert!(decode::<TfMessage>(&u32::MAX.to_le_bytes()).is_err());
    }
}
