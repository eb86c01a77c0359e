"""Reads and writes the messages of docs/wire-format.md. Needs nothing but Python.

    header, health = read(HEALTH, payload_of_a_zenoh_sample)

A type here is a function that takes a `Reader` and returns a value. Structs become dictionaries; an enum's value is the
name of its variant, or a dictionary `{"kind": name, ...}` where its variants have fields.
"""

import struct
from collections import namedtuple

HEADER_LEN = 40
Header = namedtuple("Header", "schema version run_id sequence sensor published")
Message = namedtuple("Message", "name schema versions layout")


class Malformed(ValueError):
    """Bytes that are not the message they should be."""


class Reader:
    def __init__(self, data):
        self.data, self.at = bytes(data), 0

    def take(self, count):
        if count > len(self.data) - self.at:
            raise Malformed(f"{count} bytes needed at {self.at}, {len(self.data) - self.at} left")
        self.at += count
        return self.data[self.at - count : self.at]


# The rules of the payload.


def number(code):
    size = struct.calcsize("<" + code)
    return lambda reader: struct.unpack("<" + code, reader.take(size))[0]


u8, u16, u32, u64 = map(number, "BHIQ")
i16, i64, f32, f64 = map(number, "hqfd")


def boolean(reader):
    value = u8(reader)
    if value > 1:
        raise Malformed(f"{value} is no bool")
    return value == 1


def text(reader):
    return reader.take(u64(reader)).decode()


def octets(reader):
    return reader.take(u64(reader))


def option(of):
    return lambda reader: of(reader) if boolean(reader) else None


def array(count, of):
    return lambda reader: [of(reader) for _ in range(count)]


def several(of):
    return lambda reader: array(u64(reader), of)(reader)


def record(**fields):
    return lambda reader: {name: of(reader) for name, of in fields.items()}


def enum(*variants, tag=u32):
    """Variants in the order of the wire: a name, or a name with its content."""

    def read_enum(reader):
        index = tag(reader)
        if index >= len(variants):
            raise Malformed(f"unknown variant {index}: the sender is newer")
        variant = variants[index]
        if isinstance(variant, str):
            return variant
        name, of = variant
        content = of(reader)
        return {"kind": name, **content} if isinstance(content, dict) else {"kind": name, "value": content}

    return read_enum


def command_id(reader):
    return int.from_bytes(reader.take(16), "little")


# The messages.

TOPICS = (
    "alive pose cloud scan health load params event recorded/pose recorded/health recorded/odometry recorded/scan "
    "recorded/truth map info clock cmd/params cmd/pose cmd/relocalize cmd/rates cmd/auto shadow link missing "
    "files cmd/record"
).split()
STATES = "init converging localized degraded lost relocalizing stale".split()
CAUSES = (
    "no_initial_pose new_pose alignment residual long_beams occluded no_return effective_sample_size likelihood "
    "spread_along spread_across second_mode slip yaw_rate innovation age no_scan no_odometry bad_sensor_data searching "
    "odometry_jump gyro_in_degrees gyro_flipped gyro_bias gyro_ignored gyro_always_zero odometry_turn_scale "
    "odometry_turn_bias odometry_turn_wrong twist_from_pose pose_from_twist wheel_scale creep wheels_slide "
    "sweep_from_scan_time time_increment_wrong range_max_wrong angle_increment_missing scan_lag repeated_scans "
    "clock_step map_differs odometry_stands"
).split()

pose2 = record(x=f64, y=f64, heading=f64)
twist2 = record(linear_x=f64, linear_y=f64, angular=f64)
topic = enum(*TOPICS)
state = enum(*STATES)
cause = record(
    kind=enum(*CAUSES), severity=enum("info", "warning", "critical"), value=option(f32), limit=option(f32)
)
set_ref = record(name=text, revision=u64)
value = enum(("bool", boolean), ("int", i64), ("float", f64), ("text", text))
recorder = record(
    recording=boolean, file=u64, bytes=u64, limit=u64, free=u64, dropped=u64, error=option(text)
)
rates = record(pose=f32, cloud=f32, scan=f32, health=f32, recorded=boolean)
METRICS = (
    "alignment residual short_beams long_beams no_return ess_ratio w_ratio spread_along spread_across second_mode slip "
    "yaw_rate_residual innovation innovation_angle age_p50 age_p99"
).split()

POSE = Message(
    "pose", 1, {1},
    record(
        pose=pose2,
        twist=twist2,
        covariance=record(xx=f32, xy=f32, xh=f32, yy=f32, yh=f32, hh=f32),
        track=option(record(s=f64, d=f64)),
        lap=u32,
        update=u64,
        kind=enum("updated", "predicted"),
    ),
)  # fmt: skip

HEALTH = Message(
    "health", 4, {1, 2, 3},
    record(
        state=state,
        since=i64,
        causes=several(cause),
        update=u64,
        metrics=option(record(**dict.fromkeys(METRICS, f32), particles=u32)),
        proposal=option(record(set=text, evidence=text, since=i64)),
        auto=boolean,
    ),
)  # fmt: skip

