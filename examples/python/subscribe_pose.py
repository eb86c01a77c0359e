"""Prints where every car is, its state with the causes, and what happens.

    pip install eclipse-zenoh==1.10.2
    python3 subscribe_pose.py                           # with a pit wall running on this machine
    python3 subscribe_pose.py tcp/192.168.1.10:7447     # with one elsewhere
    python3 subscribe_pose.py --listen tcp/0.0.0.0:7447 # in place of one: the cars dial in here
"""

import json
import math
import sys
import time

import zenoh

import wire


def config(arguments):
    """A client of a pit wall; with --listen what the cars dial."""
    listen = arguments[:1] == ["--listen"]
    endpoint = arguments[listen] if len(arguments) > listen else "tcp/127.0.0.1:7447"
    settings = zenoh.Config()
    settings.insert_json5("mode", json.dumps("router" if listen else "client"))
    settings.insert_json5("listen/endpoints" if listen else "connect/endpoints", json.dumps([endpoint]))
    settings.insert_json5("scouting/multicast/enabled", "false")
    return settings


def car(sample):
    """The key is synpf/v1/<car>/<topic>."""
    return str(sample.key_expr).split("/")[2]


def show_pose(sample):
    header, message = wire.read(wire.POSE, sample.payload)
    pose, speed = message["pose"], message["twist"]["linear_x"]
    age = time.time() - header.sensor * 1e-9
    print(
        f"{car(sample)}: {pose['x']:8.3f} {pose['y']:8.3f} m {math.degrees(pose['heading']):7.1f} deg "
        f"{speed:5.2f} m/s, {age * 1e3:.0f} ms old"
    )


def show_health(sample):
    _, health = wire.read(wire.HEALTH, sample.payload)
    causes = ", ".join(cause["kind"] for cause in health["causes"])
    print(f"{car(sample)}: {health['state'].upper()} {causes}")


def show_event(sample):
    _, event = wire.read(wire.EVENT, sample.payload)
    print(f"{car(sample)}: {event['kind']}")


def main(arguments):
    with zenoh.open(config(arguments)) as session:
        for topic, show in [("pose", show_pose), ("health", show_health), ("event", show_event)]:
            session.declare_subscriber(f"synpf/v1/*/{topic}", show)
        while True:
            time.sleep(1)


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except KeyboardInterrupt:
        pass
