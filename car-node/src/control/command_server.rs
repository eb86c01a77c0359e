//! The thread that receives commands off the network, checks who sent them, has the [`CommandHandler`] execute them, and
//! replies.

use std::thread::{self, JoinHandle};
use std::time::Duration;

use crossbeam_channel::{Receiver, select};
use keys::Verifier;
use zenoh::Wait;

use super::command_handler::{CommandHandler, CommandHandlerConfig};
use super::local_commands::LocalRequest;
use super::request::Request;

/// The interval at which the handler checks its deadlines.
const TICK: Duration = Duration::from_millis(50);

/// Starts the thread. With a verifier only signed commands are executed. It ends when `stop` is dropped.
pub fn start(
    config: CommandHandlerConfig,
    verifier: Option<Verifier>,
    requests: Receiver<Request>,
    mut local: Receiver<LocalRequest>,
    stop: Receiver<()>,
) -> std::io::Result<JoinHandle<()>> {
    thread::Builder::new()
        .name("command-server".into())
        .spawn(move || {
            let run_id = config.run_id;
            let mut handler = CommandHandler::new(config);
            loop {
                select! {
                    recv(stop) -> _ => return,
                    recv(requests) -> request => match request {
                        Ok(request) => serve(&mut handler, verifier.as_ref(), run_id, &request),
                        Err(_) => return,
                    },
                    recv(local) -> request => match request {
                        Ok(LocalRequest { topic, payload, reply }) => {
                            // Who has stopped waiting does not need the answer.
                            reply.send(handler.answer(topic, Some(&payload))).ok();
                        }
                        Err(_) => local = crossbeam_channel::never(),
                    },
                    default(TICK) => {}
                }
                handler.tick();
            }
        })
}

fn serve(handler: &mut CommandHandler, verifier: Option<&Verifier>, run_id: u64, request: &Request) {
    let Request { topic, query } = request;
    let payload = query.payload().map(|payload| payload.to_bytes());
    // A wildcard would reach every car at once.
    let answer = if query.key_expr().is_wild() {
        let error = "a command needs the key of one car, without wildcards";
        Err(handler.count_unreadable(*topic, error.into()))
    } else {
        let signer = verifier.map(|verifier| {
            let signature = query.attachment().map(|attachment| attachment.to_bytes());
            let command = payload.as_deref().unwrap_or_default();
            verifier.check(signature.as_deref(), query.key_expr().as_str(), run_id, command)
        });
        handler.answer_signed(*topic, payload.as_deref(), signer.transpose())
    };
    let sent = match answer {
        Ok(bytes) => query.reply(query.key_expr().clone(), bytes).wait(),
        Err(error) => query.reply_err(error).wait(),
    };
    if let Err(error) = sent {
        // The sender sees that no answer came, and repeats the command under the same id.
        tracing::debug!(%error, "the reply could not be sent");
    }
}
