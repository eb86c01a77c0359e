//! Publishes to the car's own nodes what a localizer of a ROS 2 stack publishes: the pose in four forms, the transform from `map`
//! to `odom`, particles, the map, diagnostics and log messages.

use std::fmt::Write as _;
use std::sync::Arc;
use std::thread::{self, JoinHandle};

use crossbeam_channel::{Receiver, bounded, select};
use maps::{Cell, OccupancyGrid};
use nalgebra::Matrix3;
use protocol::{Severity, State};
use synpf::{Stamp, Twist};
use zenoh::Session;

use super::graph::{Durability, NODE, Naming, RosNode, RosPublisher};
use super::map_server::MapServer;
use super::messages::{
    Covariance, DiagnosticArray, DiagnosticStatus, Header, KeyValue, Log, PoseArray, PoseStamped,
    PoseWithCovarianceStamped, RosGrid, RosOdometry, RosPose, TfMessage, Time, TransformStamped, Vector3,
};
use super::output::{PoseOutput, RosOutput, RosSink};
use super::{topics, types};
use crate::sensors::clock::{StampShift, wall_now};
use crate::telemetry::queue::HealthReport;

/// The ROS side, as discovered with the sensors.
#[derive(Debug, Clone)]
pub struct RosConnection {
    /// A session on its router.
    pub session: Session,
    /// How it names its topics.
    pub naming: Naming,
    /// The car's namespace: empty, or with a leading slash.
    pub namespace: String,
    /// The frame of odometry's poses.
    pub odom: String,
    /// The frame that moves.
    pub base_link: String,
    /// From the filter's stamps to those of the sensors.
    pub shift: StampShift,
}

/// What to publish.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OutputOptions {
    /// Topic of the pose as `nav_msgs/msg/Odometry`; None for the usual name in the car's namespace.
    pub pose_topic: Option<String>,
    /// Publish the transform from `map` to `odom`.
    pub transform: bool,
}

impl Default for OutputOptions {
    fn default() -> Self {
        Self {
            pose_topic: None,
            transform: true,
        }
    }
}

/// Messages that wait to be sent.
const QUEUE: usize = 32;
/// Log messages that late subscribers get.
const LOGS_KEPT: usize = 16;

/// Standard deviation of odometry's velocities: a part of its own, and one of the speed. Measured slip is 2 to 10 %.
const SPEED_DEVIATION: [f64; 2] = [0.05, 0.05];
/// The same of the yaw rate [rad/s].
const TURN_DEVIATION: [f64; 2] = [0.05, 0.05];
/// Variance of what a car on the ground does not do: z, roll and pitch.
const ON_THE_GROUND: f64 = 1e-6;

impl RosConnection {
    /// Announces this node in the car's namespace.
    pub fn announce(&self) -> zenoh::Result<Arc<RosNode>> {
        RosNode::announce(&self.session, self.naming.clone(), &self.namespace).map(Arc::new)
    }
}

