//! This node in the ROS graph: keys, liveliness tokens, attachments and publishers, without ROS.
//!
//! `rmw_zenoh` names a topic `<domain>/<topic>/<type>/<hash>`, announces every node and endpoint by a liveliness token, and sends 33 bytes
//! beside each message (its `design.md`). A zenoh-bridge-ros2dds names a topic `<topic>`; a plain put on that key reaches DDS. Bridges announce
//! topics and services to each other by tokens of their own, and this node announces its own in the same way, so that they are listed in DDS.

use std::sync::atomic::{AtomicU32, Ordering};

use serde::Serialize;
use synpf::Stamp;
use xxhash_rust::xxh3::xxh3_128;
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::Publisher;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::{Session, Wait};
use zenoh_ext::{AdvancedPublisher, AdvancedPublisherBuilderExt, CacheConfig};

use super::messages;
use super::types::{NO_HASH, ODOMETRY, RosType};
use crate::sensors::clock::wall_now;

/// How the ROS side names its topics.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Naming {
    /// `rmw_zenoh`.
    RmwZenoh {
        /// `ROS_DOMAIN_ID`.
        domain: u32,
        /// The hash of `nav_msgs/msg/Odometry` there, which differs between distributions.
        odometry_hash: String,
    },
    /// A zenoh-bridge-ros2dds.
    Bridge,
}

impl Naming {
    /// The hash of a type on the ROS side.
    fn hash(&self, ros_type: RosType) -> &str {
        match self {
            Self::RmwZenoh { odometry_hash, .. } if odometry_hash == NO_HASH || ros_type == ODOMETRY => {
                odometry_hash
            }
            _ => ros_type.hash,
        }
    }

    /// The key of a topic or a service.
    pub fn key(&self, topic: &str, ros_type: RosType) -> String {
        let name = topic.trim_matches('/');
        match self {
            Self::RmwZenoh { domain, .. } => {
                format!("{domain}/{name}/{}/{}", ros_type.dds, self.hash(ros_type))
            }
            Self::Bridge => name.to_owned(),
        }
    }
}

/// What a token announces.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EndpointKind {
    /// A publisher.
    Publisher,
    /// A subscriber.
    Subscriber,
    /// The server of a service.
    Service,
}

impl EndpointKind {
    fn letters(self) -> &'static str {
        match self {
            Self::Publisher => "MP",
            Self::Subscriber => "MS",
            Self::Service => "SS",
        }
    }
}

/// Whether late subscribers get what was sent before, as for `/map`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Durability {
    /// They do not. Depth 10, the default of ROS nodes.
    Volatile,
    /// They get so many messages: transient local.
    Latched(usize),
}

impl Durability {
    /// The quality of service as a token spells it: reliable, durability, keep last, depth.
    fn qos(self) -> String {
        match self {
            Self::Volatile => "::,10:,:,:,,".to_owned(),
            Self::Latched(depth) => format!(":1:,{depth}:,:,:,,"),
        }
    }

    /// The same as a bridge's token spells it, with DDS's numbers, and the type's hash as DDS carries it.
    fn bridged_qos(self, hash: &str) -> String {
        let (durability, depth) = match self {
            Self::Volatile => (0, 10),
            Self::Latched(depth) => (1, depth),
        };
        format!(":1:{durability}:0,{depth}:typehash={hash};{OWN_MARK}")
    }
}

/// Tells the tokens of a car-node from those of a bridge.
const OWN_MARK: &str = "node=synpf;";

/// Our node's name in the ROS graph.
pub const NODE: &str = "synpf";

/// A name with its slashes replaced, as tokens have it.
fn mangled(name: &str) -> String {
    name.replace('/', "%")
}

/// The same in a bridge's tokens.
fn bridge_mangled(name: &str) -> String {
    name.trim_matches('/').replace('/', "§")
}

/// This node in the ROS graph, with its token.
#[derive(Debug)]
pub struct RosNode {
    session: Session,
    naming: Naming,
    namespace: String,
    next_id: AtomicU32,
    /// Announces the node until it is dropped.
    token: Option<LivelinessToken>,
}

/// An endpoint's token, and its identity in attachments, which only `rmw_zenoh` has.
pub struct Announced {
    gid: Option<[u8; 16]>,
    _token: Option<LivelinessToken>,
}

impl RosNode {
    /// Announces the node in `namespace`: empty, or with a leading slash.
    pub fn announce(session: &Session, naming: Naming, namespace: &str) -> zenoh::Result<Self> {
        let mut node = Self {
            session: session.clone(),
            naming,
            namespace: namespace.to_owned(),
            next_id: AtomicU32::new(1),
            token: None,
        };
        if let Some(root) = node.token_root() {
            let token = format!("{root}/0/NN/%/{}/{NODE}", node.token_namespace());
            node.token = Some(session.liveliness().declare_token(token).wait()?);
        }
        Ok(node)
    }

