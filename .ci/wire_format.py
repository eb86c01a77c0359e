"""Holds docs/wire-format.md against the golden bytes, and the reader written from it against a running car.

    python3 .ci/wire_format.py PATH/TO/car-node      # needs eclipse-zenoh

The car is simulated; it dials a zenoh router in this process, as it would dial a pit wall. Checked: the pose lies near the true one,
health and events make sense, a clock query, gap recovery and a command are answered.
"""

import math
import random
import re
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "examples" / "python"))

import wire  # noqa: E402

CAR = "reader"
# For everything [s]; a debug build takes some 15 s.
DEADLINE = 90.0
# Poses are 1 to 3 cm off here [m]. What is read wrongly, or in the wrong order, is metres off.
NEAR = 0.15
POSES = 200


def check(holds, what):
    print(f"  {'ok' if holds else 'FAULT'}: {what}", flush=True)
    if not holds:
        sys.exit(f"wire format: {what}")


def golden_bytes():
    lines = (ROOT / "protocol/tests/wire/golden.txt").read_text().splitlines()
    return dict(line.split(": ", 1) for line in lines)


def documented_bytes():
    """The blocks that begin with ```hex NAME. Each line has groups of hexadecimal digits, two spaces, and the explanation."""
    text = (ROOT / "docs/wire-format.md").read_text()
    for name, partial, body in re.findall(r"^```hex (\w+)( starts-with)?\n(.*?)^```$", text, re.M | re.S):
        digits = [re.match(r"(?:[0-9a-f]{2,} ?)+(?=  |$)", line).group() for line in body.splitlines()]
        yield name, bool(partial), "".join(digits).replace(" ", "")


def check_page():
    golden = golden_bytes()
    # The header stands in golden.rs: it is the whole of a message, and not a payload.
    source = (ROOT / "protocol/tests/wire/golden.rs").read_text()
    golden["header"] = "".join(re.findall(r'"([0-9a-f]+)",', source.split("fn header()")[1].split("fn ")[0]))
    page = (ROOT / "docs/wire-format.md").read_text()
    rows = re.findall(r"^\| `([a-z/]+)` \| (\d+) \|", page, re.M)
    numbers = {int(number): topic for topic, number in rows}
    check([numbers.get(i) for i in range(len(rows))] == wire.TOPICS, f"the page's {len(rows)} topics are those of the reader")
    table = page.split("A Cause is kind")[1].split("Metrics are")[0]
    kinds = sorted(int(number) for number in re.findall(r"\| (\d+) \|", table))
    check(kinds == list(range(len(wire.CAUSES))), f"the page's {len(kinds)} causes are those of the reader")
    names = []
    for name, partial, digits in documented_bytes():
        names.append(name)
        same = golden[name].startswith(digits) if partial else golden[name] == digits
        check(same, f"the page shows the golden bytes of {name}")
    check(len(names) == 8, f"{len(names)} blocks of bytes found")

    def golden_message(name, message, version):
        header = b"SYPF" + struct.pack("<HHQQqq", message.schema, version, 1, 2, 3, 4)
        return wire.read(message, header + bytes.fromhex(golden[name]))[1]

    pose = golden_message("pose", wire.POSE, 1)
    check(pose["pose"] == {"x": 1.5, "y": -2.25, "heading": 0.5} and pose["lap"] == 3, "pose as the page explains it")
    for version, name, causes in [(3, "health", len(wire.CAUSES)), (2, "health of version 2", 42), (1, "health of version 1", 20)]:
        health = golden_message(name, wire.HEALTH, version)
        check(len(health["causes"]) == causes and health["proposal"]["set"] == "lq", f"health of version {version}")
    event = golden_message("event", wire.EVENT, 3)
    check(event["command"] == 0x0102030405060708090A0B0C0D0E0F10 and event["who"] == "ana", "event")
    answer = golden_message("answer", wire.ANSWER, 1)
    check(answer["outcome"]["reply"]["kind"] == "sets", "answer")
    reply = golden_message("missing_reply", wire.MISSING_REPLY, 1)
    check(reply["messages"] == [{"topic": "event", "bytes": b"\x01\x02\x03"}], "missing reply")
    request = wire.missing_request(0, 7, [("event", [(1, 2), (5, 5)]), ("recorded/scan", [])], 6000)
    check(request[wire.HEADER_LEN :].hex() == golden["missing_request"], "missing request")
    cut = b"SYPF" + struct.pack("<HHQQqq", 1, 1, 1, 2, 3, 4) + bytes.fromhex(golden["pose"])
    for broken in (cut[:-1], cut + b"\0"):
        try:
            wire.read(wire.POSE, broken)
            check(False, "a message that is cut off or too long is refused")
        except wire.Malformed:
            pass


class Inbox:
    """What the car has put, by topic, with a wait for more of it."""

    def __init__(self, session):
        self.changed, self.messages, self.faults = threading.Condition(), {}, []
        for topic, message in [
            ("pose", wire.POSE),
            ("health", wire.HEALTH),
            ("event", wire.EVENT),
            ("recorded/truth", wire.TRUTH),
        ]:
            session.declare_subscriber(f"synpf/v1/{CAR}/{topic}", self.taker(topic, message))

    def taker(self, topic, message):
        def take(sample):
            with self.changed:
                try:
                    self.messages.setdefault(topic, []).append(wire.read(message, sample.payload))
                except Exception as fault:  # Told where the main thread waits.
                    self.faults.append(f"{topic}: {fault!r}")
                self.changed.notify_all()

        return take

    def wait(self, what, condition, until):
        """Waits until `condition` of the messages gives something."""
        with self.changed:
            while True:
                if self.faults:
                    check(False, self.faults[0])
                found = condition(self.messages)
                if found:
                    return found
                if time.monotonic() > until:
                    check(False, f"{what} in time")
                self.changed.wait(0.5)


