"""A recording in everyone's tools: Python's `mcap`, `mcap-ros2-support`, `rosbags` and `foxglove-sdk` read what `pitwall` writes.

    .ci/exports.py PITWALL CAR_NODE

A simulated car drives for some seconds, and is recorded. The recording is checked, exported as ROS 2 bag and CSV, and read by
libraries that know nothing of this project. At the end car-node localizes on its own bag.

`foxglove-sdk` writes MCAP files. What it reads is for its data sets (`foxglove.datasets`, experimental): messages by topic and time,
through the file's index. Its message types say which fields the schemas have.
"""

import csv
import json
import math
import re
import subprocess
import sys
import tempfile
import time
from datetime import datetime, timedelta, timezone
from pathlib import Path

import foxglove.messages
from foxglove.datasets import ObjectLocation
from foxglove.datasets.reader import EpisodeReader, _Episode
from mcap.decoder import DecoderFactory as AnyDecoderFactory
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

SECONDS = 8
ENDPOINT = "tcp/127.0.0.1:27461"
TYPES = {
    "/scan": "sensor_msgs/msg/LaserScan",
    "/odom": "nav_msgs/msg/Odometry",
    "/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/ground_truth/odom": "nav_msgs/msg/Odometry",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
}


def check(condition, text):
    print(("ok      " if condition else "FAILED  ") + text)
    if not condition:
        sys.exit(1)


