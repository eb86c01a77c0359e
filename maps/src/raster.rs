//! A decoded map image.

/// Larger images are refused. 64 Mi cells are a square of 400 m at 5 cm, larger than a race track.
const MAX_PIXELS: u64 = 1 << 26;

/// A decoded image: interleaved samples, row by row from the top.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Raster {
    pub(crate) width: usize,
    pub(crate) height: usize,
    /// Samples per pixel: 1 grey, 2 grey and alpha, 3 red-green-blue, 4 with alpha.
    pub(crate) channels: usize,
    /// The sample that means full brightness, or opaque.
    pub(crate) white: u16,
    pub(crate) samples: Vec<u16>,
}

impl Raster {
    /// Mean brightness of the colour channels of pixel `index`, in \[0, 1\].
    pub(crate) fn brightness(&self, index: usize) -> f64 {
        let pixel = self.pixel(index);
        self.mean(&pixel[..self.colours()])
    }

    /// Brightness in \[0, 1\] as `map_server` computes it in trinary mode: a transparent pixel's alpha counts as one
    /// more colour, and a grey pixel counts as red, green and blue.
    ///
    /// The alpha of an opaque pixel is left out here. `map_server` counts it, and so reads the unknown grey 205 of an
    /// image with an alpha channel as free space.
    pub(crate) fn brightness_with_alpha(&self, index: usize) -> f64 {
        if self.opaque(index) {
            return self.brightness(index);
        }
        match self.pixel(index) {
            &[grey, alpha] => self.mean(&[grey, grey, grey, alpha]),
            pixel => self.mean(pixel),
        }
    }

    /// False where the image is (partly) transparent.
    pub(crate) fn opaque(&self, index: usize) -> bool {
        self.pixel(index)[self.colours()..]
            .iter()
            .all(|&alpha| alpha == self.white)
    }

    fn pixel(&self, index: usize) -> &[u16] {
        &self.samples[index * self.channels..(index + 1) * self.channels]
    }

    fn colours(&self) -> usize {
        if self.channels < 3 { 1 } else { 3 }
    }

    fn mean(&self, samples: &[u16]) -> f64 {
        let sum: f64 = samples.iter().map(|&v| f64::from(v)).sum();
        sum / (samples.len() as f64 * f64::from(self.white))
    }
}

/// Refuses images without pixels and images that are too large.
pub(crate) fn check_size(width: u64, height: u64) -> Result<(), String> {
    if width == 0 || height == 0 {
        Err(format!("the image is {width} x {height} pixels"))
    } else if width.saturating_mul(height) > MAX_PIXELS {
        Err(format!(
            "the image is {width} x {height} pixels; at most {MAX_PIXELS} are read"
        ))
    } else {
        Ok(())
    }
}
