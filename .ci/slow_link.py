"""A car and a pit wall, each in a network namespace of its own, on a slow radio between them, and then without it.

    python3 .ci/slow_link.py PATH/TO/car-node PATH/TO/pitwall [LOSS [DELAY]]

The radio is made here, of two TUN devices: a rate, a delay, packets lost at random, and an outage. 1 Mbit/s, 50 ms and 5 %
are worse than a noisy WiFi, which sends again by itself what it loses; TCP (cubic, what most systems use) gets some
0.4 Mbit/s through, a third of what a car at full rate sends. What is checked: commands are answered, and without a link
said not to be; the pit wall says BLIND and recovers; no health and no event is missing in the end; the recording names what
it does not hold, and once the radio is good it holds the full-rate streams, too; the filter misses no update, unless the
machine has no time for it. Needs root and /dev/net/tun; where it cannot have them, it says so and ends with 0.
`unshare -Urn` gives a user both.
"""

import contextlib
import fcntl
import heapq
import itertools
import json
import os
import random
import select
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import time

RATE = 1e6  # bit/s
DELAY = 0.050  # s, each way
LOSS = 0.05  # share of the packets
QUEUE = 0.200  # s of the rate: what waits longer is dropped, as a radio's driver does
OUTAGE = 5.0  # s
GOOD = (50e6, 0.002, 0.0)  # rate, delay and loss of a good radio
CAR, WALL = "10.77.0.1", "10.77.0.2"
PORT = 7447
# Streams of which in the end nothing may be missing.
WHOLE = ("health", "event", *(f"recorded_{stream}" for stream in ("pose", "health", "odometry", "scan", "truth")))
# The car takes so long to send everything again once the radio is good [s].
SETTLE = 8.0
# Bounded, whatever hangs.
LONGEST = 120

# What most systems use; where the kernel does not allow it, the one that is most like it.
USUAL_CONGESTION_CONTROL = "cd /proc/sys/net/ipv4 && { echo cubic > tcp_congestion_control || echo reno > tcp_congestion_control; }"
# A machine that is busier than this has no time for the filter, whatever the link does.
BUSY = 0.85

TUNSETIFF, IFF_TUN_NO_PI = 0x400454CA, 0x1001


class Radio(threading.Thread):
    """Carries packets between two TUN devices."""

    def __init__(self, tag):
        super().__init__(daemon=True)
        self.names = [f"{tag}c", f"{tag}w"]
        self.ends = [tun(name) for name in self.names]
        self.out = self.ended = False
        self.rate, self.delay, self.loss = RATE, DELAY, LOSS
        self.carried = self.lost = 0

    def become_good(self):
        self.rate, self.delay, self.loss = GOOD

    def run(self):
        dice = random.Random(1)
        count = itertools.count()
        due, free = [], [0.0, 0.0]
        while not self.ended:
            wait = max(0.0, due[0][0] - time.monotonic()) if due else 0.1
            readable, _, _ = select.select(self.ends, [], [], min(wait, 0.1))
            now = time.monotonic()
            for end in readable:
                try:
                    packet = os.read(end, 4096)
                except OSError:
                    return  # Its namespace is gone, and the check is over.
                side = self.ends.index(end)
                began = max(now, free[side])
                if self.out or dice.random() < self.loss or began - now > QUEUE:
                    self.lost += 1
                    continue
                free[side] = began + 8 * len(packet) / self.rate
                heapq.heappush(due, (free[side] + self.delay, next(count), self.ends[1 - side], packet))
            while due and due[0][0] <= time.monotonic():
                _, _, end, packet = heapq.heappop(due)
                if not self.out:
                    with contextlib.suppress(OSError):
                        os.write(end, packet)
                        self.carried += 1


def tun(name):
    end = os.open("/dev/net/tun", os.O_RDWR)
    fcntl.ioctl(end, TUNSETIFF, struct.pack("16sH", name.encode(), IFF_TUN_NO_PI))
    return end


def ip(*words):
    subprocess.run(["ip", *words], check=True, capture_output=True, text=True)