def interpolate(truths, sensor):
    """The true position at a time, between the truths around it."""
    for (before, first), (after, second) in zip(truths, truths[1:]):
        if before.sensor <= sensor <= after.sensor and after.sensor > before.sensor:
            share = (sensor - before.sensor) / (after.sensor - before.sensor)
            return [first["pose"][axis] + share * (second["pose"][axis] - first["pose"][axis]) for axis in "xy"]
    return None


def check_car(node):
    import zenoh

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    settings = zenoh.Config()
    settings.insert_json5("mode", '"router"')
    settings.insert_json5("listen/endpoints", f'["{endpoint}"]')
    settings.insert_json5("scouting/multicast/enabled", "false")
    until = time.monotonic() + DEADLINE
    with zenoh.open(settings) as session, tempfile.TemporaryDirectory() as state:
        inbox = Inbox(session)
        car = subprocess.Popen(
            [node, "run", "--source", "simulator", "--map", "club", "--car", CAR, "--connect", endpoint, "--state", state],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
        )
        try:
            follow(session, inbox, until)
        finally:
            car.terminate()
            try:
                car.wait(10)
            except subprocess.TimeoutExpired:
                car.kill()
                car.wait()


def ask(session, topic, message, payload):
    """The one reply to a query."""
    replies = [reply for reply in session.get(f"synpf/v1/{CAR}/{topic}", payload=payload, timeout=8.0)]
    check(len(replies) == 1 and replies[0].ok, f"one reply to {topic}")
    return wire.read(message, replies[0].ok.payload)


def follow(session, inbox, until):
    def localized(messages):
        return next((h for h in reversed(messages.get("health", [])) if h[1]["state"] == "localized"), None)

    _, health = inbox.wait("the car is localized", localized, until)
    metrics = health["metrics"]
    check(0.5 < metrics["alignment"] <= 1.0, f"alignment {metrics['alignment']:.2f}")
    check(metrics["particles"] > 0 and 0.0 < metrics["ess_ratio"] <= 1.0, f"{metrics['particles']} particles")

    # From here on: before that the pose is on its way.
    begin = len(inbox.messages["pose"])
    messages = inbox.wait(f"{POSES} poses", lambda got: len(got["pose"]) >= begin + POSES and dict(got), until)
    poses, truths = messages["pose"][begin : begin + POSES], messages["recorded/truth"]
    errors, numbers = [], [header.sequence for header, _ in poses]
    for header, pose in poses:
        true = interpolate(truths, header.sensor)
        if true:
            errors.append(math.dist(true, (pose["pose"]["x"], pose["pose"]["y"])))
    check(len(errors) > POSES / 2, f"{len(errors)} poses have a true one beside them")
    check(max(errors) < NEAR, f"poses are at most {100 * max(errors):.1f} cm off the true ones")
    way = math.dist(*((p["pose"]["x"], p["pose"]["y"]) for _, p in (poses[0], poses[-1])))
    check(way > 1.0, f"the car has moved: {way:.1f} m between the first and the last pose")
    check(all(a < b for a, b in zip(numbers, numbers[1:])), "sequence numbers go up")
    run_id = poses[0][0].run_id
    check(all(header.run_id == run_id for header, _ in poses), "one run")
    check(0 <= time.time() * 1e9 - run_id < 1e9 * DEADLINE, "the run id is the time of the car's start")
    header, pose = poses[-1]
    check(pose["track"] is not None and abs(pose["track"]["d"]) < 1.0, "the car is near its raceline")
    check(0 < header.published - header.sensor < 2e9, "published after it was measured")

    now = time.time_ns()
    _, clock = ask(session, "clock", wire.CLOCK_REPLY, wire.clock_request(now))
    check(clock["sent"] == now and now <= clock["received"] <= clock["answered"] <= time.time_ns(), "the clock is this machine's")

    header, reply = ask(session, "missing", wire.MISSING_REPLY, wire.missing_request(now, run_id, [("event", [(1, 1)])]))
    check(header.run_id == run_id, "the reply about missing messages is of this run")
    kept = {stream["topic"]: stream for stream in reply["streams"]}
    check(kept["recorded/truth"]["last"] >= len(truths) and kept["event"]["first"] == 1, "what the car keeps")
    first_header, first = wire.read(wire.EVENT, reply["messages"][0]["bytes"])
    check(first_header.sequence == 1, f"the first event once more: {first['kind']['kind']}")

    identity = random.getrandbits(128)
    command = wire.select_command(now, identity, "ci", "lq")
    _, answer = ask(session, "cmd/params", wire.ANSWER, command)
    check(answer["id"] == identity and answer["outcome"]["kind"] == "done", "a command is done")
    check(answer["set"]["name"] == "lq", "the set in force is lq")
    _, again = ask(session, "cmd/params", wire.ANSWER, command)
    check(again == answer, "the same command gets the same answer")

    def switched(messages):
        kinds = [event for _, event in messages.get("event", []) if event["command"] == identity]
        return next((event for event in kinds if event["kind"]["kind"] == "parameters_changed"), None)

    event = inbox.wait("the event of the switch", switched, until)
    check(event["who"] == "ci" and event["kind"]["to"]["name"] == "lq", "the event names who and what")


if __name__ == "__main__":
    print("the page and the golden bytes")
    check_page()
    print("a running car")
    check_car(sys.argv[1])
    print("wire format: read as docs/wire-format.md says")
