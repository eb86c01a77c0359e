//! Who looks at a page.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

/// Everybody with a page open.
#[derive(Debug, Clone, Default)]
pub(super) struct Present(Arc<Mutex<Book>>);

#[derive(Debug, Default)]
struct Book {
    next: u64,
    names: BTreeMap<u64, String>,
}

/// One page. Dropping it takes its name off the list.
pub(super) struct Visitor {
    book: Arc<Mutex<Book>>,
    number: u64,
}

impl Present {
    /// Somebody has opened a page.
    pub(super) fn enter(&self) -> Visitor {
        let mut book = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        book.next += 1;
        let number = book.next;
        book.names.insert(number, String::new());
        Visitor {
            book: self.0.clone(),
            number,
        }
    }

    /// A name for each page, in the order in which they were opened; empty for one that has not said.
    pub(super) fn names(&self) -> Vec<String> {
        let book = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        book.names.values().cloned().collect()
    }
}

impl Visitor {
    /// Who it is.
    pub(super) fn is(&self, name: String) {
        let mut book = self.book.lock().unwrap_or_else(PoisonError::into_inner);
        book.names.insert(self.number, name);
    }
}

impl Drop for Visitor {
    fn drop(&mut self) {
        let mut book = self.book.lock().unwrap_or_else(PoisonError::into_inner);
        book.names.remove(&self.number);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_leaves_is_off_the_list() {
        let present = Present::default();
        let (ana, ben) = (present.enter(), present.enter());
        ana.is("ana".into());
        ben.is("ben".into());
        assert_eq!(present.names(), ["ana", "ben"]);
        drop(ana);
        assert_eq!(present.names(), ["ben"]);
    }
}