class Lines(threading.Thread):
    """What a program writes, a JSON object a line, with the time at which it came."""

    def __init__(self, process):
        super().__init__(daemon=True)
        self.stream, self.seen = process.stdout, []
        self.start()

    def run(self):
        for line in self.stream:
            with contextlib.suppress(ValueError):
                self.seen.append((time.monotonic(), json.loads(line)))

    def wait(self, what, condition, patience):
        """Waits for a view that is as it should be; None when there is none in time."""
        began, at = time.monotonic(), len(self.seen)
        while time.monotonic() < began + patience:
            for when, view in self.seen[at:]:
                at += 1
                if condition(view):
                    print(f"  {what} after {when - began:.1f} s", flush=True)
                    return view
            time.sleep(0.05)
        print(f"  {what}: not within {patience} s", flush=True)
        return None


def sides(stack, tag):
    """A radio between two network namespaces, and their names: the car's and the pit wall's. `stack` removes them."""
    car_side, wall_side = f"{tag}-car", f"{tag}-wall"
    radio = Radio(tag)
    for space in (car_side, wall_side):
        ip("netns", "add", space)
        stack.callback(subprocess.run, ["ip", "netns", "del", space], capture_output=True)
    for name, space, own, other in zip(radio.names, (car_side, wall_side), (CAR, WALL), (WALL, CAR)):
        ip("link", "set", name, "netns", space)
        ip("-n", space, "addr", "add", own, "peer", other, "dev", name)
        ip("-n", space, "link", "set", name, "up")
        ip("-n", space, "link", "set", "lo", "up")
        # Whatever this system uses by itself: some get through loss what others do not.
        with contextlib.suppress(subprocess.CalledProcessError):
            ip("netns", "exec", space, "sh", "-c", USUAL_CONGESTION_CONTROL)
    return radio, car_side, wall_side


def skip(why):
    print(f"slow link: skipped: {why}")
    return 0


def main(node, wall):
    if not shutil.which("ip"):
        return skip("no `ip` here (Debian's iproute2)")
    tag = f"slow{os.getpid() % 10000}"
    with contextlib.ExitStack() as stack:
        try:
            radio, car_side, wall_side = sides(stack, tag)
        except (OSError, subprocess.CalledProcessError) as error:
            return skip(f"no namespaces or TUN devices here: {getattr(error, 'stderr', None) or error}")
        radio.start()
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        started = []

        @stack.callback
        def stop():
            radio.ended = True
            for process in started:
                process.kill()
                process.wait()

        def start(space, *words):
            process = subprocess.Popen(
                ["ip", "netns", "exec", space, *words], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True
            )
            started.append(process)
            return process

        # Ended from outside, it cleans up too.
        signal.signal(signal.SIGTERM, lambda *_: sys.exit("ended"))
        alarm = threading.Timer(LONGEST, lambda: os.kill(os.getpid(), signal.SIGINT))
        alarm.daemon = True
        alarm.start()
        stack.callback(alarm.cancel)
        return drive(radio, start, node, wall, car_side, wall_side, folder)


def loads(views):
    """What the car has said of its load."""
    cars = (next((car for car in view if car["car"] == "car-1"), {}) for _, view in views.seen)
    return [car["load"] for car in cars if car.get("load")]


