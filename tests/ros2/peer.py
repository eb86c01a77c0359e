"""A ROS 2 side without ROS, for check.py: sessions and nodes as rmw_zenoh and a bridge have them, and a car that drives.

Keys, tokens and attachments follow rmw_zenoh's design.md. Messages are written and read by rosbags, which shares nothing with the node.
"""

import copy
import json
import math
import struct
import threading
import time

import numpy as np
import zenoh
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

TYPES = get_typestore(Stores.ROS2_JAZZY)
# Services have no types there. Request and reply are messages like any other.
for name, text in {
    "Names": "string[] names",
    "ListRequest": "string[] prefixes\nuint64 depth",
    "ListReply": "string[] names\nstring[] prefixes",
    "GetReply": "rcl_interfaces/ParameterValue[] values",
    "SetRequest": "rcl_interfaces/Parameter[] parameters",
    "SetReply": "rcl_interfaces/SetParametersResult[] results",
    "DescribeReply": "rcl_interfaces/ParameterDescriptor[] descriptors",
    "Empty": "uint8 structure_needs_at_least_one_member",
}.items():
    TYPES.register(get_types_from_msg(text, f"check/msg/{name}"))

# The hashes of services by REP 2016, computed from their definitions.
SERVICES = {
    "rcl_interfaces::srv::dds_::ListParameters_": "RIHS01_3e6062bfbb27bfb8730d4cef2558221f51a11646d78e7bb30a1e83afac3aad9d",
    "rcl_interfaces::srv::dds_::GetParameters_": "RIHS01_bf9803d5c74cf989a5de3e0c2e99444599a627c7ff75f97b8c05b01003675cbc",
    "rcl_interfaces::srv::dds_::SetParameters_": "RIHS01_56eed9a67e169f9cb6c1f987bc88f868c14a8fc9f743a263bc734c154015d7e0",
    "rcl_interfaces::srv::dds_::DescribeParameters_": "RIHS01_845b484d71eb0673dae682f2e3ba3c4851a65a3dcfb97bddd82c5b57e91e4cff",
    "std_srvs::srv::dds_::Empty_": "RIHS01_5888399dedec5ccc85ea6451949fd2c9f97bfdf963f9a588821639fcd31b5d19",
}

LASER_AHEAD = 0.27
BEAMS = 181
FIELD = math.radians(270)
SCAN_PERIOD, ODOMETRY_PERIOD = 0.05, 0.02
# From a stamp to the arrival, as a real car has it.
SCAN_LATENCY, ODOMETRY_LATENCY = 0.020, 0.001


def make(name, /, **fields):
    """A message, with every field that is not given as zero."""
    definition = TYPES.fielddefs[name][1]
    values = {}
    for field, (kind, detail) in definition:
        if field in fields:
            values[field] = fields[field]
        elif kind == 2:
            values[field] = make(detail)
        elif kind == 3:
            values[field] = np.zeros(detail[1])
        elif kind == 4:
            basic = detail[0][0] == 1 and detail[0][1][0] != "string"
            values[field] = np.zeros(0, dtype=detail[0][1][0]) if basic else []
        else:
            values[field] = "" if detail[0] == "string" else 0
    return TYPES.types[name](**values)


def encode(message):
    return bytes(TYPES.serialize_cdr(message, message.__msgtype__))


def decode(payload, name):
    return TYPES.deserialize_cdr(payload, name)


def header(nanoseconds, frame):
    stamp = make("builtin_interfaces/msg/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def stamp_of(message):
    stamp = message.header.stamp
    return stamp.sec * 10**9 + stamp.nanosec


def quaternion(yaw=0.0, roll=0.0):
    """Only one of the two turns."""
    x, z = math.sin(roll / 2), math.sin(yaw / 2)
    return make("geometry_msgs/msg/Quaternion", x=x, y=0.0, z=z, w=math.cos((yaw or roll) / 2))


def transform(frame, child, x, y, yaw=0.0, roll=0.0, z=0.0):
    translation = make("geometry_msgs/msg/Vector3", x=float(x), y=float(y), z=z)
    return make(
        "geometry_msgs/msg/TransformStamped",
        header=header(time.time_ns(), frame),
        child_frame_id=child,
        transform=make("geometry_msgs/msg/Transform", translation=translation, rotation=quaternion(yaw, roll)),
    )


def ros_pose(x, y, yaw):
    position = make("geometry_msgs/msg/Point", x=float(x), y=float(y), z=0.0)
    return make("geometry_msgs/msg/Pose", position=position, orientation=quaternion(yaw))


def planar(pose):
    q = pose.orientation
    return pose.position.x, pose.position.y, math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y**2 + q.z**2))


def compose(a, b):
    c, s = math.cos(a[2]), math.sin(a[2])
    return a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], a[2] + b[2]


