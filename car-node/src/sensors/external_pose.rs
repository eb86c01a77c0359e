//! The poses of another localizer, as ROS has them: `nav_msgs/Odometry`, `geometry_msgs/PoseStamped`,
//! `geometry_msgs/PoseWithCovarianceStamped`, or a transform from `map` on `/tf`.

use nalgebra::Matrix3;
use synpf::{ExternalPose, PoseOf};

use crate::ros2::messages::{
    self, CdrError, Covariance, Header, PoseStamped, PoseWithCovarianceStamped, RosOdometry, RosPose,
    TfMessage,
};
use crate::sensors::frames::is_base;

/// A message of any of these types.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum PoseMessage {
    Odometry(Box<RosOdometry>),
    Stamped(PoseStamped),
    WithCovariance(Box<PoseWithCovarianceStamped>),
    Transforms(TfMessage),
}

impl PoseMessage {
    /// Decodes a message of unknown type: the one that it has the length of.
    pub(crate) fn decode(payload: &[u8]) -> Result<Self, CdrError> {
        if let Ok(message) = messages::decode_whole(payload) {
            return Ok(Self::Odometry(Box::new(message)));
        }
        if let Ok(message) = messages::decode_whole(payload) {
            return Ok(Self::WithCovariance(Box::new(message)));
        }
        if let Ok(message) = messages::decode_whole(payload) {
            return Ok(Self::Stamped(message));
        }
        messages::decode_whole(payload).map(Self::Transforms)
    }
}

/// The frame that poses are in.
const MAP: &str = "map";
/// A larger variance is none [m^2], [rad^2].
const LARGEST: f64 = 1e4;

/// The car's frames, as its messages name them.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(crate) struct PoseFrames {
    /// The frame of the scans.
    pub(crate) laser: String,
    /// The frame that odometry's poses are in.
    pub(crate) odom: String,
    /// What the poses are of, whatever the messages say.
    pub(crate) of: Option<PoseOf>,
}

impl PoseFrames {
    /// The pose in a message; None in transforms without one.
    pub(crate) fn pose_of(&self, message: &PoseMessage) -> Result<Option<ExternalPose>, String> {
        Ok(match message {
            PoseMessage::Odometry(message) => Some(self.odometry(message)?),
            PoseMessage::Stamped(message) => Some(self.pose_stamped(message)?),
            PoseMessage::WithCovariance(message) => Some(self.with_covariance(message)?),
            PoseMessage::Transforms(message) => self.transform(message),
        })
    }

    pub(crate) fn odometry(&self, message: &RosOdometry) -> Result<ExternalPose, String> {
        let laser = bare(&message.child_frame_id) == bare(&self.laser);
        let of = if laser { PoseOf::Laser } else { PoseOf::BaseLink };
        self.pose(&message.header, &message.pose, Some(&message.pose_covariance), of)
    }

    pub(crate) fn pose_stamped(&self, message: &PoseStamped) -> Result<ExternalPose, String> {
        self.pose(&message.header, &message.pose, None, PoseOf::BaseLink)
    }

    pub(crate) fn with_covariance(
        &self,
        message: &PoseWithCovarianceStamped,
    ) -> Result<ExternalPose, String> {
        self.pose(
            &message.header,
            &message.pose,
            Some(&message.covariance),
            PoseOf::BaseLink,
        )
    }

    /// The transform from `map` to the car's frame, to odometry's or to the laser's, if the message has one.
    pub(crate) fn transform(&self, message: &TfMessage) -> Option<ExternalPose> {
        message.transforms.iter().find_map(|transform| {
            let child = bare(&transform.child_frame_id);
            let of = if child == bare(&self.odom) {
                PoseOf::Odometry
            } else if child == bare(&self.laser) {
                PoseOf::Laser
            } else if is_base(child) {
                PoseOf::BaseLink
            } else {
                return None;
            };
            self.pose(&transform.header, &transform.transform, None, of).ok()
        })
    }

    fn pose(
        &self,
        header: &Header,
        pose: &RosPose,
        covariance: Option<&Covariance>,
        of: PoseOf,
    ) -> Result<ExternalPose, String> {
        if bare(&header.frame_id) != MAP {
            return Err(format!("its frame is {:?} and not {MAP:?}", header.frame_id));
        }
        Ok(ExternalPose {
            stamp: header.stamp.into(),
            pose: pose.planar(),
            // A transform to odometry's frame is nothing else.
            of: self.of.filter(|_| of != PoseOf::Odometry).unwrap_or(of),
            covariance: covariance.and_then(planar),
        })
    }
}