def drive(radio, start, node, wall, car_side, wall_side, folder):
    faults = []

    def check(holds, fault):
        if not holds:
            print(f"  FAULT: {fault}", flush=True)
            faults.append(fault)

    record = start(
        wall_side, wall, "--json", "--insecure", "--listen", f"tcp/{WALL}:{PORT}", "--listen", f"tcp/127.0.0.1:{PORT}",
        "record", "-o", f"{folder}/race.mcap",
    )  # fmt: skip
    start(
        car_side, node, "run", "--source", "simulator", "--map", "club", "--car", "car-1",
        "--connect", f"tcp/{WALL}:{PORT}", "--state", f"{folder}/state",
    )  # fmt: skip
    here = ["--connect", f"tcp/127.0.0.1:{PORT}"]
    time.sleep(1)
    views = Lines(start(wall_side, wall, "--json", *here, "watch", "--rate", "10"))

    def car(view):
        return next((car for car in view if car["car"] == "car-1"), None)

    def command(*words):
        began = time.monotonic()
        process = start(wall_side, wall, "--json", *here, "--operator", "ana", *words)
        said, _ = process.communicate(timeout=30)
        return process.returncode, said, time.monotonic() - began

    first = views.wait("localized", lambda view: (car(view) or {}).get("state") == "LOCALIZED", 30)
    check(first, "the car was never localized")
    print(f"on the slow link: {RATE / 1e6:.0f} Mbit/s, {DELAY * 1e3:.0f} ms each way, {LOSS:.0%} lost", flush=True)

    def select(name):
        """As an operator would: who gets no answer gives the command again."""
        for _ in range(3):
            code, said, took = command("params", "car-1", "select", name)
            print(f"  select {name}: exit code {code} after {took:.1f} s", flush=True)
            if code == 0:
                return
        check(False, f"select {name} ended with {code}: {said}")

    for name in ("lq", "hq"):
        select(name)
    # Down for a while: first there is no answer, then nobody to ask.
    print(f"nothing gets through for {OUTAGE:.0f} s", flush=True)
    radio.out = True
    cut = time.monotonic()
    code, said, took = command("params", "car-1", "select", "lq")
    print(f"  select lq: exit code {code} after {took:.1f} s", flush=True)
    check(code in (4, 5), f"select lq without a link ended with {code}: {said}")
    blind = views.wait("BLIND", lambda view: car(view)["blind"] and car(view)["state"] == "BLIND", 4)
    check(blind, "the pit wall did not say BLIND")
    time.sleep(max(0.0, cut + OUTAGE - time.monotonic()))
    radio.out = False
    print("the link is back", flush=True)
    back = views.wait("seen again", lambda view: car(view)["alive"] and not car(view)["blind"], 15)
    check(back, "the pit wall did not see the car again")
    select("lq")

    def whole(view):
        return all(car(view)["streams"][topic]["missing"] == 0 for topic in ("health", "event"))

    last = views.wait("no health and no event missing", whole, 20)
    check(last, "health or events are missing")
    last = car(last or views.seen[-1][1])
    load = last["load"]
    print(f"  updates {load['update_rate']:.1f}/s of scans {load['scan_rate']:.1f}/s, drops {load['drops']}")
    cores = [sum(load["cpu_cores"]) / len(load["cpu_cores"]) for load in loads(views)]
    busy = sum(cores) / len(cores)
    print(f"  the machine was busy for {busy:.0%}")
    # Telemetry is what may be dropped; a scan is not. An update or two may be under way when the load is read.
    lost = {cause: count for cause, count in load["drops"].items() if count and cause != "telemetry"}
    behind = load["update_rate"] < load["scan_rate"] - 2.5
    if busy < BUSY:
        check(not lost, f"the filter has missed input: {lost}")
        check(not behind, "fewer updates than scans")
    elif lost or behind:
        print("  too busy for the filter: that it has missed input says nothing about the link")
    print("the radio is good now", flush=True)
    radio.become_good()
    time.sleep(SETTLE)
    record.send_signal(signal.SIGINT)
    said, _ = record.communicate(timeout=40)
    summary = json.loads(said)
    print(f"the recording, with {radio.carried} packets carried and {radio.lost} lost:")
    for stream in summary["streams"]:
        topic, first, last, received, missing = (
            stream[word] for word in ("topic", "first", "last", "received", "missing")
        )
        late = stream["filled_late"]
        print(f"  {topic:<18} {first} to {last}: {received} received, {late} of them late, {missing} missing")
        check(received + missing == last - first + 1, f"{topic}: the sum is wrong")
        check(missing == 0 or topic not in WHOLE, f"{topic}: {missing} missing")
    return faults


if __name__ == "__main__":
    node, wall, *link = sys.argv[1:]
    LOSS, DELAY = (*map(float, link), *(LOSS, DELAY)[len(link) :])
    found = main(node, wall)
    if found:
        print(f"slow link: {len(found)} faults", *found, sep="\n  ")
    sys.exit(1 if found else 0)
