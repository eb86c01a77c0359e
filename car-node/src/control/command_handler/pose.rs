//! Commands about the pose: an initial pose, a search of the map, a candidate of that search.

use std::thread;
use std::time::{Duration, Instant};

use crossbeam_channel::bounded;
use maps::Pose;
use protocol::{Candidate, Command, EventKind, Outcome, RelocalizeAction, Reply};

use super::{CommandHandler, done, refused};
use crate::localization::filter_command::FilterCommand;
use crate::wire;

/// The filter is asked for candidates again after this time.
const SEARCH_AGAIN: Duration = Duration::from_millis(50);
/// Candidates in an answer.
const MOST_CANDIDATES: usize = 10;

impl CommandHandler {
    pub(super) fn initialize(&mut self, command: &Command, pose: Pose) -> Outcome {
        let (reply, replied) = bounded(1);
        let before = self.current_pose().map(wire::pose2);
        match self
            .send_to_filter(FilterCommand::Initialize { pose, reply }, &replied)
            .and_then(|taken| taken)
        {
            Ok(update) => {
                let pose = wire::pose2(pose);
                self.event(EventKind::PoseInitialized { before, pose }, Some(command));
                done(Some(update), Reply::Nothing)
            }
            Err(fault) => refused(fault),
        }
    }

    pub(super) fn relocalize(&mut self, command: &Command, action: RelocalizeAction) -> Outcome {
        match action {
            RelocalizeAction::Search => {
                let (reply, replied) = bounded(1);
                match self.send_to_filter(FilterCommand::Relocalize { reply }, &replied) {
                    Ok(update) => {
                        self.event(EventKind::SearchStarted, Some(command));
                        done(Some(update), Reply::Candidates(self.candidates()))
                    }
                    Err(fault) => refused(fault),
                }
            }
            RelocalizeAction::Pick { candidate } => {
                let (reply, replied) = bounded(1);
                let select = FilterCommand::SelectCandidate {
                    number: candidate as usize,
                    reply,
                };
                match self
                    .send_to_filter(select, &replied)
                    .and_then(|selected| selected)
                {
                    Ok((update, pose)) => {
                        let pose = wire::pose2(pose);
                        self.event(EventKind::Relocalized { pose }, Some(command));
                        done(Some(update), Reply::Nothing)
                    }
                    Err(fault) => refused(fault),
                }
            }
        }
    }

    /// The candidates that the search finds within the search patience. Empty if there are none by then, or if one
    /// candidate has won at once.
    fn candidates(&self) -> Vec<Candidate> {
        let until = Instant::now() + self.config.search_patience;
        while Instant::now() < until {
            let (reply, replied) = bounded(1);
            match self.send_to_filter(FilterCommand::Candidates { reply }, &replied) {
                Ok(found) if !found.is_empty() => {
                    return found
                        .iter()
                        .take(MOST_CANDIDATES)
                        .enumerate()
                        .map(|(index, hypothesis)| wire::candidate(index, hypothesis))
                        .collect();
                }
                Ok(_) => thread::sleep(SEARCH_AGAIN),
                Err(_) => break,
            }
        }
        Vec::new()
    }
}