def inverse(a):
    c, s = math.cos(a[2]), math.sin(a[2])
    return -c * a[0] - s * a[1], s * a[0] - c * a[1], -a[2]


def session(endpoint, mode="peer"):
    """A session as rmw_zenoh's nodes have it, or its router."""
    config = zenoh.Config()
    settings = {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": True,
        "timestamping/enabled": True,
    }
    if mode == "router":
        settings["listen/endpoints"] = [endpoint]
    else:
        settings |= {
            "connect/endpoints": [endpoint],
            "connect/timeout_ms": -1,
            "connect/exit_on_failure": False,
            "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2},
            "listen/endpoints": ["tcp/127.0.0.1:0"],
            "scouting/gossip/autoconnect_strategy": {"peer": {"to_router": "always", "to_peer": "greater-zid"}},
        }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def dds(name):
    package, kind, message = name.split("/")
    return f"{package}::{kind}::dds_::{message}_"


class Node:
    """A node of rmw_zenoh; with `bridge`, what a zenoh-bridge-ros2dds makes of it."""

    def __init__(self, session, name, domain=0, bridge=False):
        self.session, self.name, self.domain, self.bridge = session, name, domain, bridge
        self.publishers, self.tokens, self.sequence, self.calls, self.next = {}, [], 0, 0, 1
        self.zid = str(session.info.zid())
        if not bridge:
            self.announce(f"@ros2_lv/{domain}/{self.zid}/0/0/NN/%/%/{name}")

    def announce(self, token):
        self.tokens.append((token, self.session.liveliness().declare_token(token)))

    def key(self, topic, name):
        topic = topic.strip("/")
        return topic if self.bridge else f"{self.domain}/{topic}/{dds(name)}/{TYPES.hash_rihs01(name)}"

    def put(self, topic, message, latched=False):
        self.put_bytes(topic, message.__msgtype__, encode(message), latched)

    def put_bytes(self, topic, name, payload, latched=False):
        if topic not in self.publishers:
            key = self.key(topic, name)
            if latched:
                publisher = zenoh.ext.declare_advanced_publisher(
                    self.session, key, cache=zenoh.ext.CacheConfig(1), publisher_detection=True
                )
            else:
                publisher = self.session.declare_publisher(key)
            if not self.bridge:
                mangled = "%" + topic.strip("/").replace("/", "%")
                hash_ = TYPES.hash_rihs01(name)
                qos = ":1:,1:,:,:,," if latched else "::,10:,:,:,,"
                place = f"@ros2_lv/{self.domain}/{self.zid}/0/{self.next}"
                self.announce(f"{place}/MP/%/%/{self.name}/{mangled}/{dds(name)}/{hash_}/{qos}")
                self.next += 1
            self.publishers[topic] = publisher
        self.sequence += 1
        attachment = None
        if not self.bridge:
            attachment = struct.pack("<qqB", self.sequence, time.time_ns(), 16) + bytes(16)
        self.publishers[topic].put(payload, attachment=attachment)

    def withdraw(self, topic):
        """Publishes on a topic no more."""
        mangled = "%" + topic.strip("/").replace("/", "%")
        for token, declared in list(self.tokens):
            if f"/MP/%/%/{self.name}/{mangled}/" in token:
                declared.undeclare()
                self.tokens.remove((token, declared))
        self.publishers.pop(topic).undeclare()

    def call(self, service, type_, request):
        """The reply of a service, as rmw_zenoh or a bridge asks for it."""
        self.calls += 1
        if self.bridge:
            # The client and the number of the request, in a form of the bridge's own. It looks at the payload of the reply only.
            attachment = b"\x01" + b"rqh" + struct.pack("<QqB", 7, self.calls, 1)
            for reply in self.session.get(service.strip("/"), payload=encode(request), attachment=attachment, timeout=5.0):
                payload = bytes(reply.ok.payload)
                assert payload[1] == 1 and len(payload) > 4, "CDR begins with its four bytes"
                return payload
            raise AssertionError(f"{service} does not answer")
        key = f"{self.domain}/{service.strip('/')}/{type_}/{SERVICES[type_]}"
        attachment = struct.pack("<qqB", self.calls, time.time_ns(), 16) + bytes(range(16))
        replies = self.session.get(
            key, payload=encode(request), attachment=attachment, target=zenoh.QueryTarget.ALL_COMPLETE, timeout=5.0
        )
        for reply in replies:
            back = bytes(reply.ok.attachment)
            number = struct.unpack_from("<q", back)[0]
            assert number == self.calls and back[17:] == bytes(range(16)), "the reply is to another request"
            return bytes(reply.ok.payload)
        raise AssertionError(f"{service} does not answer")


