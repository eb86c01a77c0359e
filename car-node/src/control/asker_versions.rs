//! Compares the versions of the pit walls that connect with the car's own.

/// Longest version that is read \[bytes\].
const LONGEST: usize = 64;
/// Versions that are remembered. More are not named.
const MOST: usize = 16;

/// The versions of other programs that were named already. Pure.
#[derive(Debug, Default)]
pub(crate) struct AskerVersions {
    said: Vec<String>,
}

impl AskerVersions {
    /// What to tell about a pit wall of `version` (UTF-8), once for each version. None when it is the same as `own`.
    pub(crate) fn note(&mut self, version: &[u8], own: &str) -> Option<String> {
        let version = std::str::from_utf8(version).ok()?;
        let known = version == own || self.said.iter().any(|said| said == version);
        if known || !is_version(version) || self.said.len() >= MOST {
            return None;
        }
        self.said.push(version.to_owned());
        Some(format!(
            "a pit wall of version {version} is connected, this car runs {own}: update the older one before the race"
        ))
    }
}

/// True for a text such as `0.3.0-beta.1`.
fn is_version(text: &str) -> bool {
    let allowed = |c: char| c.is_ascii_alphanumeric() || ".+-".contains(c);
    text.len() <= LONGEST && text.starts_with(|c: char| c.is_ascii_digit()) && text.chars().all(allowed)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn another_version_is_named_once() {
        let mut versions = AskerVersions::default();
        assert_eq!(versions.note(b"0.3.0", "0.3.0"), None);
        assert_eq!(versions.note(b"", "0.3.0"), None);
        let note = versions.note(b"0.2.0", "0.3.0").expect("another version");
        assert!(
            note.starts_with("a pit wall of version 0.2.0 is connected, this car runs 0.3.0"),
            "{note}"
        );
        assert_eq!(versions.note(b"0.2.0", "0.3.0"), None);
        assert!(versions.note(b"0.4.0", "0.3.0").is_some());
    }

    #[test]
    fn what_a_stranger_sends_is_bounded() {
        let mut versions = AskerVersions::default();
        assert_eq!(versions.note(&[0xff; 8], "0.3.0"), None);
        assert_eq!(versions.note(&[b'1'; 65], "0.3.0"), None);
        for text in ["1\u{1b}]0;x", "SYPF", "1 2"] {
            assert_eq!(versions.note(text.as_bytes(), "0.3.0"), None, "{text:?}");
        }
        let said = (0..1000)
            .filter(|n| versions.note(n.to_string().as_bytes(), "0.3.0").is_some())
            .count();
        assert_eq!(said, MOST);
    }
}
