//! Publishes the pose to the car's own nodes: `nav_msgs/Odometry`, as a ROS 2 node with `rmw_zenoh` publishes it. A controller
//! uses it like that of any other localizer.
//!
//! Keys, attachment and liveliness tokens follow `rmw_zenoh`'s `design.md`. Nothing is published behind a bridge.

use std::thread::{self, JoinHandle};

use crossbeam_channel::{Receiver, Sender, bounded};
use synpf::Stamp;
use xxhash_rust::xxh3::xxh3_128;
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::Publisher;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::{Session, Wait};

use crate::ros2::messages::{self, Header, RosOdometry, RosPose, Vector3};
use crate::sensors::PoseEstimate;
use crate::sensors::clock::wall_now;

/// The name of our node in the ROS graph.
const NODE: &str = "synpf";
/// The type, as keys spell it.
const ODOMETRY: &str = "nav_msgs::msg::dds_::Odometry_";
/// Reliable, depth 10: the default of ROS nodes.
const QOS: &str = "::,10:,:,:,,";
/// Estimates that wait to be sent.
const QUEUE: usize = 8;

/// The connection to the ROS side, as discovered with the sensors.
#[derive(Debug, Clone)]
pub struct RosConnection {
    /// A session on its router.
    pub session: Session,
    /// `ROS_DOMAIN_ID`.
    pub domain: u32,
    /// The hash of `nav_msgs/Odometry`, which differs between distributions.
    pub odometry_hash: String,
    /// The frame that moves.
    pub base_link: String,
}

/// Declares the publisher and starts its thread, which ends when the sender is dropped.
pub fn start(
    connection: RosConnection,
    topic: &str,
) -> Result<(Sender<PoseEstimate>, JoinHandle<()>), zenoh::Error> {
    let name = topic.trim_matches('/');
    let hash = &connection.odometry_hash;
    let key = format!("{}/{name}/{ODOMETRY}/{hash}", connection.domain);
    let publisher = connection
        .session
        .declare_publisher(key)
        .congestion_control(CongestionControl::Drop)
        .priority(Priority::RealTime)
        .wait()?;
    let zid = connection.session.zid();
    let root = format!("@ros2_lv/{}/{zid}/0", connection.domain);
    let mangled = format!("%{}", name.replace('/', "%"));
    let node = format!("{root}/0/NN/%/%/{NODE}");
    let endpoint = format!("{root}/1/MP/%/%/{NODE}/{mangled}/{ODOMETRY}/{hash}/{QOS}");
    let gid = xxh3_128(endpoint.as_bytes()).to_le_bytes();
    let tokens = [node, endpoint]
        .into_iter()
        .map(|token| connection.session.liveliness().declare_token(token).wait())
        .collect::<Result<Vec<_>, _>>()?;
    let (sender, estimates) = bounded(QUEUE);
    let publisher = RosPublisher {
        publisher,
        gid,
        base_link: connection.base_link,
        _tokens: tokens,
    };
    let thread = thread::Builder::new()
        .name("ros-pose".into())
        .spawn(move || publisher.publish_all(&estimates))?;
    Ok((sender, thread))
}

struct RosPublisher {
    publisher: Publisher<'static>,
    gid: [u8; 16],
    base_link: String,
    /// Our node and its publisher, for `ros2 node list` and `ros2 topic list`.
    _tokens: Vec<LivelinessToken>,
}

impl RosPublisher {
    fn publish_all(&self, estimates: &Receiver<PoseEstimate>) {
        for (sequence, estimate) in (1..).zip(estimates) {
            let payload = match messages::encode(&self.message(&estimate)) {
                Ok(payload) => payload,
                Err(error) => {
                    tracing::warn!(%error, "the pose does not encode");
                    continue;
                }
            };
            let attachment = attachment(sequence, wall_now(), &self.gid);
            if let Err(error) = self.publisher.put(payload).attachment(attachment).wait() {
                tracing::debug!(%error, "the pose was not sent");
            }
        }
    }

    /// The message for an estimate. The covariances stay zero, which means unknown in ROS.
    fn message(&self, estimate: &PoseEstimate) -> RosOdometry {
        RosOdometry {
            header: Header {
                stamp: estimate.stamp.into(),
                frame_id: "map".into(),
            },
            child_frame_id: self.base_link.clone(),
            pose: RosPose::from(estimate.pose),
            linear: Vector3 {
                x: estimate.twist.linear_x,
                y: estimate.twist.linear_y,
                z: 0.0,
            },
            angular: Vector3 {
                z: estimate.twist.angular,
                ..Vector3::default()
            },
            ..RosOdometry::default()
        }
    }
}

/// The attachment that `rmw_zenoh` sends with each message: sequence number, time, and publisher; 33 bytes.
fn attachment(sequence: i64, sent: Stamp, gid: &[u8; 16]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(33);
    bytes.extend(sequence.to_le_bytes());
    bytes.extend(sent.0.to_le_bytes());
    bytes.push(gid.len() as u8);
    bytes.extend(gid);
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_attachment_equals_that_of_zenohs_serializer() {
        let gid = [7; 16];
        let ours = attachment(3, Stamp(1_700_000_000_000_000_001), &gid);
        let theirs = zenoh_ext::z_serialize(&(3_i64, 1_700_000_000_000_000_001_i64, gid.to_vec()));
        assert_eq!(ours, theirs.to_bytes().as_ref());
        assert_eq!(ours.len(), 33);
    }
}
