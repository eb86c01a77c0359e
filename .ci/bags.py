"""Bags as other programs write them: one drive in every form that Python's `rosbags` writes, evaluated by car-node.

    .ci/bags.py CAR_NODE

The drive is made here: a car on a circle in a room. Every form must give the same poses, to the last digit.
"""

import math
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

WIDTH, HEIGHT, CELL = 160, 80, 0.05  # a room of 8 m x 4 m
RADIUS, SPEED, SECONDS = 0.8, 1.0, 2.0
LASER_AHEAD = 0.27
START = 1_700_000_000_000_000_000
COVARIANCE = np.zeros(36)


def room():
    """True where there is a wall; a recess makes the ends of the room different."""
    walls = np.zeros((HEIGHT, WIDTH), dtype=bool)
    walls[[0, -1], :] = True
    walls[:, [0, -1]] = True
    walls[61:, 111:] = True
    return walls


def write_map(folder):
    pixels = np.where(room()[::-1], 0, 255).astype(np.uint8)
    (folder / "map.pgm").write_bytes(b"P5\n%d %d\n255\n" % (WIDTH, HEIGHT) + pixels.tobytes())
    (folder / "map.yaml").write_text(
        f"image: map.pgm\nresolution: {CELL}\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    return folder / "map.yaml"


def pose(seconds):
    angle = seconds * SPEED / RADIUS
    return 2.2 + RADIUS * math.cos(angle), 2.0 + RADIUS * math.sin(angle), angle + math.pi / 2


def ranges(x, y, heading, angles):
    """Ranges by steps of 4 mm."""
    distances = np.arange(0.0, 9.0, 0.004)
    directions = heading + angles[:, None]
    columns = ((x + np.cos(directions) * distances) / CELL).astype(int).clip(0, WIDTH - 1)
    rows = ((y + np.sin(directions) * distances) / CELL).astype(int).clip(0, HEIGHT - 1)
    return distances[room()[rows, columns].argmax(axis=1)].astype(np.float32)


class Drive:
    """The messages of the drive, in the types of one version of ROS."""

    def __init__(self, store):
        self.store, self.types = store, store.types
        self.seq = {"seq": 0} if "seq" in self.types["std_msgs/msg/Header"].__annotations__ else {}

    def header(self, seconds, frame):
        now = START + round(seconds * 1e9)
        stamp = self.types["builtin_interfaces/msg/Time"](sec=now // 10**9, nanosec=now % 10**9)
        return self.types["std_msgs/msg/Header"](**self.seq, stamp=stamp, frame_id=frame)

    def ros_pose(self, x, y, heading):
        t = self.types
        return t["geometry_msgs/msg/Pose"](
            position=t["geometry_msgs/msg/Point"](x=x, y=y, z=0.0),
            orientation=self.turn(heading),
        )

    def turn(self, heading):
        half = heading / 2
        return self.types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=math.sin(half), w=math.cos(half))

    def odometry(self, seconds, frame, of):
        t = self.types
        vector = t["geometry_msgs/msg/Vector3"]
        twist = t["geometry_msgs/msg/Twist"](
            linear=vector(x=SPEED, y=0.0, z=0.0), angular=vector(x=0.0, y=0.0, z=SPEED / RADIUS)
        )
        return t["nav_msgs/msg/Odometry"](
            header=self.header(seconds, frame),
            child_frame_id="base_link",
            pose=t["geometry_msgs/msg/PoseWithCovariance"](pose=self.ros_pose(*of), covariance=COVARIANCE),
            twist=t["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=COVARIANCE),
        )

    def scan(self, seconds):
        x, y, heading = pose(seconds)
        angles = np.linspace(-2.35, 2.35, 271)
        x, y = x + LASER_AHEAD * math.cos(heading), y + LASER_AHEAD * math.sin(heading)
        return self.types["sensor_msgs/msg/LaserScan"](
            header=self.header(seconds, "laser"),
            angle_min=-2.35,
            angle_max=2.35,
            angle_increment=4.7 / 270,
            time_increment=0.0,
            scan_time=0.025,
            range_min=0.02,
            range_max=30.0,
            ranges=ranges(x, y, heading, angles),
            intensities=np.zeros(271, dtype=np.float32),
        )

    def mount(self):
        t = self.types
        transform = t["geometry_msgs/msg/Transform"](
            translation=t["geometry_msgs/msg/Vector3"](x=LASER_AHEAD, y=0.0, z=0.1), rotation=self.turn(0.0)
        )
        stamped = t["geometry_msgs/msg/TransformStamped"](
            header=self.header(0, "base_link"), child_frame_id="laser", transform=transform
        )
        return t["tf2_msgs/msg/TFMessage"](transforms=[stamped])

    def messages(self):
        """Topic, type, nanoseconds, message."""
        yield "/tf_static", "tf2_msgs/msg/TFMessage", START, self.mount()
        x0, y0, heading0 = pose(0)
        for tick in range(int(SECONDS * 200)):
            now = tick * 0.005
            at = START + round(now * 1e9)
            if tick % 4 == 0:
                x, y, heading = pose(now)
                dx, dy = x - x0, y - y0
                cos, sin = math.cos(heading0), math.sin(heading0)
                since = cos * dx + sin * dy, cos * dy - sin * dx, heading - heading0
                yield "/odom", "nav_msgs/msg/Odometry", at, self.odometry(now, "odom", since)
                yield "/ground_truth/odom", "nav_msgs/msg/Odometry", at, self.odometry(now, "map", pose(now))
            if tick % 5 == 0:
                yield "/scan", "sensor_msgs/msg/LaserScan", at, self.scan(now)


def write(writer, store, serialize, messages):
    connections = {}
    for topic, kind, at, message in messages:
        if topic not in connections:
            connections[topic] = writer.add_connection(topic, kind, typestore=store)
        writer.write(connections[topic], at, serialize(message, kind))


def ros2(path, storage, mode=None):
    store = get_typestore(Stores.ROS2_HUMBLE)
    writer = Writer2(path, version=8, storage_plugin=storage)
    if mode:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        write(writer, store, store.serialize_cdr, Drive(store).messages())


def ros1(path, compression=None):
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    writer = Writer1(path)
    if compression:
        writer.set_compression(compression)
    with writer:
        write(writer, store, store.serialize_ros1, Drive(store).messages())


def poses(car_node, map_file, bag, out):
    """What `evaluate --poses` writes, without the columns of the time that it took."""
    command = [car_node, "evaluate", "--map", map_file, "--bag", bag, "--initial-pose", "truth", "--poses", out]
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{bag.name}: {done.stderr}")
    return out.read_text()


def main(car_node):
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        map_file = write_map(folder)
        forms = {}
        for storage in StoragePlugin:
            for mode in [None, CompressionMode.FILE, CompressionMode.MESSAGE]:
                name = f"{storage.name.lower()}-{mode.name.lower() if mode else 'plain'}"
                forms[name] = lambda path, storage=storage, mode=mode: ros2(path, storage, mode)
        for compression in [None, *Writer1.CompressionFormat]:
            name = f"ros1-{compression.name.lower() if compression else 'plain'}.bag"
            forms[name] = lambda path, compression=compression: ros1(path, compression)
        first = None
        for name, make in forms.items():
            make(folder / name)
            found = poses(car_node, map_file, folder / name, folder / "poses.csv")
            first = first or found
            updates = found.count("\n") - 1
            same = found == first
            print(f"{name:20} {updates} poses, {'the same' if same else 'OTHERS'}")
            if not same or updates < 78:
                sys.exit(1)


if __name__ == "__main__":
    main(sys.argv[1])
