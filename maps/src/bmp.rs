//! Windows bitmaps (BMP): uncompressed, with a palette or with 16, 24 or 32 bits per pixel.

use crate::raster::{Raster, check_size};

/// Length of the file header, which the bitmap header follows \[bytes\].
const FILE_HEADER: usize = 14;
/// Length of the oldest bitmap header, with 16-bit sizes \[bytes\].
const CORE_HEADER: usize = 12;
/// Length of the bitmap header that all later ones begin with \[bytes\].
const INFO_HEADER: usize = 40;

/// Reads a bitmap. Pixels become red, green, blue and alpha.
pub(crate) fn decode(bytes: &[u8]) -> Result<Raster, String> {
    let file = Bytes(bytes);
    let pixels_at = file.u32(10)? as usize;
    let header_len = file.u32(FILE_HEADER)? as usize;
    let core = header_len == CORE_HEADER;
    if !core && header_len < INFO_HEADER {
        return Err(format!(
            "a bitmap header of {header_len} bytes; 12, 40 or more are known"
        ));
    }
    let (width, height) = if core {
        (i64::from(file.u16(18)?), i64::from(file.u16(20)?))
    } else {
        (i64::from(file.i32(18)?), i64::from(file.i32(22)?))
    };
    let bits = file.u16(if core { 24 } else { 28 })?;
    let compression = if core { 0 } else { file.u32(30)? };
    // A negative height means that the first row is the top one.
    let top_down = height < 0;
    let width = u64::try_from(width).map_err(|_| format!("a width of {width} pixels"))?;
    let height = height.unsigned_abs();
    check_size(width, height)?;
    let (width, height) = (width as usize, height as usize);

    let colours = match (bits, compression) {
        (1 | 4 | 8, 0) => Colours::Palette(palette(file, header_len, bits)?),
        (16, 0) => Colours::Masks([0x7c00, 0x03e0, 0x001f, 0]),
        (24 | 32, 0) => Colours::Masks([0x00ff_0000, 0x0000_ff00, 0x0000_00ff, 0]),
        // The masks are part of later headers, and follow the oldest one at the same place.
        (16 | 32, 3 | 6) => {
            let alpha = if compression == 6 || header_len >= 56 {
                file.u32(66)?
            } else {
                0
            };
            Colours::Masks([file.u32(54)?, file.u32(58)?, file.u32(62)?, alpha])
        }
        (_, 1 | 2) => return Err("a compressed bitmap (RLE); save it uncompressed".to_owned()),
        _ => {
            return Err(format!(
                "a bitmap of {bits} bits per pixel with compression {compression} cannot be read"
            ));
        }
    };

    let bits = usize::from(bits);
    // Rows are padded to whole groups of four bytes.
    let stride = (width * bits).div_ceil(32) * 4;
    let needed = stride * height;
    let data = bytes.get(pixels_at..).unwrap_or_default();
    if data.len() < needed {
        return Err(format!(
            "{} bytes of pixels where {width} x {height} need {needed}",
            data.len()
        ));
    }
    let mut samples = Vec::with_capacity(width * height * 4);
    for row in 0..height {
        let row = if top_down { row } else { height - 1 - row };
        let row = &data[row * stride..(row + 1) * stride];
        for column in 0..width {
            samples.extend(colours.rgba(pixel(row, column, bits))?);
        }
    }
    Ok(Raster {
        width,
        height,
        channels: 4,
        white: 255,
        samples,
    })
}

/// What a pixel's bits mean.
enum Colours {
    /// An index into these colours.
    Palette(Vec<[u16; 4]>),
    /// Red, green, blue and alpha are parts of it.
    Masks([u32; 4]),
}

impl Colours {
    /// Red, green, blue and alpha, 255 each at most.
    fn rgba(&self, pixel: u32) -> Result<[u16; 4], String> {
        match self {
            Self::Palette(colours) => colours
                .get(pixel as usize)
                .copied()
                .ok_or_else(|| format!("colour {pixel} of a palette of {}", colours.len())),
            Self::Masks(masks) => {
                let mut rgba = masks.map(|mask| part(pixel, mask));
                if masks[3] == 0 {
                    rgba[3] = 255;
                }
                Ok(rgba)
            }
        }
    }
}

/// The part of a pixel under a mask, stretched to 0..=255.
fn part(pixel: u32, mask: u32) -> u16 {
    if mask == 0 {
        return 0;
    }
    let shift = mask.trailing_zeros();
    let (value, most) = (u64::from((pixel & mask) >> shift), u64::from(mask >> shift));
    ((value * 255 + most / 2) / most) as u16
}

/// The colours behind the bitmap header: blue, green and red, and in all but the oldest bitmaps a byte of nothing.
fn palette(file: Bytes<'_>, header_len: usize, bits: u16) -> Result<Vec<[u16; 4]>, String> {
    let core = header_len == CORE_HEADER;
    let full = 1_usize << bits;
    let count = match if core { 0 } else { file.u32(46)? as usize } {
        0 => full,
        used => used.min(full),
    };
    let size = if core { 3 } else { 4 };
    (0..count)
        .map(|i| {
            let [blue, green, red] = file.take(FILE_HEADER + header_len + i * size)?;
            Ok([red.into(), green.into(), blue.into(), 255])
        })
        .collect()
}