    /// The node's full name: `/car1/synpf`.
    pub fn full_name(&self) -> String {
        format!("{}/{NODE}", self.namespace)
    }

    /// How the ROS side names its topics.
    pub fn naming(&self) -> &Naming {
        &self.naming
    }

    /// The session on the ROS side.
    pub fn session(&self) -> &Session {
        &self.session
    }

    fn token_root(&self) -> Option<String> {
        match &self.naming {
            Naming::RmwZenoh { domain, .. } => Some(format!("@ros2_lv/{domain}/{}/0", self.session.zid())),
            Naming::Bridge => None,
        }
    }

    fn token_namespace(&self) -> String {
        if self.namespace.is_empty() {
            "%".to_owned()
        } else {
            mangled(&self.namespace)
        }
    }

    /// Announces an endpoint of this node.
    pub fn announce_endpoint(
        &self,
        kind: EndpointKind,
        topic: &str,
        ros_type: RosType,
        durability: Durability,
    ) -> zenoh::Result<Announced> {
        let Some(root) = self.token_root() else {
            let token = bridge_token(&self.session.zid().to_string(), kind, topic, ros_type, durability);
            let token = self.session.liveliness().declare_token(token).wait()?;
            return Ok(Announced {
                gid: None,
                _token: Some(token),
            });
        };
        let token = format!(
            "{root}/{}/{}/%/{}/{NODE}/{}/{}/{}/{}",
            self.next_id.fetch_add(1, Ordering::Relaxed),
            kind.letters(),
            self.token_namespace(),
            mangled(&format!("/{}", topic.trim_matches('/'))),
            ros_type.dds,
            self.naming.hash(ros_type),
            durability.qos(),
        );
        let gid = xxh3_128(token.as_bytes()).to_le_bytes();
        let token = self.session.liveliness().declare_token(token).wait()?;
        Ok(Announced {
            gid: Some(gid),
            _token: Some(token),
        })
    }

    /// The tokens of all publishers of a topic.
    pub fn tokens_of_publishers(&self, topic: &str, ros_type: RosType) -> String {
        match &self.naming {
            Naming::RmwZenoh { domain, .. } => format!(
                "@ros2_lv/{domain}/*/*/*/MP/*/*/*/%{}/{}/*/*",
                mangled(topic.trim_matches('/')),
                ros_type.dds
            ),
            Naming::Bridge => format!("@/*/@ros2_lv/MP/{}/**", bridge_mangled(topic)),
        }
    }

    /// True for the token of a publisher that this node leaves a topic to: one of another node. Of two car-nodes, the one with the greater
    /// session number leaves it.
    pub fn yields_to(&self, token: &str) -> bool {
        let (place, ours) = match &self.naming {
            Naming::RmwZenoh { .. } => (2, token.split('/').nth(8) == Some(NODE)),
            Naming::Bridge => (1, token.ends_with(OWN_MARK)),
        };
        let own = self.session.zid().to_string();
        token
            .split('/')
            .nth(place)
            .is_some_and(|zid| if ours { zid < own.as_str() } else { zid != own })
    }

    /// A publisher on a topic, announced.
    pub fn publisher(
        &self,
        topic: &str,
        ros_type: RosType,
        durability: Durability,
    ) -> zenoh::Result<RosPublisher> {
        let publisher = self
            .session
            .declare_publisher(self.naming.key(topic, ros_type))
            .congestion_control(CongestionControl::Drop)
            .priority(Priority::RealTime);
        let publisher = match durability {
            Durability::Volatile => AnyPublisher::Plain(publisher.wait()?),
            Durability::Latched(depth) => AnyPublisher::Latched(
                publisher
                    .cache(CacheConfig::default().max_samples(depth))
                    .publisher_detection()
                    .wait()?,
            ),
        };
        let announced = self.announce_endpoint(EndpointKind::Publisher, topic, ros_type, durability)?;
        Ok(RosPublisher {
            publisher,
            announced,
            sequence: 0,
            topic: topic.to_owned(),
        })
    }
}

impl Announced {
    /// The attachment to message or reply number `sequence`; None behind a bridge.
    pub fn attachment(&self, sequence: i64) -> Option<Vec<u8>> {
        self.gid.map(|gid| attachment(sequence, wall_now(), &gid))
    }
}

/// The token by which a bridge with this session number would announce an endpoint.
fn bridge_token(
    zid: &str,
    kind: EndpointKind,
    topic: &str,
    ros_type: RosType,
    durability: Durability,
) -> String {
    let letters = kind.letters();
    let topic = bridge_mangled(topic);
    let name = bridge_mangled(&ros_type.name());
    match kind {
        EndpointKind::Service => format!("@/{zid}/@ros2_lv/{letters}/{topic}/{name}"),
        EndpointKind::Publisher | EndpointKind::Subscriber => {
            let qos = durability.bridged_qos(ros_type.hash);
            format!("@/{zid}/@ros2_lv/{letters}/{topic}/{name}/{qos}")
        }
    }
}

