//! Portable grey maps (PGM), as netpbm describes them: P2 in text, P5 in bytes.

use crate::raster::{Raster, check_size};

/// Reads magic, width, height, white, then samples. `#` starts a comment.
pub(crate) fn decode(bytes: &[u8]) -> Result<Raster, String> {
    let mut header = PgmTokens { bytes, at: 2 };
    let width = header.number("width")?;
    let height = header.number("height")?;
    let white = header.number("maximum grey value")?;
    check_size(width, height)?;
    if !(1..=65535).contains(&white) {
        return Err(format!("maximum grey value {white} is not in 1..=65535"));
    }
    let pixels = (width * height) as usize;
    let samples: Vec<u16> = if bytes[1] == b'2' {
        let mut samples = Vec::with_capacity(pixels.min(bytes.len()));
        for _ in 0..pixels {
            samples.push(header.number("grey value")?.min(white) as u16);
        }
        samples
    } else {
        // One white space character ends the header.
        let data = bytes.get(header.at + 1..).unwrap_or_default();
        let needed = pixels * if white > 255 { 2 } else { 1 };
        let data = data.get(..needed).ok_or_else(|| {
            format!(
                "{} bytes of pixels where {width} x {height} need {needed}",
                data.len()
            )
        })?;
        if white > 255 {
            let wide = data.chunks_exact(2).map(|b| u16::from_be_bytes([b[0], b[1]]));
            wide.map(|v| v.min(white as u16)).collect()
        } else {
            data.iter().map(|&b| u16::from(b).min(white as u16)).collect()
        }
    };
    Ok(Raster {
        width: width as usize,
        height: height as usize,
        channels: 1,
        white: white as u16,
        samples,
    })
}

struct PgmTokens<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl PgmTokens<'_> {
    /// The next number, after white space and comments.
    fn number(&mut self, what: &str) -> Result<u64, String> {
        let mut comment = false;
        while let Some(&byte) = self.bytes.get(self.at) {
            match byte {
                b'#' => comment = true,
                b'\n' | b'\r' => comment = false,
                byte if comment || byte.is_ascii_whitespace() => {}
                _ => break,
            }
            self.at += 1;
        }
        let start = self.at;
        while self.bytes.get(self.at).is_some_and(u8::is_ascii_digit) {
            self.at += 1;
        }
        let digits = &self.bytes[start..self.at];
        str::from_utf8(digits)
            .ok()
            .and_then(|text| text.parse().ok())
            .ok_or_else(|| format!("no {what} at byte {start} of the PGM"))
    }
}
