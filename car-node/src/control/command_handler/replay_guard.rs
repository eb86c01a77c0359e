//! Refuses signed commands that were recorded and are sent again.
//!
//! The answer cache holds the latest commands: a copy of one of those gets the same answer. Everything older than what the
//! cache has dropped is refused, by the signer's own clock. A signature is for one run of the car, so that nothing needs to
//! outlive a restart.

use std::collections::{BTreeMap, VecDeque};

use protocol::CommandId;

/// Commands that are remembered; no more than the answer cache holds.
const MOST: usize = 512;

/// The commands of this run that were accepted.
#[derive(Debug, Default)]
pub(super) struct ReplayGuard {
    recent: VecDeque<(CommandId, String, i64)>,
    /// When each signer sent the newest command that is not remembered any more \[unix ns\].
    forgotten: BTreeMap<String, i64>,
}

impl ReplayGuard {
    /// Accepts a new command, or one that is remembered. `sent` is the time in its header.
    pub(super) fn check(&mut self, signer: &str, id: CommandId, sent: i64) -> Result<(), String> {
        if self.recent.iter().any(|(known, _, _)| *known == id) {
            return Ok(());
        }
        if self.forgotten.get(signer).is_some_and(|newest| sent <= *newest) {
            return Err(format!(
                "the command is older than others of {signer} that were executed: it was recorded and sent again, or \
                 {signer}'s clock was set back"
            ));
        }
        if self.recent.len() >= MOST
            && let Some((_, signer, sent)) = self.recent.pop_front()
        {
            let newest = self.forgotten.entry(signer).or_insert(sent);
            *newest = (*newest).max(sent);
        }
        self.recent.push_back((id, signer.to_owned(), sent));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_recorded_command_does_not_pass_again() {
        let mut guard = ReplayGuard::default();
        let most = MOST as i64;
        for sent in 0..=most {
            guard.check("laptop", CommandId(sent as u128), sent).expect("new");
        }
        // Number 0 is forgotten, the others are remembered.
        assert!(guard.check("laptop", CommandId(0), 0).is_err());
        assert!(guard.check("laptop", CommandId(1), 1).is_ok());
        // Another signer's clock may be behind.
        assert!(guard.check("tablet", CommandId(9999), -5).is_ok());
        assert!(guard.check("laptop", CommandId(9998), most + 1).is_ok());
    }
}