enum AnyPublisher {
    Plain(Publisher<'static>),
    Latched(AdvancedPublisher<'static>),
}

/// A publisher of one topic.
pub struct RosPublisher {
    publisher: AnyPublisher,
    announced: Announced,
    sequence: i64,
    topic: String,
}

impl RosPublisher {
    /// Publishes a message. One that cannot be sent is dropped, as ROS does.
    pub fn publish<T: Serialize>(&mut self, message: &T) {
        self.sequence += 1;
        let payload = match messages::encode(message) {
            Ok(payload) => payload,
            Err(error) => {
                tracing::warn!(topic = self.topic, %error, "a message does not encode");
                return;
            }
        };
        let attachment = self.announced.attachment(self.sequence);
        let sent = match &self.publisher {
            AnyPublisher::Plain(publisher) => publisher.put(payload).attachment(attachment).wait(),
            AnyPublisher::Latched(publisher) => publisher.put(payload).attachment(attachment).wait(),
        };
        if let Err(error) = sent {
            tracing::debug!(topic = self.topic, %error, "a message was not sent");
        }
    }
}

/// Numbers of subscribers begin here; those of other endpoints are smaller.
const FIRST_SUBSCRIBER: usize = 1000;

/// The token of a subscriber of this node: best effort, depth 10, as for sensor data. The place is its domain, namespace and number.
pub fn token_of_subscriber(
    session: &Session,
    (domain, namespace, number): (u32, &str, usize),
    topic: &str,
    dds: &str,
    hash: &str,
) -> String {
    let namespace = if namespace.is_empty() {
        "%".to_owned()
    } else {
        mangled(namespace)
    };
    format!(
        "@ros2_lv/{domain}/{}/0/{}/MS/%/{namespace}/{NODE}/{}/{dds}/{hash}/2::,10:,:,:,,",
        session.zid(),
        FIRST_SUBSCRIBER + number,
        mangled(topic),
    )
}

/// Bytes that `rmw_zenoh` sends beside each message, request and reply.
pub const ATTACHMENT_LENGTH: usize = 33;

/// What `rmw_zenoh` sends beside each message: sequence number, time, and publisher.
fn attachment(sequence: i64, sent: Stamp, gid: &[u8; 16]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(ATTACHMENT_LENGTH);
    bytes.extend(sequence.to_le_bytes());
    bytes.extend(sent.0.to_le_bytes());
    bytes.push(gid.len() as u8);
    bytes.extend(gid);
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros2::types::POSE_STAMPED;

    #[test]
    fn an_attachment_equals_that_of_zenohs_serializer() {
        let gid = [7; 16];
        let ours = attachment(3, Stamp(1_700_000_000_000_000_001), &gid);
        let theirs = zenoh_ext::z_serialize(&(3_i64, 1_700_000_000_000_000_001_i64, gid.to_vec()));
        assert_eq!(ours, theirs.to_bytes().as_ref());
        assert_eq!(ours.len(), ATTACHMENT_LENGTH);
    }

    #[test]
    fn tokens_for_a_bridge_are_as_bridges_write_them() {
        let qos = format!("typehash={};node=synpf;", POSE_STAMPED.hash);
        assert_eq!(
            bridge_token(
                "ab1",
                EndpointKind::Publisher,
                "/car1/tracked_pose",
                POSE_STAMPED,
                Durability::Volatile
            ),
            format!("@/ab1/@ros2_lv/MP/car1§tracked_pose/geometry_msgs§msg§PoseStamped/:1:0:0,10:{qos}")
        );
        assert_eq!(
            bridge_token(
                "ab1",
                EndpointKind::Service,
                "/synpf/get",
                crate::ros2::types::EMPTY,
                Durability::Volatile
            ),
            "@/ab1/@ros2_lv/SS/synpf§get/std_srvs§srv§Empty"
        );
        assert!(Durability::Latched(1).bridged_qos("h").starts_with(":1:1:0,1:"));
    }

    #[test]
    fn keys_have_the_hash_of_the_distribution() {
        let jazzy = Naming::RmwZenoh {
            domain: 7,
            odometry_hash: ODOMETRY.hash.into(),
        };
        let expected = format!(
            "7/car1/tracked_pose/geometry_msgs::msg::dds_::PoseStamped_/{}",
            POSE_STAMPED.hash
        );
        assert_eq!(jazzy.key("/car1/tracked_pose", POSE_STAMPED), expected);
        let humble = Naming::RmwZenoh {
            domain: 0,
            odometry_hash: NO_HASH.into(),
        };
        assert!(humble.key("/tf", POSE_STAMPED).ends_with("/TypeHashNotSupported"));
        assert_eq!(Naming::Bridge.key("/car1/tf", POSE_STAMPED), "car1/tf");
    }
}
