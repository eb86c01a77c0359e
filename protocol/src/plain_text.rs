//! Text from the network, made safe to show.

use std::borrow::Cow;

/// Replaces every character that could change how a terminal or a page shows the text around it: control characters (escape
/// codes, line ends), marks that reverse the direction of writing, and invisible characters. Each becomes U+FFFD.
///
/// Markup is not touched: a terminal has none, and the page inserts text as text.
///
/// ```
/// assert_eq!(protocol::plain_text("lap 3: 12.5 s"), "lap 3: 12.5 s");
/// assert_eq!(protocol::plain_text("\u{1b}]0;title\u{7}"), "\u{fffd}]0;title\u{fffd}");
/// ```
pub fn plain_text(text: &str) -> Cow<'_, str> {
    if text.chars().any(unsafe_to_show) {
        let replaced = text
            .chars()
            .map(|c| if unsafe_to_show(c) { '\u{fffd}' } else { c });
        Cow::Owned(replaced.collect())
    } else {
        Cow::Borrowed(text)
    }
}

fn unsafe_to_show(c: char) -> bool {
    c.is_control()
        || matches!(
            c,
            '\u{ad}'
                | '\u{61c}'
                | '\u{180e}'
                // Zero width, direction of writing, line and paragraph separators, invisible operators, isolates.
                | '\u{200b}'..='\u{200f}'
                | '\u{2028}'..='\u{202e}'
                | '\u{2060}'..='\u{206f}'
                | '\u{fe00}'..='\u{fe0f}'
                | '\u{feff}'
                | '\u{fff9}'..='\u{fffb}'
                // Tags and variation selectors, which nothing shows.
                | '\u{e0000}'..='\u{e0fff}'
        )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_hidden_passes() {
        for text in [
            "\u{1b}[2J",
            "\u{9b}31m",
            "a\nb",
            "a\r",
            "\u{202e}evil",
            "\u{2066}x\u{2069}",
            "zero\u{200b}width",
            "\u{feff}",
            "\u{e0041}",
            "\0",
        ] {
            let plain = plain_text(text);
            assert!(!plain.chars().any(unsafe_to_show), "{text:?}");
            assert_eq!(plain.chars().count(), text.chars().count());
        }
    }

    #[test]
    fn readable_text_is_left_alone() {
        for text in ["", "Zürich", "速度 12 m/s", "±3 °", "مرحبا", "<b>&amp;"] {
            assert!(
                matches!(plain_text(text), Cow::Borrowed(same) if same == text),
                "{text}"
            );
        }
    }
}
