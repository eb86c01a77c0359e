//! Why there is no connection.

/// Why a connection cannot be opened or used.
#[derive(Debug, thiserror::Error)]
pub enum ConnectionError {
    /// zenoh refuses a setting.
    #[error("network setting {key} = {value}: {reason}")]
    Config {
        /// The setting.
        key: &'static str,
        /// The value.
        value: String,
        /// zenoh's message.
        reason: String,
    },
    /// Nothing answers at the address, or the port is taken.
    #[error("{attempt}: {reason}")]
    Open {
        /// What failed, for the user.
        attempt: String,
        /// zenoh's message.
        reason: String,
    },
    /// The keys cannot be used. The message holds no secret.
    #[error("the keys cannot be used: {0}")]
    Keys(String),
    /// An endpoint does not fit the keys, or would be open to everybody.
    #[error("{0}")]
    Endpoint(String),
    /// The system cannot start a thread.
    #[error("cannot start the thread that decodes messages: {0}")]
    Thread(std::io::Error),
    /// A subscription failed.
    #[error("cannot subscribe to {key}: {reason}")]
    Subscribe {
        /// The key expression.
        key: String,
        /// zenoh's message.
        reason: String,
    },
}

impl ConnectionError {
    pub(super) fn subscribe(key: &str, error: &zenoh::Error) -> Self {
        Self::Subscribe {
            key: key.to_owned(),
            reason: reason(error),
        }
    }
}

/// zenoh's message without the places in its source.
pub(super) fn reason(error: &zenoh::Error) -> String {
    let text = error.to_string();
    let mut message = String::new();
    let mut rest = text.as_str();
    while let Some((before, place)) = rest.split_once(" at /")
        && let Some((_, after)) = place.split_once(".rs:")
    {
        message += before;
        let after = after.trim_start_matches(|c: char| c.is_ascii_digit());
        rest = after.strip_prefix('.').unwrap_or(after);
    }
    message + rest
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_in_source_are_left_out() {
        let error = |text: &'static str| -> zenoh::Error { text.into() };
        for (from_zenoh, shown) in [
            (
                "no listener: [in use at /a/b.rs:61.] at /c/d.rs:338.",
                "no listener: [in use]",
            ),
            ("Timeout! at /a/b.rs:7", "Timeout!"),
            ("looked at /etc", "looked at /etc"),
        ] {
            assert_eq!(reason(&error(from_zenoh)), shown);
        }
    }
}
