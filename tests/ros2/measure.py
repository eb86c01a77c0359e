"""Measures the node as a car's localizer: how right its newest pose is, how late, and what it costs. Prints a table in Markdown.

    python3 tests/ros2/measure.py CAR_NODE                             # a lap of the bundled track, scans of 1081 beams at 40 Hz
    python3 tests/ros2/measure.py CAR_NODE --bag DRIVE.mcap --map MAP.yaml

The car's messages come as late as they do on a car: by the times of the log of a bag, else scans 20 ms and odometry 1 ms after their
stamps. Every output has a subscriber. CAR_NODE is a release build; nothing else should run. Needs eclipse-zenoh, rosbags and mcap.
"""

import argparse
import os
import struct
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import zenoh

import check
import peer

# From a stamp, for a log without a time at which the scan was made.
HEADER_STAMP = slice(4, 12)
# Not counted: the search for the first pose.
SETTLING = 3.0


class Recorder:
    """Everything that the node publishes, as it came."""

    TOPICS = {
        "/pf/pose/odom": "nav_msgs/msg/Odometry",
        "/pf/viz/inferred_pose": "geometry_msgs/msg/PoseStamped",
        "/tracked_pose": "geometry_msgs/msg/PoseStamped",
        "/tracked_pose/with_covariance": "geometry_msgs/msg/PoseWithCovarianceStamped",
        "/pf/viz/particles": "geometry_msgs/msg/PoseArray",
        "/tf": "tf2_msgs/msg/TFMessage",
        "/map": "nav_msgs/msg/OccupancyGrid",
        "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
        "/rosout": "rcl_interfaces/msg/Log",
    }

    def __init__(self, session):
        # A session that nobody keeps is closed.
        self.session, self.came = session, {topic: [] for topic in self.TOPICS}
        self.subscribers = [
            session.declare_subscriber(f"0{topic}/{peer.dds(name)}/*", self.keep(topic)) for topic, name in self.TOPICS.items()
        ]

    def keep(self, topic):
        came = self.came[topic]
        # When it was sent is in the attachment.
        return lambda sample: came.append((struct.unpack_from("<q", bytes(sample.attachment), 8)[0], bytes(sample.payload)))


class BagCar:
    """Plays a bag as the nodes of a car would: each message when it was logged, with its stamp moved to now."""

    def __init__(self, node, path):
        from mcap.reader import make_reader

        self.node, self.truth, self.set_out, self.ended = node, {}, {}, threading.Event()
        self.messages, truth = [], []
        with open(path, "rb") as file:
            for schema, channel, message in make_reader(file).iter_messages():
                name = schema.name
                if channel.topic == "/ground_truth/odom":
                    truth.append(peer.decode(message.data, name))
                elif name in ("sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry"):
                    self.messages.append((message.log_time, channel.topic, name, bytes(message.data)))
                elif channel.topic == "/tf_static":
                    node.put_bytes("/tf_static", name, bytes(message.data), latched=True)
        self.messages.sort(key=lambda message: message[0])
        self.first = self.messages[0][0]
        # Scans give the length of the drive; the truth its places.
        self.times = np.array([peer.stamp_of(t) for t in truth])
        self.places = np.array([(t.pose.pose.position.x, t.pose.pose.position.y) for t in truth])
        self.pose = peer.planar(truth[0].pose.pose)
        self.seconds = (self.messages[-1][0] - self.first) * 1e-9

    def begin(self):
        self.moved = time.time_ns() + 200_000_000 - self.first
        self.thread = threading.Thread(target=self.drive, daemon=True)
        self.thread.start()

    def drive(self):
        for at, topic, name, data in self.messages:
            time.sleep(max(0.0, (at + self.moved - time.time_ns()) * 1e-9))
            if self.ended.is_set():
                return
            seconds, nanoseconds = struct.unpack("<iI", data[HEADER_STAMP])
            stamp = seconds * 10**9 + nanoseconds + self.moved
            data = data[:4] + struct.pack("<iI", *divmod(stamp, 10**9)) + data[12:]
            if name.endswith("Odometry"):
                self.set_out[stamp] = time.time_ns()
            self.node.put_bytes(topic, name, data)

    def at(self, nanoseconds):
        """Where the car is at these times."""
        return [np.interp(nanoseconds - self.moved, self.times, self.places[:, i]) for i in (0, 1)]

    def end(self):
        self.ended.set()
        self.thread.join(3)


