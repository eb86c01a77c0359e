//! QR codes in the terminal, for a phone.

use anyhow::Context;
use qrcode::QrCode;
use qrcode::render::unicode::Dense1x2;

/// `text` as a QR code of half blocks. Its light modules are drawn, as most terminals are dark; phones read it on light ones, too.
pub(crate) fn draw(text: &str) -> anyhow::Result<String> {
    let code = QrCode::new(text).context("no QR code is as large as this address")?;
    Ok(code
        .render()
        .dark_color(Dense1x2::Light)
        .light_color(Dense1x2::Dark)
        .build())
}

#[cfg(test)]
mod tests {
    use qrcode::Color;

    use super::*;

    #[test]
    fn every_module_is_drawn_where_it_belongs() {
        let text = "https://192.168.1.10:7448/?token=0123456789abcdef0123456789abcdef";
        let modules = QrCode::new(text).expect("it fits");
        let drawn: Vec<Vec<bool>> = draw(text)
            .expect("it fits")
            .lines()
            .flat_map(|line| {
                let halves = |upper: &str| line.chars().map(|c| upper.contains(c)).collect();
                // Upper and lower half of each character; what is drawn is light.
                [halves("▀█"), halves("▄█")]
            })
            .collect();
        let quiet = 4;
        for y in 0..modules.width() {
            for x in 0..modules.width() {
                let light = modules[(x, y)] == Color::Light;
                assert_eq!(drawn[y + quiet][x + quiet], light, "{x} {y}");
            }
        }
        // The light margin belongs to the code.
        assert!(drawn[..quiet].iter().flatten().all(|light| *light));
        assert!(draw(&"x".repeat(5000)).is_err());
    }
}