event_kind = enum(
    ("started", record(version=text)),
    ("stopping", record(reason=text)),
    ("state_changed", record(**{"from": state, "to": state, "causes": several(cause)})),
    ("parameters_changed", record(**{"from": set_ref, "to": set_ref, "update": u64, "revert_after": option(f32)})),
    ("parameters_confirmed", record(set=set_ref)),
    ("parameters_fell_back", record(**{"from": set_ref, "to": set_ref, "update": u64})),
    ("set_stored", record(**{"name": text, "from": text, "changes": several(record(key=text, before=value, after=value))})),
    ("set_deleted", record(name=text)),
    ("pose_initialized", record(before=option(pose2), pose=pose2)),
    "search_started",
    ("relocalized", record(pose=pose2)),
    ("lap", record(lap=u32, time=option(f64), set=text)),
    ("slip_started", record(slip=f32)),
    ("slip_ended", record(worst=f32, duration=f32)),
    ("proposed", record(set=text, evidence=text)),
    ("auto_changed", record(on=boolean)),
    ("rates_changed", record(**{"from": rates, "to": rates})),
    ("command_refused", record(faults=several(text))),
    "source_ended",
    ("warning", record(text=text)),
    ("error", record(text=text)),
    ("shadow_started", record(set=text)),
    ("shadow_ended", record(set=text)),
    ("shadow_dropped", record(set=text, evidence=text)),
    ("rates_lowered", record(transit=f32, pose=f32, recorded=boolean)),
    "rates_restored",
    ("recording_started", record(file=u64)),
    ("recording_ended", record(reason=text)),
)
EVENT = Message(
    "event", 7, {3},
    record(kind=event_kind, update=u64, who=option(text), command=option(command_id)),
)  # fmt: skip

ODOMETRY = Message("odometry", 8, {1}, record(pose=pose2, twist=twist2))
TRUTH = Message("truth", 10, {1}, record(pose=pose2, twist=twist2))

CLOCK_REPLY = Message("clock_reply", 14, {1}, record(sent=i64, received=i64, answered=i64))
MISSING_REPLY = Message(
    "missing_reply", 20, {1},
    record(
        streams=several(record(topic=topic, first=u64, last=u64)),
        messages=several(record(topic=topic, bytes=octets)),
    ),
)  # fmt: skip

parameter_set = record(name=text, values=several(lambda reader: (text(reader), value(reader))))
outcome = enum(
    (
        "done",
        record(
            update=option(u64),
            reply=enum(
                "nothing",
                ("sets", several(record(set=parameter_set, built_in=boolean, who=option(text)))),
                ("candidates", several(record(number=u32, pose=pose2, score=f32))),
                ("rates", rates),
                ("recorder", recorder),
            ),
        ),
    ),
    ("refused", record(faults=several(text))),
    ("stale_revision", record(expected=u64, who=text)),
)
ANSWER = Message("answer", 16, {1}, record(id=command_id, outcome=outcome, set=set_ref))


def read_header(data):
    if len(data) < HEADER_LEN or data[:4] != b"SYPF":
        raise Malformed("no header")
    return Header(*struct.unpack("<HHQQqq", data[4:HEADER_LEN]))


def read(message, data):
    """The header and the content of a message. Every byte must be used."""
    data = bytes(data)
    header = read_header(data)
    if header.schema != message.schema:
        raise Malformed(f"schema {header.schema} is not a {message.name}")
    if header.version not in message.versions:
        raise Malformed(f"{message.name} of version {header.version}")
    reader = Reader(data[HEADER_LEN:])
    content = message.layout(reader)
    if reader.at != len(reader.data):
        raise Malformed(f"{message.name} ends after {reader.at} of {len(reader.data)} bytes")
    return header, content


# Questions and commands.


def header_bytes(schema, now, version=1):
    """In questions and commands nothing is counted: run and sequence number are 0."""
    return b"SYPF" + struct.pack("<HHQQqq", schema, version, 0, 0, now, now)


def clock_request(now):
    return header_bytes(13, now) + struct.pack("<q", now)


def missing_request(now, run_id, wanted, budget=16_000):
    """`wanted`: pairs of a topic's name and its ranges `(from, to)`, the most urgent first."""
    body = struct.pack("<QQ", run_id, len(wanted))
    for name, ranges in wanted:
        body += struct.pack("<IQ", TOPICS.index(name), len(ranges))
        body += b"".join(struct.pack("<QQ", *bounds) for bounds in ranges)
    return header_bytes(19, now) + body + struct.pack("<I", budget)


def select_command(now, identity, operator, name):
    """Puts a set of the car in force; goes under cmd/params."""

    def string(value):
        return struct.pack("<Q", len(value.encode())) + value.encode()

    action = struct.pack("<II", 0, 0) + string(name) + b"\0"  # Action::Params, Select, no revert_after_ms.
    return header_bytes(15, now) + identity.to_bytes(16, "little") + string(operator) + b"\0" + action