class TrackCar:
    """A lap of the bundled track after the other."""

    def __init__(self, node, track, seconds):
        self.node, self.track, self.seconds = node, track, seconds
        self.pose = track.pose(0.0)

    def begin(self):
        self.car = peer.Car(self.node, self.track)
        self.set_out = self.car.set_out

    def at(self, nanoseconds):
        x, y, _ = self.track.pose(nanoseconds * 1e-9 - self.car.begun)
        return x, y

    def end(self):
        self.car.end()


def cpu_seconds(pid):
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def row(what, figure, target=""):
    print(f"| {what} | {figure} | {target} |")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program")
    parser.add_argument("--bag")
    parser.add_argument("--map", default=str(check.TRACK / "map.yaml"))
    parser.add_argument("--seconds", type=float, default=30.0)
    arguments = parser.parse_args()

    router = check.Router()
    node = peer.Node(peer.session(router.endpoint), "car")
    if arguments.bag:
        car = BagCar(node, arguments.bag)
    else:
        car = TrackCar(node, peer.Track(check.TRACK, beams=1081, period=0.025, sweep=0.01875), arguments.seconds)
    recorder = Recorder(peer.session(router.endpoint))
    port = check.free_port()
    wall = check.Wall(port)
    x, y, heading = car.pose
    with tempfile.TemporaryDirectory() as folder:
        place = f"--initial-pose={x},{y},{heading}"
        process = check.node(arguments.program, router, Path(folder), place, wall=port, map=arguments.map)
        # The node waits for the sensors: no message of the drive is missing.
        time.sleep(2.0)
        car.begin()
        time.sleep(SETTLING)
        begin, cpu, begin_ns = time.monotonic(), cpu_seconds(process.pid), time.time_ns()
        time.sleep(car.seconds - SETTLING)
        share = (cpu_seconds(process.pid) - cpu) / (time.monotonic() - begin)
        end_ns = time.time_ns()
        time.sleep(1.0)
        load = wall.load
        car.end()
        check.end(process)
        router.kill()
        log = process.log.read_text()

    poses = [(sent, peer.decode(data, "nav_msgs/msg/Odometry")) for sent, data in recorder.came["/pf/pose/odom"]]
    stamps = np.array([peer.stamp_of(pose) for _, pose in poses])
    counted = [(sent, peer.stamp_of(pose), peer.planar(pose.pose.pose)) for sent, pose in poses if begin_ns < sent < end_ns]
    if not counted:
        print(log, file=sys.stderr)
        sys.exit("there was no pose")
    sent, stamp = (np.array([c[i] for c in counted]) for i in (0, 1))
    place = np.array([c[2][:2] for c in counted]).T
    off = [100 * np.hypot(*(place - np.array(car.at(times)))) for times in (stamp, sent)]
    late = np.array([at - car.set_out[when] for at, when in zip(sent, stamp) if when in car.set_out]) * 1e-6
    back = int(np.sum(np.diff(stamps) <= 0))
    drops = {name: count for name, count in load["drops"].items() if count}
    seconds = (end_ns - begin_ns) * 1e-9
    rates = ", ".join(f"`{topic}` {len(came) / car.seconds:.0f}" for topic, came in recorder.came.items() if topic != "/map")
    print(f"\n{arguments.bag or 'club'}: {seconds:.0f} s, {len(counted)} poses; load of the machine {os.getloadavg()[0]:.1f}\n")
    print("| what | figure | target |\n|---|---|---|")
    row("newest pose against the car at its stamp, mean", f"{off[0].mean():.2f} cm", "1 cm")
    row("the same, 99 of 100 / worst", f"{np.percentile(off[0], 99):.2f} / {off[0].max():.2f} cm")
    row("newest pose against the car when it is sent, mean", f"{off[1].mean():.2f} cm")
    row("stamps that do not increase", f"{back} of {len(stamps)}", "0")
    row("messages dropped, from the first on", ", ".join(f"{n} {c}" for n, c in drops.items()) or "0", "0")
    row("from odometry to pose, half / 99 of 100 / worst", " / ".join(f"{v:.2f}" for v in [*np.percentile(late, [50, 99]), late.max()]) + " ms", "99: 3 ms")
    row("an update, half / 99 of 100", f"{load['update_us']['p50'] / 1e3:.2f} / {load['update_us']['p99'] / 1e3:.2f} ms")
    row("CPU, all threads", f"{100 * share:.1f} % of a core", "5 %")
    row("outputs [Hz]", rates)


if __name__ == "__main__":
    main()
    sys.stdout.flush()
    # Sessions that lost their router keep threads for which Python would wait.
    os._exit(0)
