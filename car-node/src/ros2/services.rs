//! The services of this node: its parameters, as every ROS node has them, and AMCL's `/reinitialize_global_localization`.
//!
//! With `rmw_zenoh` a service is a queryable on `<domain>/<service>/<type>/<hash>`. Request and reply are CDR; the attachment of
//! the request comes back with the reply. Behind a zenoh-bridge-ros2dds it is a queryable on `<service>`, with the same CDR; the bridge keeps
//! what identifies the request. The parameters are those of the set in force, and `set`, its name. A change goes the
//! way of a pit wall's command: it is checked, shown and recorded like any other.

use std::thread::{self, JoinHandle};

use crossbeam_channel::{Receiver, Sender, TrySendError, bounded};
use protocol::{Action, Outcome, ParameterSet, ParamsAction, RelocalizeAction, Value};
use serde::Serialize;
use zenoh::Wait;
use zenoh::query::{Query, Queryable};

use super::graph::{ATTACHMENT_LENGTH, Announced, Durability, EndpointKind, RosNode, RosPublisher};
use super::messages::{CdrError, decode, encode};
use super::output_publisher::RosConnection;
use super::parameter_messages::{
    ListReply, ListRequest, Names, Parameter, ParameterDescriptor, ParameterEvent, ParameterValue,
    Parameters, SetResult, kind_of,
};
use super::types::{self, RosType};
use crate::control::LocalCommands;
use crate::sensors::clock::wall_now;

/// Requests that wait.
const QUEUE: usize = 32;
/// Who gives the commands that come from ROS.
const OPERATOR: &str = "ros";
/// A set that ships cannot be changed. Values that are set from ROS go into the set of this name.
const SET: &str = "ros";
/// The parameter that names the set in force.
const SET_NAME: &str = "set";
/// More parameters are not set in one request.
const MOST_PARAMETERS: usize = ParameterSet::MAX_VALUES;

/// A service.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Service {
    List,
    Get,
    Types,
    Describe,
    Set,
    SetAtomically,
    Relocalize,
}

impl Service {
    const ALL: [Self; 7] = [
        Self::List,
        Self::Get,
        Self::Types,
        Self::Describe,
        Self::Set,
        Self::SetAtomically,
        Self::Relocalize,
    ];

    fn name_and_type(self, node: &str, namespace: &str) -> (String, RosType) {
        let (name, ros_type) = match self {
            Self::List => ("list_parameters", types::LIST_PARAMETERS),
            Self::Get => ("get_parameters", types::GET_PARAMETERS),
            Self::Types => ("get_parameter_types", types::GET_PARAMETER_TYPES),
            Self::Describe => ("describe_parameters", types::DESCRIBE_PARAMETERS),
            Self::Set => ("set_parameters", types::SET_PARAMETERS),
            Self::SetAtomically => ("set_parameters_atomically", types::SET_PARAMETERS_ATOMICALLY),
            Self::Relocalize => {
                return (
                    format!("{namespace}/reinitialize_global_localization"),
                    types::EMPTY,
                );
            }
        };
        (format!("{node}/{name}"), ros_type)
    }
}

/// Starts the services. Their thread ends when `stop` is dropped.
pub fn start(
    connection: &RosConnection,
    node: &RosNode,
    commands: LocalCommands,
    stop: Receiver<()>,
) -> zenoh::Result<JoinHandle<()>> {
    let (sender, requests) = bounded(QUEUE);
    let full_name = node.full_name();
    let mut endpoints = Vec::new();
    for service in Service::ALL {
        let (name, ros_type) = service.name_and_type(&full_name, &connection.namespace);
        endpoints.push(serve(node, service, &name, ros_type, &sender)?);
    }
    let events = node.publisher("/parameter_events", types::PARAMETER_EVENT, Durability::Volatile)?;
    let mut server = Server {
        commands,
        events,
        node: full_name,
    };
    let thread = thread::Builder::new()
        .name("ros-services".into())
        .spawn(move || {
            let _endpoints = endpoints;
            loop {
                crossbeam_channel::select! {
                    recv(stop) -> _ => return,
                    recv(requests) -> request => match request {
                        Ok((service, query)) => server.answer(service, &query),
                        Err(_) => return,
                    },
                }
            }
        })?;
    Ok(thread)
}

/// Declares a service. zenoh's thread only queues the request.
fn serve(
    node: &RosNode,
    service: Service,
    name: &str,
    ros_type: RosType,
    requests: &Sender<(Service, Query)>,
) -> zenoh::Result<(Queryable<()>, Announced)> {
    let requests = requests.clone();
    let queryable = node
        .session()
        .declare_queryable(node.naming().key(name, ros_type))
        .complete(true)
        .callback(move |query| {
            if let Err(TrySendError::Full(_)) = requests.try_send((service, query)) {
                tracing::warn!(?service, "too many requests from ROS at once");
            }
        })
        .wait()?;
    let announced = node.announce_endpoint(EndpointKind::Service, name, ros_type, Durability::Volatile)?;
    Ok((queryable, announced))
}