def run(*words, code=0):
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True, timeout=120)
    if done.returncode != code:
        sys.exit(f"{' '.join(map(str, words))}: exit code {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout


def record(pitwall, car_node, folder):
    file = folder / "session.mcap"
    wall = subprocess.Popen([pitwall, "--listen", ENDPOINT, "record", "-o", file, "--for", f"{SECONDS}s"])
    car = subprocess.Popen(
        [car_node, "run", "--source", "simulator", "--map", "club", "--car", "blue", "--connect", ENDPOINT,
         "--state", folder / "state"]
    )
    try:
        check(wall.wait(timeout=SECONDS + 90) == 0, "a recording of a simulated car")
    finally:
        car.terminate()
        car.wait(timeout=30)
    return file


class Json(AnyDecoderFactory):
    def decoder_for(self, message_encoding, _):
        return json.loads if message_encoding == "json" else None


class Disk:
    def open(self, location):
        return open(location.path, "rb")


def read_by_foxglove(file, topics):
    """Every message of the topics with its schema's name, and those of the middle second."""

    def read(begin, end):
        episode = _Episode("session", begin, end, {}, (ObjectLocation("", str(file)),))
        reader = EpisodeReader(episode, tuple(topics), None, Disk())
        return [(schema.name if schema else "", channel.topic, message.log_time, content)
                for schema, channel, message, content in reader.iter_messages(decoder_factories=[Json()])]

    every = read(datetime(2000, 1, 1, tzinfo=timezone.utc), datetime(2100, 1, 1, tzinfo=timezone.utc))
    times = [at for _, _, at, _ in every]
    middle = datetime.fromtimestamp(times[len(times) // 2] // 1_000_000_000, timezone.utc)
    return every, read(middle, middle + timedelta(seconds=1)), int(middle.timestamp()) * 1_000_000_000


def main(pitwall, car_node):
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        file = record(pitwall, car_node, folder)
        outcome = json.loads(run(pitwall, "--json", "check", file))
        check(outcome["complete"], "pitwall check: nothing is missing")
        received = {s["topic"]: s["received"] for s in outcome["cars"][0]["streams"]}

        with open(file, "rb") as stream:
            reader = make_reader(stream)
            topics, names = {}, set()
            for schema, channel, message in reader.iter_messages():
                if channel.message_encoding == "json":
                    json.loads(message.data)
                    topics[channel.topic] = topics.get(channel.topic, 0) + 1
            names = {attachment.name for attachment in reader.iter_attachments()}
            metadata = {record.name for record in reader.iter_metadata()}
        check(topics["/blue/pose"] >= received["recorded_pose"], f"mcap: {topics['/blue/pose']} poses in Foxglove's schema")
        check({"club.pgm", "club.yaml"} <= names, f"mcap: attachments {sorted(names)}")
        check({"pitwall.session", "pitwall.cars", "pitwall.set"} <= metadata, f"mcap: metadata {sorted(metadata)}")

        every, second, begin = read_by_foxglove(file, topics)
        counts = {}
        for schema, topic, _, content in every:
            counts[topic] = counts.get(topic, 0) + 1
            kind, _, name = schema.partition(".")
            if kind == "foxglove":
                signature = getattr(foxglove.messages, name).__text_signature__
                fields = set(re.findall(r"(\w+)=", signature))
                if not set(content) <= fields:
                    check(False, f"foxglove-sdk: {topic}: {schema} has no {set(content) - fields}")
        check(counts == topics, f"foxglove-sdk: {len(every)} messages in the JSON channels, with fields of its schemas")
        within = sum(begin <= at < begin + 1_000_000_000 for _, _, at, _ in every)
        check(abs(len(second) - within) <= 2 and within > 50, f"foxglove-sdk: {len(second)} messages of one second, by the index")

        run(pitwall, "export", file)
        with open(folder / "session.csv" / "poses.csv") as stream:
            rows = list(csv.DictReader(stream))
        check(len(rows) == received["recorded_pose"], f"CSV: {len(rows)} poses, as many as were published")
        stamps = [int(row["sensor_unix_ns"]) for row in rows]
        check(stamps == sorted(stamps), "CSV: in the order of time")

        run(pitwall, "export", file, "--bag")
        bag = folder / "session.bags" / "blue"
        counts = {}
        with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            check({c.topic: c.msgtype for c in reader.connections} == TYPES, "rosbags: every topic with its type")
            poses = {}
            for connection, _, raw in reader.messages():
                message = reader.deserialize(raw, connection.msgtype)
                counts[connection.topic] = counts.get(connection.topic, 0) + 1
                if connection.topic == "/pose":
                    stamp = message.header.stamp
                    poses[stamp.sec * 1_000_000_000 + stamp.nanosec] = message.pose.pose
                elif connection.topic == "/scan":
                    scan = message
        check(counts["/scan"] == received["recorded_scan"], f"rosbags: {counts['/scan']} scans, as many as were published")
        check(scan.header.frame_id == "laser" and len(scan.ranges) > 100, f"rosbags: scans of {len(scan.ranges)} beams")
        for row in rows:
            pose = poses[int(row["sensor_unix_ns"])]
            heading = 2 * math.atan2(pose.orientation.z, pose.orientation.w)
            turned = math.remainder(heading - float(row["heading_rad"]), math.tau)
            off = math.dist((pose.position.x, pose.position.y), (float(row["x_m"]), float(row["y_m"])))
            if off > 1e-9 or abs(turned) > 1e-9:
                sys.exit(f"{row}: {pose}")
        check(True, "rosbags: the poses are those of the CSV")

        with open(bag / "blue_0.mcap", "rb") as stream:
            reader = make_reader(stream, decoder_factories=[DecoderFactory()])
            decoded = {}
            for _, channel, _, message in reader.iter_decoded_messages():
                decoded[channel.topic] = decoded.get(channel.topic, 0) + 1
        check(decoded == counts, f"mcap-ros2-support: {sum(decoded.values())} messages, by the definitions in the file")

        text = run(car_node, "evaluate", "--map", folder_of_tracks(car_node) / "club" / "map.yaml",
                   "--bag", bag / "blue_0.mcap", "--json")
        check("rmse" in text.lower(), "car-node evaluate takes the bag")


def folder_of_tracks(_):
    return Path(__file__).resolve().parent.parent / "maps" / "tracks"


if __name__ == "__main__":
    begun = time.monotonic()
    main(sys.argv[1], sys.argv[2])
    print(f"{time.monotonic() - begun:.0f} s")