/// The bits of one pixel. Pixels of less than a byte begin at its highest bit.
fn pixel(row: &[u8], column: usize, bits: usize) -> u32 {
    if bits < 8 {
        let bit = column * bits;
        let shift = 8 - bits - bit % 8;
        return u32::from(row[bit / 8] >> shift) & ((1 << bits) - 1);
    }
    let size = bits / 8;
    row[column * size..(column + 1) * size]
        .iter()
        .rev()
        .fold(0, |value, &byte| value << 8 | u32::from(byte))
}

/// Little-endian numbers at places that may lie past the end.
#[derive(Clone, Copy)]
struct Bytes<'a>(&'a [u8]);

impl Bytes<'_> {
    fn take<const N: usize>(self, at: usize) -> Result<[u8; N], String> {
        self.0
            .get(at..)
            .and_then(|rest| rest.first_chunk())
            .copied()
            .ok_or_else(|| format!("the bitmap ends after {} bytes, within its headers", self.0.len()))
    }

    fn u16(self, at: usize) -> Result<u16, String> {
        self.take(at).map(u16::from_le_bytes)
    }

    fn u32(self, at: usize) -> Result<u32, String> {
        self.take(at).map(u32::from_le_bytes)
    }

    fn i32(self, at: usize) -> Result<i32, String> {
        self.take(at).map(i32::from_le_bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// A bitmap with the 40-byte header. `extra` is its palette or its masks.
    fn bitmap(size: [i32; 2], bits: u16, compression: u32, extra: &[u8], pixels: &[u8]) -> Vec<u8> {
        let mut bytes = b"BM".to_vec();
        bytes.extend([0; 8]);
        bytes.extend((54 + extra.len() as u32).to_le_bytes());
        bytes.extend(40_u32.to_le_bytes());
        bytes.extend(size.iter().flat_map(|v| v.to_le_bytes()));
        bytes.extend(1_u16.to_le_bytes());
        bytes.extend(bits.to_le_bytes());
        bytes.extend(compression.to_le_bytes());
        bytes.extend([0; 12]);
        // Two colours, where they are counted.
        bytes.extend(2_u32.to_le_bytes());
        bytes.extend([0; 4]);
        bytes.extend(extra);
        bytes.extend(pixels);
        bytes
    }

    fn shades(bytes: &[u8]) -> Vec<f64> {
        let raster = decode(bytes).expect("a valid bitmap");
        (0..raster.width * raster.height)
            .map(|i| raster.brightness(i))
            .collect()
    }

    const BLACK_AND_WHITE: [u8; 8] = [0, 0, 0, 0, 255, 255, 255, 0];

    #[test]
    fn every_depth_reads_the_same() {
        let expected = [0.0, 1.0];
        for (bits, compression, extra, pixels) in [
            (1, 0, &BLACK_AND_WHITE[..], &[0b0100_0000, 0, 0, 0][..]),
            (4, 0, &BLACK_AND_WHITE, &[0x01, 0, 0, 0]),
            (8, 0, &BLACK_AND_WHITE, &[0, 1, 0, 0]),
            (16, 0, &[], &[0, 0, 0xff, 0x7f]),
            (24, 0, &[], &[0, 0, 0, 255, 255, 255, 0, 0]),
            (32, 0, &[], &[0, 0, 0, 0, 255, 255, 255, 0]),
            (
                16,
                3,
                &[0, 0xf8, 0, 0, 0xe0, 0x07, 0, 0, 0x1f, 0, 0, 0],
                &[0, 0, 0xff, 0xff],
            ),
        ] {
            assert_eq!(
                shades(&bitmap([2, 1], bits, compression, extra, pixels)),
                expected,
                "{bits} bits, compression {compression}"
            );
        }
    }

    #[test]
    fn rows_run_upwards_unless_the_height_is_negative() {
        let pixels = [0, 0, 0, 0, 1, 0, 0, 0];
        assert_eq!(
            shades(&bitmap([1, 2], 8, 0, &BLACK_AND_WHITE, &pixels)),
            [1.0, 0.0]
        );
        assert_eq!(
            shades(&bitmap([1, -2], 8, 0, &BLACK_AND_WHITE, &pixels)),
            [0.0, 1.0]
        );
    }

    #[test]
    fn broken_bitmaps_are_refused() {
        for (bytes, expected) in [
            (b"BM".to_vec(), "ends after 2 bytes"),
            (bitmap([0, 1], 8, 0, &BLACK_AND_WHITE, &[]), "0 x 1 pixels"),
            (bitmap([-1, 1], 8, 0, &BLACK_AND_WHITE, &[]), "a width of -1"),
            (
                bitmap([2, 1], 8, 0, &BLACK_AND_WHITE, &[]),
                "0 bytes of pixels where 2 x 1 need 4",
            ),
            (
                bitmap([1, 1], 8, 0, &BLACK_AND_WHITE, &[7; 4]),
                "colour 7 of a palette of 2",
            ),
            (bitmap([1, 1], 8, 1, &BLACK_AND_WHITE, &[0; 4]), "compressed"),
            (bitmap([1, 1], 2, 0, &[], &[0; 4]), "2 bits per pixel"),
        ] {
            let error = decode(&bytes).expect_err("broken");
            assert!(error.contains(expected), "{error} should say {expected}");
        }
    }

    proptest! {
        #[test]
        fn no_bytes_panic(rest: Vec<u8>, bits: u16, compression in 0_u32..8, size: [i8; 2]) {
            drop(decode(&bitmap(size.map(i32::from), bits % 40, compression, &rest, &rest)));
        }
    }
}
