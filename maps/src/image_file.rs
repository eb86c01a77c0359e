//! Image files of maps: PNG of every colour type, PGM and BMP in; PNG out.

use std::io::Cursor;

use crate::raster::{Raster, check_size};
use crate::{MapError, bmp, pgm};

/// Decodes an image. Its first bytes say which format it has. `file` names it in errors.
pub(crate) fn decode(file: &str, bytes: &[u8]) -> Result<Raster, MapError> {
    match bytes {
        [0x89, b'P', b'N', b'G', ..] => decode_png(bytes),
        [b'P', b'2' | b'5', ..] => pgm::decode(bytes),
        [b'B', b'M', ..] => bmp::decode(bytes),
        _ => Err("not an image that can be read: PNG, PGM (P2 or P5) and BMP can".to_owned()),
    }
    .map_err(|fault| MapError::format(file, fault))
}

/// Encodes 8-bit grey pixels, row by row from the top, as PNG.
pub(crate) fn encode_png(width: usize, height: usize, grey: &[u8]) -> Vec<u8> {
    debug_assert_eq!(grey.len(), width * height);
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width as u32, height as u32);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(png::BitDepth::Eight);
    let written = encoder
        .write_header()
        .and_then(|mut writer| writer.write_image_data(grey));
    // Writing to memory fails only on a wrong buffer size, which the caller's types exclude.
    written.expect("a grid has at least one cell, and a pixel for each");
    bytes
}