/// Declares the publishers and starts their thread, which ends when the sender is dropped. `car` is the name in diagnostics.
pub fn start(
    connection: &RosConnection,
    node: &Arc<RosNode>,
    options: &OutputOptions,
    car: &str,
    map: &OccupancyGrid,
) -> zenoh::Result<(RosSink, JoinHandle<()>)> {
    let in_namespace = |topic: &str| format!("{}{topic}", connection.namespace);
    let plain = |topic: &str, ros_type| node.publisher(topic, ros_type, Durability::Volatile);
    let pose_topic = options
        .pose_topic
        .clone()
        .unwrap_or_else(|| in_namespace(topics::POSE_ODOMETRY));
    let grid = grid_message(map, connection.shift.to_sensor(wall_now()));
    let map = MapServer::start(node, in_namespace(topics::MAP), grid)?;
    let publishers = Publishers {
        odometry: plain(&pose_topic, types::ODOMETRY)?,
        inferred: plain(&in_namespace(topics::INFERRED_POSE), types::POSE_STAMPED)?,
        tracked: plain(&in_namespace(topics::TRACKED_POSE), types::POSE_STAMPED)?,
        with_covariance: plain(
            &in_namespace(topics::POSE_WITH_COVARIANCE),
            types::POSE_WITH_COVARIANCE_STAMPED,
        )?,
        particles: plain(&in_namespace(topics::PARTICLES), types::POSE_ARRAY)?,
        transform: options
            .transform
            .then(|| plain(&in_namespace(topics::TRANSFORMS), types::TF_MESSAGE))
            .transpose()?,
        diagnostics: plain(topics::DIAGNOSTICS, types::DIAGNOSTIC_ARRAY)?,
        log: node.publisher(topics::LOG, types::LOG, Durability::Latched(LOGS_KEPT))?,
    };
    let worker = OutputPublisher {
        publishers,
        map,
        shift: connection.shift.clone(),
        odom: connection.odom.clone(),
        base_link: connection.base_link.clone(),
        car: car.to_owned(),
        last_log: None,
        node: Arc::clone(node),
    };
    let (sink, outputs) = bounded(QUEUE);
    let thread = thread::Builder::new()
        .name("ros-output".into())
        .spawn(move || worker.run(&outputs))?;
    Ok((sink, thread))
}

struct Publishers {
    odometry: RosPublisher,
    inferred: RosPublisher,
    tracked: RosPublisher,
    with_covariance: RosPublisher,
    particles: RosPublisher,
    transform: Option<RosPublisher>,
    diagnostics: RosPublisher,
    log: RosPublisher,
}

struct OutputPublisher {
    publishers: Publishers,
    map: MapServer,
    shift: StampShift,
    odom: String,
    base_link: String,
    car: String,
    /// The last log message, repeated in diagnostics.
    last_log: Option<String>,
    node: Arc<RosNode>,
}

impl OutputPublisher {
    fn run(mut self, outputs: &Receiver<RosOutput>) {
        loop {
            select! {
                recv(outputs) -> output => match output {
                    Ok(output) => self.publish(output),
                    Err(_) => return,
                },
                recv(self.map.changes()) -> _ => self.map.on_change(),
                recv(self.map.settled()) -> _ => if let Some(text) = self.map.on_settled() {
                    self.log(wall_now().into(), Severity::Info, text);
                },
            }
        }
    }

    fn publish(&mut self, output: RosOutput) {
        match output {
            RosOutput::Pose(pose) => self.pose(&pose),
            RosOutput::Particles { stamp, poses } => {
                let message = PoseArray {
                    header: self.header(stamp, "map"),
                    poses: poses.into_iter().map(RosPose::from).collect(),
                };
                self.publishers.particles.publish(&message);
            }
            RosOutput::Health(report) => {
                let message = DiagnosticArray {
                    header: self.header(report.stamp, ""),
                    status: vec![diagnosis(&report, &self.car, self.last_log.as_deref())],
                };
                self.publishers.diagnostics.publish(&message);
            }
            RosOutput::Log {
                stamp,
                severity,
                text,
            } => self.log(self.shift.to_sensor(stamp).into(), severity, text),
        }
    }

    fn log(&mut self, stamp: Time, severity: Severity, text: String) {
        let message = Log {
            stamp,
            level: log_level(severity),
            name: self.node.full_name().trim_matches('/').replace('/', "."),
            msg: text.clone(),
            ..Log::default()
        };
        self.publishers.log.publish(&message);
        self.last_log = Some(text);
    }

    fn header(&self, stamp: Stamp, frame: &str) -> Header {
        Header {
            stamp: self.shift.to_sensor(stamp).into(),
            frame_id: frame.to_owned(),
        }
    }