struct Server {
    commands: LocalCommands,
    events: RosPublisher,
    node: String,
}

/// The set in force.
struct InForce {
    name: String,
    values: Vec<(String, Value)>,
}

impl InForce {
    /// A parameter's value.
    fn get(&self, name: &str) -> Option<Value> {
        if name == SET_NAME {
            return Some(Value::Text(self.name.clone()));
        }
        self.values
            .iter()
            .find(|(key, _)| key == name)
            .map(|(_, value)| value.clone())
    }

    /// The names of all parameters.
    fn names(&self) -> Vec<String> {
        std::iter::once(SET_NAME.to_owned())
            .chain(self.values.iter().map(|(key, _)| key.clone()))
            .collect()
    }
}

impl Server {
    fn answer(&mut self, service: Service, query: &Query) {
        let payload = query
            .payload()
            .map(|payload| payload.to_bytes().into_owned())
            .unwrap_or_default();
        let reply = match self.reply(service, &payload) {
            Ok(reply) => reply,
            Err(error) => {
                tracing::warn!(?service, error, "a request from ROS cannot be answered");
                return;
            }
        };
        // The sender finds its request by the number and the identity that it sent along. A bridge's attachment has no time.
        let attachment = query.attachment().map(|bytes| {
            let mut bytes = bytes.to_bytes().into_owned();
            if bytes.len() == ATTACHMENT_LENGTH {
                bytes[8..16].copy_from_slice(&wall_now().0.to_le_bytes());
            }
            bytes
        });
        let sent = query
            .reply(query.key_expr().clone(), reply)
            .attachment(attachment)
            .wait();
        if let Err(error) = sent {
            tracing::debug!(%error, "a reply to ROS was not sent");
        }
    }

    fn reply(&mut self, service: Service, payload: &[u8]) -> Result<Vec<u8>, String> {
        let names = || {
            decode::<Names>(payload)
                .map(|request| request.names)
                .map_err(text)
        };
        match service {
            Service::Relocalize => {
                let search = Action::Relocalize(RelocalizeAction::Search);
                if let Outcome::Refused { faults } = self.commands.send(search, OPERATOR)?.outcome {
                    return Err(faults.join("; "));
                }
                // An empty message holds one byte.
                encoded(&0_u8)
            }
            Service::List => {
                let request: ListRequest = decode(payload).map_err(text)?;
                let under = |name: &String| {
                    let prefixes = &request.prefixes;
                    prefixes.is_empty() || prefixes.iter().any(|prefix| name == prefix)
                };
                encoded(&ListReply {
                    names: self.in_force()?.names().into_iter().filter(under).collect(),
                    prefixes: Vec::new(),
                })
            }
            Service::Get => {
                let set = self.in_force()?;
                let value = |name: &String| {
                    set.get(name)
                        .as_ref()
                        .map(ParameterValue::from)
                        .unwrap_or_default()
                };
                encoded(&names()?.iter().map(value).collect::<Vec<_>>())
            }
            Service::Types => {
                let set = self.in_force()?;
                let kind = |name: &String| set.get(name).as_ref().map_or(0, kind_of);
                encoded(&names()?.iter().map(kind).collect::<Vec<_>>())
            }
            Service::Describe => {
                let set = self.in_force()?;
                let describe = |name: &String| ParameterDescriptor {
                    name: name.clone(),
                    kind: set.get(name).as_ref().map_or(0, kind_of),
                    description: if name == SET_NAME {
                        "The parameter set in force; another name puts that set in force.".to_owned()
                    } else {
                        format!("See docs/localizer.md. A change goes into the set {SET:?}.")
                    },
                    ..ParameterDescriptor::default()
                };
                encoded(&names()?.iter().map(describe).collect::<Vec<_>>())
            }
            Service::Set => {
                let request: Parameters = decode(payload).map_err(text)?;
                let result = self.set(&request.parameters)?;
                encoded(&vec![result; request.parameters.len()])
            }
            Service::SetAtomically => {
                let request: Parameters = decode(payload).map_err(text)?;
                encoded(&self.set(&request.parameters)?)
            }
        }
    }

    fn in_force(&self) -> Result<InForce, String> {
        let answer = self.commands.send(Action::Params(ParamsAction::List), OPERATOR)?;
        let name = answer.set.name;
        let Outcome::Done {
            reply: protocol::Reply::Sets(sets),
            ..
        } = answer.outcome
        else {
            return Err("the sets are not known".into());
        };
        let values = sets
            .into_iter()
            .find(|stored| stored.set.name == name)
            .map(|stored| stored.set.values)
            .unwrap_or_default();
        Ok(InForce { name, values })
    }