fn decode_png(bytes: &[u8]) -> Result<Raster, String> {
    let mut decoder = png::Decoder::new(Cursor::new(bytes));
    // Palette, fewer than 8 bits and tRNS become plain 8-bit channels; 16 bits stay.
    decoder.set_transformations(png::Transformations::EXPAND);
    let info = decoder.read_header_info().map_err(|e| e.to_string())?;
    check_size(info.width.into(), info.height.into())?;
    let mut reader = decoder.read_info().map_err(|e| e.to_string())?;
    let size = reader
        .output_buffer_size()
        .ok_or_else(|| "the image does not fit in memory".to_owned())?;
    let mut buffer = vec![0; size];
    let info = reader.next_frame(&mut buffer).map_err(|e| e.to_string())?;
    let buffer = &buffer[..info.buffer_size()];
    let (white, samples) = if info.bit_depth == png::BitDepth::Sixteen {
        let wide = buffer.chunks_exact(2).map(|b| u16::from_be_bytes([b[0], b[1]]));
        (u16::MAX, wide.collect())
    } else {
        (255, buffer.iter().map(|&b| b.into()).collect())
    };
    Ok(Raster {
        width: info.width as usize,
        height: info.height as usize,
        channels: info.color_type.samples(),
        white,
        samples,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn encode(color: png::ColorType, depth: png::BitDepth, width: u32, data: &[u8]) -> Vec<u8> {
        let mut bytes = Vec::new();
        let mut encoder = png::Encoder::new(&mut bytes, width, 1);
        encoder.set_color(color);
        encoder.set_depth(depth);
        if color == png::ColorType::Indexed {
            encoder.set_palette(vec![0, 0, 0, 255, 255, 255, 205, 205, 205]);
        }
        encoder
            .write_header()
            .and_then(|mut writer| writer.write_image_data(data))
            .expect("a valid image");
        bytes
    }

    fn shades(bytes: &[u8]) -> Vec<f64> {
        let raster = decode("test", bytes).expect("a valid image");
        (0..raster.width * raster.height)
            .map(|i| raster.brightness(i))
            .collect()
    }

    #[test]
    fn every_png_colour_type_reads_the_same() {
        use png::{BitDepth, ColorType};
        let expected = [0.0, 1.0];
        for (color, depth, data) in [
            (ColorType::Grayscale, BitDepth::Eight, &[0, 255][..]),
            (ColorType::Grayscale, BitDepth::One, &[0b0100_0000]),
            (ColorType::Grayscale, BitDepth::Sixteen, &[0, 0, 255, 255]),
            (ColorType::GrayscaleAlpha, BitDepth::Eight, &[0, 255, 255, 255]),
            (ColorType::Rgb, BitDepth::Eight, &[0, 0, 0, 255, 255, 255]),
            (
                ColorType::Rgba,
                BitDepth::Eight,
                &[0, 0, 0, 255, 255, 255, 255, 0],
            ),
            (ColorType::Indexed, BitDepth::Eight, &[0, 1]),
            (ColorType::Indexed, BitDepth::Two, &[0b0001_0000]),
        ] {
            assert_eq!(
                shades(&encode(color, depth, 2, data)),
                expected,
                "{color:?} {depth:?}"
            );
        }
    }

    #[test]
    fn alpha_counts_as_a_colour_only_where_something_shows_through() {
        for (alpha, expected) in [(255, 0.0), (0, 0.0), (102, 0.1)] {
            let rgba = encode(png::ColorType::Rgba, png::BitDepth::Eight, 1, &[0, 0, 0, alpha]);
            let grey = encode(
                png::ColorType::GrayscaleAlpha,
                png::BitDepth::Eight,
                1,
                &[0, alpha],
            );
            for bytes in [rgba, grey] {
                let raster = decode("test", &bytes).expect("a valid image");
                assert!((raster.brightness(0) - 0.0).abs() < 1e-12);
                assert!((raster.brightness_with_alpha(0) - expected).abs() < 1e-12);
                assert_eq!(raster.opaque(0), alpha == 255);
            }
        }
    }

    #[test]
    fn pgm_in_text_and_binary() {
        assert_eq!(
            shades(b"P2 # made by hand\n2 2\n# white\n10\n0 5\n10 99\n"),
            [0.0, 0.5, 1.0, 1.0]
        );
        assert_eq!(shades(b"P5\n2 1\n255\n\x00\xff"), [0.0, 1.0]);
        assert_eq!(shades(b"P5 1 2 65535\n\x00\x00\xff\xff"), [0.0, 1.0]);
    }

    #[test]
    fn broken_images_say_what_is_wrong() {
        for (bytes, expected) in [
            (&b"GIF89a"[..], "not an image that can be read"),
            (b"", "not an image that can be read"),
            (b"P5 2 x 255\n", "no height"),
            (b"P5 0 2 255\n", "0 x 2 pixels"),
            (b"P5 2 2 255\n\x00", "1 bytes of pixels where 2 x 2 need 4"),
            (b"P5 2 2 70000\n", "not in 1..=65535"),
            (b"P5 99999999999 99999999999 255\n", "at most"),
            (b"P2 2 2 255\n0 0 0", "no grey value"),
            (b"\x89PNG\r\n\x1a\nrubbish", "x.pgm"),
        ] {
            let error = decode("x.pgm", bytes).expect_err("not an image");
            assert!(
                error.to_string().contains(expected),
                "{error} should say {expected}"
            );
        }
    }

    proptest! {
        #[test]
        fn what_is_encoded_reads_back(width in 1_usize..20, height in 1_usize..20, seed: u8) {
            let grey: Vec<u8> = (0..width * height).map(|i| (i as u8).wrapping_mul(seed)).collect();
            let raster = decode("test", &encode_png(width, height, &grey)).expect("just encoded");
            prop_assert_eq!((raster.width, raster.height), (width, height));
            for (i, &v) in grey.iter().enumerate() {
                prop_assert!((raster.brightness(i) - f64::from(v) / 255.0).abs() < 1e-12);
            }
        }

        #[test]
        fn no_bytes_panic(mut bytes: Vec<u8>, kind in 0_usize..3) {
            let magic: &[u8] = [&b"P5 "[..], b"P2 ", b"\x89PNG\r\n\x1a\n"][kind];
            bytes.splice(0..0, magic.iter().copied());
            drop(decode("test", &bytes));
        }
    }
}