    fn pose(&mut self, output: &PoseOutput) {
        let PoseOutput {
            estimate,
            covariance,
            odometry,
        } = output;
        let header = self.header(estimate.stamp, "map");
        let pose = RosPose::from(estimate.pose);
        let with_covariance = PoseWithCovarianceStamped {
            header: header.clone(),
            pose,
            covariance: pose_covariance(covariance),
        };
        let Twist {
            linear_x,
            linear_y,
            angular,
        } = estimate.twist;
        // The transform first: it is what most nodes wait for.
        if let (Some(publisher), Some(odom_from_base_link)) = (&mut self.publishers.transform, odometry)
            && odom_from_base_link.is_finite()
        {
            let map_from_odom = estimate.pose * odom_from_base_link.inverse();
            let transform = TransformStamped {
                header: header.clone(),
                child_frame_id: self.odom.clone(),
                transform: map_from_odom.into(),
            };
            publisher.publish(&TfMessage {
                transforms: vec![transform],
            });
        }
        let odometry = RosOdometry {
            header: header.clone(),
            child_frame_id: self.base_link.clone(),
            pose,
            pose_covariance: with_covariance.covariance,
            linear: Vector3 {
                x: linear_x,
                y: linear_y,
                z: 0.0,
            },
            angular: Vector3 {
                z: angular,
                ..Vector3::default()
            },
            twist_covariance: twist_covariance(&estimate.twist),
        };
        self.publishers.odometry.publish(&odometry);
        let stamped = PoseStamped { header, pose };
        self.publishers.inferred.publish(&stamped);
        self.publishers.tracked.publish(&stamped);
        self.publishers.with_covariance.publish(&with_covariance);
    }
}

/// A covariance of x, y and heading as ROS has it.
fn pose_covariance(planar: &Matrix3<f64>) -> Covariance {
    let mut covariance = [[0.0; 6]; 6];
    let places = [0, 1, 5];
    for (i, row) in places.into_iter().enumerate() {
        for (j, column) in places.into_iter().enumerate() {
            covariance[row][column] = planar[(i, j)];
        }
    }
    on_the_ground(&mut covariance);
    covariance
}

/// Sets the variances of what a car on the ground does not do.
fn on_the_ground(covariance: &mut Covariance) {
    for (i, row) in covariance.iter_mut().enumerate().skip(2).take(3) {
        row[i] = ON_THE_GROUND;
    }
}

/// The covariance of a velocity: what wheels and gyroscopes of such cars have been seen to be off by.
fn twist_covariance(twist: &Twist) -> Covariance {
    let square = |[own, share]: [f64; 2], value: f64| (own + share * value.abs()).powi(2);
    let speed = twist.linear_x.hypot(twist.linear_y);
    let mut covariance = [[0.0; 6]; 6];
    covariance[0][0] = square(SPEED_DEVIATION, speed);
    covariance[1][1] = square(SPEED_DEVIATION, speed);
    covariance[5][5] = square(TURN_DEVIATION, twist.angular);
    on_the_ground(&mut covariance);
    covariance
}

/// The map as ROS has it.
fn grid_message(grid: &OccupancyGrid, stamp: Stamp) -> RosGrid {
    RosGrid {
        header: Header {
            stamp: stamp.into(),
            frame_id: "map".into(),
        },
        load_time: stamp.into(),
        resolution: grid.resolution as f32,
        width: u32::try_from(grid.width).unwrap_or(u32::MAX),
        height: u32::try_from(grid.height).unwrap_or(u32::MAX),
        origin: grid.origin.into(),
        data: grid
            .cells
            .iter()
            .map(|cell| match cell {
                Cell::Free => 0,
                Cell::Occupied => 100,
                Cell::Unknown => -1,
            })
            .collect(),
    }
}

