//! The operators of all open pages.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use protocol::plain_text;

/// The operators, one for each open page.
#[derive(Debug, Clone, Default)]
pub(super) struct Operators(Arc<Mutex<Pages>>);

#[derive(Debug, Default)]
struct Pages {
    next: u64,
    names: BTreeMap<u64, String>,
}

/// An open page. Dropping it removes its operator.
pub(super) struct OpenPage {
    pages: Arc<Mutex<Pages>>,
    number: u64,
}

impl Operators {
    /// Most open pages.
    const MOST: usize = 100;

    /// Adds a page. None when too many are open.
    pub(super) fn open_page(&self) -> Option<OpenPage> {
        let mut pages = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if pages.names.len() >= Self::MOST {
            return None;
        }
        pages.next += 1;
        let number = pages.next;
        pages.names.insert(number, String::new());
        Some(OpenPage {
            pages: self.0.clone(),
            number,
        })
    }

    /// The operator of each page, in the order in which the pages were opened. Empty for a page that has not sent a name.
    pub(super) fn names(&self) -> Vec<String> {
        let pages = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        pages.names.values().cloned().collect()
    }
}

impl OpenPage {
    /// Sets the operator of this page.
    pub(super) fn set_operator(&self, name: &str) {
        let mut pages = self.pages.lock().unwrap_or_else(PoisonError::into_inner);
        pages.names.insert(self.number, plain_text(name).into_owned());
    }
}

impl Drop for OpenPage {
    fn drop(&mut self) {
        let mut pages = self.pages.lock().unwrap_or_else(PoisonError::into_inner);
        pages.names.remove(&self.number);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_closed_page_is_off_the_list() {
        let operators = Operators::default();
        let open = || operators.open_page().expect("few are open");
        let (ana, ben) = (open(), open());
        ana.set_operator("ana");
        ben.set_operator("ben");
        assert_eq!(operators.names(), ["ana", "ben"]);
        drop(ana);
        assert_eq!(operators.names(), ["ben"]);
        let others: Vec<_> = (0..2 * Operators::MOST)
            .filter_map(|_| operators.open_page())
            .collect();
        assert_eq!(others.len(), Operators::MOST - 1);
    }
}