    /// Sets parameters, all of them or none.
    fn set(&mut self, parameters: &[Parameter]) -> Result<SetResult, String> {
        let before = self.in_force()?;
        let action = match change(&before, parameters) {
            Ok(action) => action,
            Err(reason) => return Ok(refused(reason)),
        };
        let Some(action) = action else {
            return Ok(done());
        };
        match self.commands.send(Action::Params(action), OPERATOR)?.outcome {
            Outcome::Done { .. } => {}
            Outcome::Refused { faults } => return Ok(refused(faults.join("; "))),
            Outcome::StaleRevision { who, .. } => {
                return Ok(refused(format!("{who} has just changed the set")));
            }
        }
        let after = self.in_force()?;
        let changed = after
            .names()
            .into_iter()
            .filter_map(|name| {
                let value = after.get(&name)?;
                (before.get(&name).as_ref() != Some(&value)).then(|| Parameter {
                    value: ParameterValue::from(&value),
                    name,
                })
            })
            .collect();
        self.events.publish(&ParameterEvent {
            stamp: wall_now().into(),
            node: self.node.clone(),
            changed_parameters: changed,
            ..ParameterEvent::default()
        });
        Ok(done())
    }
}

/// What a request to set parameters changes; None when it asks for what is in force.
fn change(set: &InForce, parameters: &[Parameter]) -> Result<Option<ParamsAction>, String> {
    if parameters.len() > MOST_PARAMETERS {
        return Err(format!(
            "{} parameters at once; at most {MOST_PARAMETERS}",
            parameters.len()
        ));
    }
    let mut values: Vec<(String, Value)> = Vec::new();
    let mut selected = None;
    for Parameter { name, value } in parameters {
        let now = set
            .get(name)
            .ok_or_else(|| format!("there is no parameter {name}"))?;
        let value = match (value.value(), &now) {
            // `ros2 param set` sends 1 for 1.0.
            (Some(Value::Int(value)), Value::Float(_)) => Value::Float(value as f64),
            (Some(value), now) if kind_of(&value) == kind_of(now) => value,
            _ => return Err(format!("{name}: a value like {now} is needed")),
        };
        if let (true, Value::Text(wanted)) = (name == SET_NAME, &value) {
            selected = (value != now).then(|| wanted.clone());
        } else if value != now {
            values.retain(|(key, _)| key != name);
            values.push((name.clone(), value));
        }
    }
    match (selected, values.is_empty()) {
        (Some(_), false) => Err(format!("{SET_NAME} cannot be set together with other parameters")),
        (Some(name), true) => Ok(Some(ParamsAction::Select {
            name,
            revert_after_ms: None,
        })),
        (None, true) => Ok(None),
        (None, false) => Ok(Some(ParamsAction::Put {
            set: ParameterSet {
                name: SET.into(),
                values,
            },
            revert_after_ms: None,
        })),
    }
}

fn done() -> SetResult {
    SetResult {
        successful: true,
        reason: String::new(),
    }
}

fn refused(reason: String) -> SetResult {
    SetResult {
        successful: false,
        reason,
    }
}

fn encoded<T: Serialize>(message: &T) -> Result<Vec<u8>, String> {
    encode(message).map_err(text)
}

#[expect(clippy::needless_pass_by_value, reason = "an argument of `map_err`")]
fn text(error: CdrError) -> String {
    error.to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parameter(name: &str, value: &Value) -> Parameter {
        Parameter {
            name: name.into(),
            value: ParameterValue::from(value),
        }
    }

    #[test]
    fn a_change_is_checked_against_the_set_in_force() {
        let set = InForce {
            name: "hq".into(),
            values: vec![
                ("sigma".into(), Value::Float(0.1)),
                ("refine".into(), Value::Bool(true)),
            ],
        };
        let put = |parameters: &[Parameter]| match change(&set, parameters) {
            Ok(Some(ParamsAction::Put { set, .. })) => Some(set.values),
            _ => None,
        };
        let sigma = Value::Float(1.0);
        assert_eq!(
            put(&[parameter("sigma", &Value::Int(1))]),
            Some(vec![("sigma".into(), sigma)])
        );
        assert_eq!(change(&set, &[parameter("sigma", &Value::Float(0.1))]), Ok(None));
        let select = change(&set, &[parameter("set", &Value::Text("lq".into()))]);
        assert!(matches!(select, Ok(Some(ParamsAction::Select { name, .. })) if name == "lq"));
        for bad in [
            parameter("sigma", &Value::Text("wide".into())),
            parameter("none", &Value::Int(1)),
            parameter("set", &Value::Int(1)),
            Parameter {
                name: "sigma".into(),
                ..Parameter::default()
            },
        ] {
            assert!(change(&set, std::slice::from_ref(&bad)).is_err(), "{bad:?}");
        }
        let both = [
            parameter("set", &Value::Text("lq".into())),
            parameter("refine", &Value::Bool(false)),
        ];
        assert!(change(&set, &both).is_err());
        assert!(change(&set, &vec![parameter("sigma", &Value::Int(1)); 1000]).is_err());
    }
}