/// Health in the form that `rqt_robot_monitor` and the diagnostic aggregator read.
fn diagnosis(report: &HealthReport, car: &str, last_log: Option<&str>) -> DiagnosticStatus {
    let verdict = &report.verdict;
    let level = match verdict.state {
        State::Localized => 0,
        State::Init | State::Converging | State::Degraded | State::Relocalizing => 1,
        State::Lost => 2,
        State::Stale => 3,
    };
    let mut message = verdict.state.to_string();
    for (index, cause) in verdict.causes.iter().enumerate() {
        // Writing to a string does not fail.
        write!(message, "{} {cause}", if index == 0 { ":" } else { "," }).ok();
    }
    let mut values = vec![("state", verdict.state.to_string())];
    values.extend(verdict.causes.iter().map(|cause| ("cause", cause.to_string())));
    if let Some(metrics) = &verdict.metrics {
        values.extend([
            ("alignment", format!("{:.3}", metrics.alignment)),
            ("residual [m]", format!("{:.3}", metrics.residual)),
            (
                "spread along the track [m]",
                format!("{:.3}", metrics.spread_along),
            ),
            (
                "spread across the track [m]",
                format!("{:.3}", metrics.spread_across),
            ),
            ("slip", format!("{:.3}", metrics.slip)),
            ("age of the pose, p99 [s]", format!("{:.3}", metrics.age_p99)),
            ("particles", metrics.particles.to_string()),
        ]);
    }
    values.push(("update", verdict.update.to_string()));
    if let Some(proposal) = &report.proposal {
        values.push(("proposed set", proposal.set.clone()));
    }
    if let Some(text) = last_log {
        values.push(("last message", text.to_owned()));
    }
    DiagnosticStatus {
        level,
        name: format!("{NODE}: localization"),
        message,
        hardware_id: car.to_owned(),
        values: values
            .into_iter()
            .map(|(key, value)| KeyValue {
                key: key.to_owned(),
                value,
            })
            .collect(),
    }
}

/// The level of `rcl_interfaces/msg/Log`.
fn log_level(severity: Severity) -> u8 {
    match severity {
        Severity::Info => 20,
        Severity::Warning => 30,
        Severity::Critical => 40,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::health::{Cause, CauseKind, Verdict};
    use maps::Pose;

    #[test]
    fn a_covariance_has_no_zero_on_its_diagonal() {
        let planar = Matrix3::new(0.01, 0.002, 0.0, 0.002, 0.02, 0.003, 0.0, 0.003, 0.04);
        let covariance = pose_covariance(&planar);
        assert!((covariance[5][1] - 0.003).abs() < 1e-12 && (covariance[0][1] - 0.002).abs() < 1e-12);
        let twist = twist_covariance(&Twist::default());
        assert!((0..6).all(|i| covariance[i][i] > 0.0 && twist[i][i] > 0.0));
    }

    #[test]
    fn the_map_is_published_row_by_row() {
        let cells = vec![Cell::Free, Cell::Occupied, Cell::Unknown, Cell::Free];
        let grid = OccupancyGrid::new(2, 2, 0.5, Pose::new(1.0, -2.0, 0.3), cells);
        let message = grid_message(&grid, Stamp(5));
        assert_eq!(message.data, [0, 100, -1, 0]);
        assert!((message.origin.planar().heading - 0.3).abs() < 1e-12);
    }

    #[test]
    fn diagnostics_say_the_state_and_its_causes() {
        let report = HealthReport {
            stamp: Stamp(0),
            verdict: Verdict {
                state: State::Lost,
                since: Stamp(0),
                causes: vec![Cause {
                    kind: CauseKind::Alignment,
                    severity: Severity::Critical,
                    value: Some(0.3),
                    limit: Some(0.45),
                }],
                update: 9,
                metrics: None,
            },
            proposal: None,
            auto: false,
        };
        let status = diagnosis(&report, "car-1", Some("initial pose refused"));
        assert_eq!(status.level, 2);
        assert_eq!(
            status.message,
            "LOST: end points off the walls: alignment 0.30 (limit 0.45)"
        );
        assert_eq!(status.hardware_id, "car-1");
        let last = status.values.last().expect("several");
        assert_eq!(
            (last.key.as_str(), last.value.as_str()),
            ("last message", "initial pose refused")
        );
    }
}