class Track:
    """A lap at 3 m/s, with the scan at each place of it."""

    SPEED = 3.0

    def __init__(self, folder, beams=BEAMS, period=SCAN_PERIOD, sweep=0.0):
        self.beams, self.scan_period, self.sweep = beams, period, sweep
        line = np.loadtxt(folder / "raceline.csv", delimiter=";", usecols=(0, 1, 2, 3))
        self.s, self.points = line[:, 0], line[:, 1:3]
        self.headings = np.unwrap(line[:, 3])
        walls = np.genfromtxt(folder / "walls.csv", delimiter=";", usecols=(0, 2, 3))
        begin, end = [], []
        for wall in np.unique(walls[:, 0]):
            points = walls[walls[:, 0] == wall, 1:]
            if len(points) > 20:
                # They are 0.1 m apart; every other one will do. The last one stays: a wall may be closed, or end there.
                points = np.vstack([points[:-1:2], points[-1:]])
            begin.append(points[:-1])
            end.append(points[1:])
        self.a = np.concatenate(begin)
        self.b = np.concatenate(end)
        ends = np.vstack([self.points, self.points[:1]])
        self.length = self.s[-1] + float(np.linalg.norm(ends[-1] - ends[-2]))
        self.s = np.append(self.s, self.length)
        self.points = ends
        turns = round((self.headings[-1] - self.headings[0]) / (2 * math.pi))
        self.headings = np.append(self.headings, self.headings[0] + 2 * math.pi * turns)
        self.upside_down = False
        # A whole number of scans and of odometry messages to the lap.
        self.period = round(self.length / self.SPEED / 0.1) * 0.1
        random = np.random.default_rng(0)
        self.scans = [self.scan(i * period, random) for i in range(round(self.period / period))]

    def swept(self, sweep):
        """The same lap, seen by a lidar that takes so long for a scan [s]: each beam from where the car is then."""
        other = copy.copy(self)
        other.sweep, random = sweep, np.random.default_rng(0)
        other.scans = [other.scan(i * self.scan_period, random) for i in range(len(self.scans))]
        return other

    def upside_down_lidar(self):
        """The same lap, seen by a lidar that is upside down: its beams come in the other order."""
        other = copy.copy(self)
        other.upside_down, other.scans = True, [scan[::-1].copy() for scan in self.scans]
        return other

    def standing(self):
        """A car that stands in a room without walls."""
        self.beams, self.scan_period, self.sweep = BEAMS, SCAN_PERIOD, 0.0
        self.period, self.scans = 0.1, [np.full(BEAMS, 5.0, dtype=np.float32)] * 2
        self.length, self.s = 1.0, np.array([0.0, 1.0])
        self.points, self.headings = np.zeros((2, 2)), np.zeros(2)
        self.upside_down = False
        return self

    def pose(self, t):
        """Where the car is: x, y and heading, at one time or at many."""
        s = (t % self.period) / self.period * self.length
        x, y = (np.interp(s, self.s, self.points[:, i]) for i in (0, 1))
        return x, y, np.interp(s, self.s, self.headings)

    def scan(self, t, random):
        along = np.linspace(0, 1, self.beams)
        x, y, heading = self.pose(t + along * self.sweep)
        x, y = x + LASER_AHEAD * np.cos(heading), y + LASER_AHEAD * np.sin(heading)
        angles = heading + (along - 0.5) * FIELD
        d = np.stack([np.cos(angles), np.sin(angles)], axis=1)[:, None, :]
        e = (self.b - self.a)[None]
        w = self.a[None] - np.stack([x, y], axis=1)[:, None, :]
        cross = d[..., 0] * e[..., 1] - d[..., 1] * e[..., 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            range_ = (w[..., 0] * e[..., 1] - w[..., 1] * e[..., 0]) / cross
            part = (w[..., 0] * d[..., 1] - w[..., 1] * d[..., 0]) / cross
        range_[~((range_ > 0) & (part >= 0) & (part <= 1))] = np.inf
        return (range_.min(axis=1) + random.normal(0, 0.01, self.beams)).astype(np.float32)


class Car:
    """Drives along the track and publishes.

    `offset` is the sensors' clock less this machine's [s]; `paused` stops time; `rate` is how fast it goes. With `gyroscope`, an IMU
    sends so many times the yaw rate. `stamped_at_end` stamps a scan when its sweep has ended. `set_out` keeps when each message of
    odometry was sent, by stamp.
    """

    # `map_from_odom`
    ODOM = (1.0, 2.0, 0.3)

    def __init__(self, node, track, namespace="", transforms=True, shift=0.0, gyroscope=None, stamped_at_end=False):
        self.node, self.track, self.namespace = node, track, namespace
        self.offset, self.rate = 0.0, 1.0
        self.gyroscope, self.stamped_at_end = gyroscope, stamped_at_end
        self.paused = threading.Event()
        self.truth, self.set_out = {}, {}
        self.ended = threading.Event()
        self.shift = shift
        # What is due next, by the time on the track.
        scan_due = track.sweep + SCAN_LATENCY
        self.streams = {"odometry": (ODOMETRY_PERIOD, ODOMETRY_LATENCY), "scan": (track.scan_period, scan_due)}
        if gyroscope is not None:
            self.streams["imu"] = (ODOMETRY_PERIOD / 2, ODOMETRY_LATENCY)
        if transforms:
            self.send_transforms()
        self.thread = threading.Thread(target=self.drive, daemon=True)
        self.thread.start()

    def send_transforms(self):
        roll = math.pi if self.track.upside_down else 0.0
        stamped = transform("base_link", "laser", LASER_AHEAD, 0.0, roll=roll, z=0.1)
        self.node.put(f"{self.namespace}/tf_static", make("tf2_msgs/msg/TFMessage", transforms=[stamped]), latched=True)

    def drive(self):
        wall, at = time.monotonic(), 0.0
        due = {kind: 0 for kind in self.streams}
        while not self.ended.is_set():
            arrivals = {kind: number * self.streams[kind][0] + self.streams[kind][1] for kind, number in due.items()}
            kind = min(arrivals, key=arrivals.get)
            if self.paused.is_set():
                began = time.monotonic()
                while self.paused.is_set():
                    time.sleep(0.01)
                wall += time.monotonic() - began
            # The time on the track goes on from where it is, at the rate of now.
            wall, at = wall + (arrivals[kind] - at) / self.rate, arrivals[kind]
            time.sleep(max(0.0, wall - time.monotonic()))
            t = due[kind] * self.streams[kind][0]
            due[kind] += 1
            nanoseconds = round((self.begin_stamp() + t) * 1e9)
            pose = self.track.pose(t + self.shift)
            self.truth[nanoseconds] = pose
            if kind == "odometry":
                self.send_odometry(nanoseconds, pose, t + self.shift)
            elif kind == "imu":
                self.send_imu(nanoseconds, t + self.shift)
            else:
                stamp = nanoseconds + round(self.track.sweep * 1e9) * self.stamped_at_end
                self.send_scan(stamp, t + self.shift)

    def now(self):
        """Where the car is now."""
        return next(reversed(list(self.truth.values())))

    def begin_stamp(self):
        if not hasattr(self, "begun"):
            self.begun = time.time()
        return self.begun + self.offset

    def motion(self, t):
        """Speed and yaw rate."""
        dt = 0.01
        before, after = self.track.pose(t - dt), self.track.pose(t + dt)
        turn = (after[2] - before[2] + math.pi) % (2 * math.pi) - math.pi
        return math.hypot(after[0] - before[0], after[1] - before[1]) / (2 * dt), turn / (2 * dt)

    def send_imu(self, nanoseconds, t):
        rate = make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=self.motion(t)[1] * self.gyroscope)
        self.node.put(f"{self.namespace}/sensors/imu/raw", make("sensor_msgs/msg/Imu", header=header(nanoseconds, "imu"), angular_velocity=rate))

    def send_odometry(self, nanoseconds, pose, t):
        speed, turn = self.motion(t)
        x, y, yaw = compose(inverse(self.ODOM), pose)
        twist = make(
            "geometry_msgs/msg/Twist",
            linear=make("geometry_msgs/msg/Vector3", x=speed, y=0.0, z=0.0),
            angular=make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=turn),
        )
        message = make(
            "nav_msgs/msg/Odometry",
            header=header(nanoseconds, "odom"),
            child_frame_id="base_link",
            pose=make("geometry_msgs/msg/PoseWithCovariance", pose=ros_pose(x, y, yaw), covariance=np.zeros(36)),
            twist=make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        )
        self.set_out[nanoseconds] = time.time_ns()
        self.node.put(f"{self.namespace}/odom", message)

    def send_scan(self, nanoseconds, t):
        index = round((t % self.track.period) / self.track.scan_period) % len(self.track.scans)
        message = make(
            "sensor_msgs/msg/LaserScan",
            header=header(nanoseconds, "laser"),
            angle_min=-FIELD / 2,
            angle_max=FIELD / 2,
            angle_increment=FIELD / (self.track.beams - 1),
            time_increment=self.track.sweep / (self.track.beams - 1),
            scan_time=self.track.scan_period if self.track.sweep else 0.0,
            range_min=0.02,
            range_max=30.0,
            ranges=self.track.scans[index],
            intensities=np.zeros(0, dtype=np.float32),
        )
        self.node.put(f"{self.namespace}/scan", message)

    def end(self):
        self.ended.set()
        self.thread.join(3)
