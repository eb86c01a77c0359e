//! Commands from inside the node, such as from a ROS service. They go the way of those from a pit wall.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use crossbeam_channel::{Receiver, Sender, bounded};
use protocol::{Action, Answer, Command, CommandId, Stamps, Topic, decode, encode};

use crate::sensors::clock::wall_now;

/// A command, encoded, and where its answer goes.
#[derive(Debug)]
pub struct LocalRequest {
    /// The topic that it belongs to.
    pub(super) topic: Topic,
    /// The command.
    pub(super) payload: Vec<u8>,
    /// Takes the answer.
    pub(super) reply: Sender<Result<Vec<u8>, String>>,
}

/// The answer to a search takes longest.
const PATIENCE: Duration = Duration::from_secs(5);
/// Commands that wait.
const QUEUE: usize = 8;

/// Gives commands to the command server.
#[derive(Debug, Clone)]
pub struct LocalCommands {
    requests: Sender<LocalRequest>,
    /// Ids: this run, and a number.
    run_id: u64,
    number: Arc<AtomicU64>,
}

impl LocalCommands {
    /// The sender, and what the command server receives from.
    pub fn new(run_id: u64) -> (Self, Receiver<LocalRequest>) {
        let (requests, receiver) = bounded(QUEUE);
        let commands = Self {
            requests,
            run_id,
            number: Arc::default(),
        };
        (commands, receiver)
    }

    /// Has a command executed, and waits for its answer.
    pub fn send(&self, action: Action, operator: &str) -> Result<Answer, String> {
        let number = self.number.fetch_add(1, Ordering::Relaxed) + 1;
        let topic = action.topic();
        let command = Command {
            id: CommandId(u128::from(self.run_id) << 64 | u128::from(number)),
            operator: operator.into(),
            expected_revision: None,
            action,
        };
        let now = wall_now().0;
        let stamps = Stamps {
            run_id: self.run_id,
            sequence: number,
            sensor: now,
            published: now,
        };
        let payload = encode(&command, stamps).map_err(|error| error.to_string())?;
        let (reply, answer) = bounded(1);
        let request = LocalRequest {
            topic,
            payload,
            reply,
        };
        self.requests
            .send_timeout(request, PATIENCE)
            .map_err(|_| "the node takes no commands".to_owned())?;
        let answer = answer
            .recv_timeout(PATIENCE)
            .map_err(|_| format!("no answer within {} s", PATIENCE.as_secs()))??;
        decode::<Answer>(&answer)
            .map(|(_, answer)| answer)
            .map_err(|error| error.to_string())
    }
}
