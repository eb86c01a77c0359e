//! Separates a new contact from one that continues.

use std::time::Duration;

/// A contact ends when nothing was touched for this long.
const CONTACT_ENDS: Duration = Duration::from_millis(500);

/// When a car last touched something.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct ContactTimer {
    last: Option<Duration>,
}

impl ContactTimer {
    /// Records a touch at `now`. True if it begins a new contact.
    pub(crate) fn begins(&mut self, now: Duration) -> bool {
        let new = self.last.is_none_or(|last| now > last + CONTACT_ENDS);
        self.last = Some(now);
        new
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scraping_along_a_wall_is_one_contact() {
        let mut timer = ContactTimer::default();
        let begins = [0, 10, 400, 800, 1400].map(|ms| timer.begins(Duration::from_millis(ms)));
        assert_eq!(begins, [true, false, false, false, true]);
    }
}