/// A frame without slashes in front and without its namespace.
fn bare(frame: &str) -> &str {
    frame.rsplit('/').next().unwrap_or(frame)
}

/// The part on the ground plane; None for one that was never filled in.
fn planar(covariance: &Covariance) -> Option<Matrix3<f64>> {
    let index = [0, 1, 5];
    let planar = Matrix3::from_fn(|row, column| covariance[index[row]][index[column]]);
    let stated = (0..3).all(|i| planar[(i, i)] > 0.0 && planar[(i, i)] < LARGEST);
    (stated && planar.iter().all(|v| v.is_finite())).then(|| (planar + planar.transpose()) / 2.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros2::messages::TransformStamped;
    use maps::Pose;

    fn frames() -> PoseFrames {
        PoseFrames {
            laser: "laser".into(),
            odom: "odom".into(),
            of: None,
        }
    }

    fn header(frame: &str) -> Header {
        Header {
            frame_id: frame.into(),
            ..Header::default()
        }
    }

    #[test]
    fn the_messages_say_what_a_pose_is_of() {
        let mut odometry = RosOdometry {
            header: header("/map"),
            child_frame_id: "car/laser".into(),
            pose: Pose::new(1.0, 2.0, 0.5).into(),
            ..RosOdometry::default()
        };
        let pose = frames().odometry(&odometry).expect("in map");
        assert_eq!((pose.of, pose.covariance), (PoseOf::Laser, None));
        for i in [0, 1, 5] {
            odometry.pose_covariance[i][i] = 0.04;
        }
        odometry.child_frame_id = "base_link".into();
        let pose = frames().odometry(&odometry).expect("in map");
        assert_eq!(pose.of, PoseOf::BaseLink);
        assert!((pose.covariance.expect("stated")[(2, 2)] - 0.04).abs() < 1e-12);
        let of_laser = PoseFrames {
            of: Some(PoseOf::Laser),
            ..frames()
        };
        assert_eq!(of_laser.odometry(&odometry).expect("in map").of, PoseOf::Laser);
        odometry.header = header("odom");
        assert!(frames().odometry(&odometry).expect_err("odom").contains("odom"));
    }

    #[test]
    fn a_message_of_unknown_type_is_known_by_its_length() {
        let odometry = RosOdometry {
            header: header("map"),
            child_frame_id: "base_link".into(),
            ..RosOdometry::default()
        };
        let stamped = PoseStamped {
            header: header("map"),
            ..PoseStamped::default()
        };
        let with_covariance = PoseWithCovarianceStamped {
            header: header("map"),
            ..PoseWithCovarianceStamped::default()
        };
        let transforms = TfMessage {
            transforms: vec![TransformStamped::default(); 2],
        };
        let decode = |bytes: Vec<u8>| PoseMessage::decode(&bytes).expect("a message");
        let bytes = messages::encode(&odometry).expect("encodes");
        assert_eq!(decode(bytes), PoseMessage::Odometry(Box::new(odometry)));
        let bytes = messages::encode(&stamped).expect("encodes");
        assert_eq!(decode(bytes), PoseMessage::Stamped(stamped));
        let bytes = messages::encode(&with_covariance).expect("encodes");
        assert_eq!(
            decode(bytes),
            PoseMessage::WithCovariance(Box::new(with_covariance))
        );
        let bytes = messages::encode(&transforms).expect("encodes");
        assert_eq!(decode(bytes), PoseMessage::Transforms(transforms));
        assert!(PoseMessage::decode(&[0, 1, 0, 0, 9]).is_err());
    }

    #[test]
    fn a_transform_from_map_to_any_of_the_cars_frames_is_a_pose() {
        let of = |parent: &str, child: &str| {
            let transform = TransformStamped {
                header: header(parent),
                child_frame_id: child.into(),
                transform: Pose::new(1.0, 0.0, 0.0).into(),
            };
            let message = TfMessage {
                transforms: vec![transform],
            };
            frames().transform(&message).map(|pose| pose.of)
        };
        assert_eq!(of("map", "odom"), Some(PoseOf::Odometry));
        assert_eq!(of("map", "base_footprint"), Some(PoseOf::BaseLink));
        assert_eq!(of("/map", "/laser"), Some(PoseOf::Laser));
        assert_eq!(of("odom", "base_link"), None);
        assert_eq!(of("map", "goal"), None);
    }
}
