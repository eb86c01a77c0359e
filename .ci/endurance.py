"""Faults at random for a while: memory, file handles, threads and logs of the programs must stay what they are.

    python3 .ci/endurance.py PATH/TO/car-node PATH/TO/pitwall [--for SECONDS] [--seed N] [--json]

A pit wall with its page and a recording, three simulated cars, and a second pit wall. Car-1 and the first pit wall run all the time; car-1
is behind a link of its own. Every second or two comes one of these faults:

- the link of car-1 is closed, or carries nothing for up to six seconds;
- car-2 or the second pit wall is killed and starts again;
- the wall clock of car-1 or of the pit wall steps by up to a minute, and back (a library between them and the system does that; without a C compiler
  this fault is left out);
- the disk of the recordings is full for a moment (a small tmpfs; without root this fault is left out);
- random bytes and half-open connections on both ports; with the Python package eclipse-zenoh also random bytes on keys of cars, in their names.

In the end car-1 is live, none of its health and events is missing, the page answers, and a recording can be started.
"""

import argparse
import contextlib
import json
import os
import random
import shutil
import signal
import socket
import statistics
import struct
import subprocess
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.request

sys.path.insert(0, os.path.dirname(__file__))
from scale import Page, cpu, free_port, handles, memory, spawn, wait  # noqa: E402

# Each sample is of a moment with faults under way. What is flat differs by no more than this. A car keeps what it sent, up to 24 MB of scans
# and 10 MB of each other stream, and a pit wall what its page shows: these fill up for a while.
MOST_GROWTH = 1.10
MORE_MEMORY = 30.0  # MB
MORE_HANDLES = 12
# Of each program, for each fault [bytes].
LOG_PER_FAULT = 3000

SHIM = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <time.h>
#include <unistd.h>
static volatile long *offset;
__attribute__((constructor)) static void start(void) {
    const char *path = getenv("CLOCK_OFFSET");
    int fd = path ? open(path, O_RDONLY) : -1;
    if (fd < 0) return;
    void *at = mmap(0, sizeof(long), PROT_READ, MAP_SHARED, fd, 0);
    close(fd);
    if (at != MAP_FAILED) offset = at;
}
int clock_gettime(clockid_t clock, struct timespec *now) {
    static int (*real)(clockid_t, struct timespec *);
    if (!real) real = (int (*)(clockid_t, struct timespec *))dlsym(RTLD_NEXT, "clock_gettime");
    int result = real(clock, now);
    if (result == 0 && clock == CLOCK_REALTIME && offset) now->tv_sec += *offset;
    return result;
}
"""


class Clock:
    """The wall clock of a program, which can be set."""

    def __init__(self, library, path):
        with open(path, "wb") as file:
            file.write(struct.pack("l", 0))
        self.path = path
        self.environment = {"LD_PRELOAD": library, "CLOCK_OFFSET": path}

    def step(self, seconds):
        with open(self.path, "r+b") as file:
            file.write(struct.pack("l", seconds))


class Relay(threading.Thread):
    """A link to a port of this machine: it can be closed, or carry nothing."""

    def __init__(self, to):
        super().__init__(daemon=True)
        self.to, self.still, self.pairs = to, False, set()
        self.server = socket.create_server(("127.0.0.1", 0))
        self.port = self.server.getsockname()[1]
        self.start()

    def run(self):
        while True:
            near, _ = self.server.accept()
            try:
                far = socket.create_connection(("127.0.0.1", self.to), 2)
            except OSError:
                near.close()
                continue
            self.pairs.add((near, far))
            for a, b in ((near, far), (far, near)):
                threading.Thread(target=self.carry, args=(a, b, (near, far)), daemon=True).start()

    def carry(self, source, sink, pair):
        source.settimeout(None)
        with contextlib.suppress(OSError):
            while data := source.recv(16384):
                while self.still:
                    time.sleep(0.05)
                sink.sendall(data)
        self.end(pair)

    def end(self, pair):
        self.pairs.discard(pair)
        for end in pair:
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()

    def close_all(self):
        for pair in list(self.pairs):
            self.end(pair)


class Field:
    """The programs, and the faults that hit them."""

    def __init__(self, stack, arguments):
        self.stack, self.arguments = stack, arguments
        self.dice = random.Random(arguments.seed)
        self.folder = stack.enter_context(tempfile.TemporaryDirectory())
        self.port, self.page_port = free_port(), free_port()
        self.logs = {}
        library = self.shim()
        self.clocks = {name: Clock(library, f"{self.folder}/{name}.clock") for name in ("wall", "car-1")} if library else {}
        self.disk = self.small_disk()
        self.wall = self.start("wall", arguments.pitwall, "--listen", f"tcp/127.0.0.1:{self.port}", "--page", f"127.0.0.1:{self.page_port}",
                               "--recordings", self.disk or self.folder)
        wait("the page", lambda: socket.create_connection(("127.0.0.1", self.page_port), 1).close() is None)
        self.link = Relay(self.port)
        self.cars = {"car-1": self.start_car("car-1", self.link.port), "car-2": self.start_car("car-2", self.port),
                     "car-3": self.start_car("car-3", self.port)}
        self.second = self.start_second()
        self.page = Page(self.page_port)
        self.stranger = self.open_stranger()

    def start(self, name, *words):
        log = open(f"{self.folder}/{name}.log", "ab")
        self.logs[name] = log.name
        clock = self.clocks.get(name)
        return spawn(self.stack, *words, stdout=log, stderr=log, env={**os.environ, **(clock.environment if clock else {})})

    def start_car(self, name, port):
        return self.start(name, self.arguments.node, "run", "--source", "simulator", "--map", "club", "--car", name, "--connect",
                          f"tcp/127.0.0.1:{port}", "--state", f"{self.folder}/{name}", "--seed", name[-1])

    def start_second(self):
        # Its output is of no interest.
        return spawn(self.stack, self.arguments.pitwall, "--json", "--connect", f"tcp/127.0.0.1:{self.port}", "watch", "--rate", "2",
                     stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def shim(self):
        source, library = f"{self.folder}/clock.c", f"{self.folder}/clock.so"
        if not shutil.which("cc"):
            return None
        with open(source, "w") as file:
            file.write(SHIM)
        built = subprocess.run(["cc", "-shared", "-fPIC", "-O1", "-o", library, source, "-ldl"], capture_output=True, check=False)
        return library if built.returncode == 0 else None

    def small_disk(self):
        disk = f"{self.folder}/disk"
        os.mkdir(disk)
        if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=24m", "tmpfs", disk], capture_output=True, check=False).returncode:
            return None
        self.stack.callback(subprocess.run, ["umount", "-l", disk], capture_output=True)
        return disk

    def open_stranger(self):
        try:
            import zenoh  # noqa: PLC0415: it is there or not
        except ImportError:
            return None
        config = zenoh.Config()
        for key, value in (("mode", '"client"'), ("connect/endpoints", f'["tcp/127.0.0.1:{self.port}"]'),
                           ("scouting/multicast/enabled", "false"), ("connect/exit_on_failure", "false")):
            config.insert_json5(key, value)
        return zenoh.open(config)

    def post(self, path, content):
        request = urllib.request.Request(f"http://127.0.0.1:{self.page_port}{path}", json.dumps(content).encode(),
                                         {"content-type": "application/json", "Origin": f"http://127.0.0.1:{self.page_port}"})
        try:
            # The end of a recording waits for what cars still have, also for a car whose link is down.
            with urllib.request.urlopen(request, timeout=60) as reply:
                return reply.status
        except urllib.error.HTTPError as error:
            return error.code
        except OSError as error:
            print(f"  {path}: {error}", flush=True)
            return None

    def car(self, name="car-1"):
        return next(car for car in self.page.last["cars"] if car["car"] == name)

    # The faults.

    def link_closed(self):
        self.link.close_all()

    def link_silent(self):
        self.link.still = True
        time.sleep(self.dice.uniform(0.3, 6.0))
        self.link.still = False

    def car_killed(self):
        self.cars["car-2"].send_signal(signal.SIGKILL)
        self.cars["car-2"].wait()
        self.cars["car-2"] = self.start_car("car-2", self.port)

    def second_wall_killed(self):
        self.second.send_signal(signal.SIGKILL)
        self.second.wait()
        self.second = self.start_second()

    def clock_steps(self):
        clock = self.dice.choice(list(self.clocks.values()))
        clock.step(self.dice.choice([-60, -5, 5, 60]))
        time.sleep(self.dice.uniform(0.5, 2.0))
        clock.step(0)

    def disk_full(self):
        filler = f"{self.disk}/filler"
        with contextlib.suppress(OSError), open(filler, "wb") as file:
            while True:
                file.write(bytes(1 << 16))
        time.sleep(self.dice.uniform(0.5, 2.0))
        os.remove(filler)

    def recording_toggled(self):
        self.post("/record", {"on": True, "folder": None, "operator": "ana"})
        time.sleep(1.0)
        self.post("/record", {"on": False, "folder": None, "operator": "ana"})
        # The disk is small.
        for name in os.listdir(self.disk or self.folder):
            if name.endswith(".mcap") and not self.page.last.get("recording"):
                with contextlib.suppress(OSError):
                    os.remove(f"{self.disk or self.folder}/{name}")

    def bytes_on_ports(self):
        for port in (self.port, self.page_port):
            for _ in range(self.dice.randint(1, 20)):
                with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1) as end:
                    end.sendall(self.dice.randbytes(self.dice.randint(1, 4000)))

    def half_open(self):
        held = []
        for _ in range(60):
            with contextlib.suppress(OSError):
                held.append(socket.create_connection(("127.0.0.1", self.dice.choice([self.port, self.page_port])), 1))
        time.sleep(self.dice.uniform(0.2, 4.0))
        for end in held:
            end.close()

    def bytes_on_keys(self):
        topics = ["pose", "health", "event", "cloud", "load", "params", "recorded/scan", "link", "missing", "cmd/pose", "alive", "nonsense"]
        for _ in range(50):
            name = self.dice.choice(["car-1", "car-3", f"ghost-{self.dice.randint(0, 999)}", "<b>x</b>", "\x1b]0;x"])
            with contextlib.suppress(Exception):
                self.stranger.put(f"synpf/v1/{name}/{self.dice.choice(topics)}", self.dice.randbytes(self.dice.randint(0, 3000)))

    def faults(self):
        faults = [self.link_closed, self.link_silent, self.car_killed, self.second_wall_killed, self.recording_toggled, self.bytes_on_ports,
                  self.half_open]
        if self.clocks:
            faults.append(self.clock_steps)
        if self.disk:
            faults.append(self.disk_full)
        if self.stranger:
            faults.append(self.bytes_on_keys)
        return faults

    def watched(self):
        return {"pit wall": self.wall.pid, "car-1": self.cars["car-1"].pid}

    def sample(self):
        return {name: {"memory": memory(pid), "handles": handles(pid), "threads": len(os.listdir(f"/proc/{pid}/task"))}
                for name, pid in self.watched().items()}


def names_of_threads(pid):
    names = []
    for task in os.listdir(f"/proc/{pid}/task"):
        with contextlib.suppress(OSError), open(f"/proc/{pid}/task/{task}/comm") as file:
            names.append(file.read().strip())
    return sorted(names)


# Threads that a pool starts and ends by need.
POOLS = ("tokio-", "app-", "net-", "rx-", "tx-", "acc-", "recover", "fetch", "close")


def own(names):
    return [name for name in names if not name.startswith(POOLS)]


def verdicts(samples, logs, faults_done):
    """What is not flat. The first half of the time is for warming up."""
    found = []
    settled = samples[len(samples) // 2:]
    half = len(settled) // 2
    for name in samples[0]:
        def part(rows, what, name=name):
            return statistics.median(row[name][what] for row in rows)

        early, late = part(settled[:half], "memory"), part(settled[half:], "memory")
        if late > early * MOST_GROWTH + MORE_MEMORY:
            found.append(f"{name}: memory grows from {early:.0f} to {late:.0f} MB")
        early, late = part(settled[:half], "handles"), part(settled[half:], "handles")
        if late > early + MORE_HANDLES:
            found.append(f"{name}: file handles grow from {early:.0f} to {late:.0f}")
    for name, size in logs.items():
        if size > LOG_PER_FAULT * max(faults_done, 10):
            found.append(f"{name}: {size} bytes of log for {faults_done} faults")
    return found


def run(arguments, stack):
    field = Field(stack, arguments)
    wait("three live cars", lambda: sum(car["alive"] and not car["blind"] for car in field.page.last["cars"]) >= 3)
    time.sleep(2)
    threads = {name: own(names_of_threads(pid)) for name, pid in field.watched().items()}
    busy = {name: cpu(pid) for name, pid in field.watched().items()}
    began, count, samples, done = time.monotonic(), 0, [], {}
    kinds, order = field.faults(), []
    while time.monotonic() - began < arguments.seconds:
        # Every kind in each round.
        if not order:
            order = field.dice.sample(kinds, len(kinds))
        fault = order.pop()
        fault()
        done[fault.__name__] = done.get(fault.__name__, 0) + 1
        count += 1
        for name, pid in field.watched().items():
            if not os.path.exists(f"/proc/{pid}"):
                return field, [f"{name} has ended after {fault.__name__}"], {}
        samples.append(field.sample())
        if arguments.long and count % 20 == 0:
            print(f"{time.monotonic() - began:.0f} s, {count} faults: {samples[-1]}", flush=True)
        time.sleep(field.dice.uniform(0.1, 1.0))
    passed = time.monotonic() - began
    found = []

    def whole():
        car = field.car()
        streams = car["streams"]
        return car["alive"] and not car["blind"] and not any(streams.get(topic, {"missing": 0})["missing"] for topic in ("health", "event"))

    try:
        wait("car-1 live and whole", whole, 60)
    except RuntimeError as error:
        car = field.car()
        found.append(f"{error}: alive {car['alive']}, blind {car['blind']}, "
                     f"missing {({topic: stream['missing'] for topic, stream in car['streams'].items()})}")
    try:
        wait("a recording starts", lambda: field.post("/record", {"on": True, "folder": None, "operator": "ana"}) == 200
             or field.page.last.get("recording"), 60)
    except RuntimeError as error:
        found.append(str(error))
    for name, pid in field.watched().items():
        lost = list(threads[name])
        for thread in own(names_of_threads(pid)):
            with contextlib.suppress(ValueError):
                lost.remove(thread)
        if lost:
            found.append(f"{name} has lost threads: {', '.join(lost)}")
    logs = {name: os.path.getsize(path) for name, path in field.logs.items()}
    found += verdicts(samples, logs, count)
    figures = {"seconds": passed, "faults": done, "half way": samples[len(samples) // 2], "in the end": samples[-1], "log_bytes": logs,
               "cores": {name: (cpu(pid) - busy[name]) / passed for name, pid in field.watched().items()}}
    return field, found, figures


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("node")
    parser.add_argument("pitwall")
    parser.add_argument("--for", dest="seconds", type=float, default=35)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    arguments.long = arguments.seconds > 300 and not arguments.json
    # Ended from outside, it cleans up too.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("ended"))
    with contextlib.ExitStack() as stack:
        field, found, figures = run(arguments, stack)
        if found:
            for name, path in field.logs.items():
                with open(path, errors="replace") as file:
                    tail = file.read()[-1500:]
                print(f"---- {name}:\n{tail}")
    if arguments.json:
        print(json.dumps({"figures": figures, "faults": found}))
    elif figures:
        print(f"{figures['seconds']:.0f} s, {sum(figures['faults'].values())} faults: "
              + ", ".join(f"{name} {times}" for name, times in sorted(figures["faults"].items())))
        for name, after in figures["in the end"].items():
            half = figures["half way"][name]
            print(f"  {name}: memory {half['memory']:.0f} then {after['memory']:.0f} MB, handles {half['handles']} then {after['handles']}, "
                  f"threads {half['threads']} then {after['threads']}, {figures['cores'][name]:.2f} cores, "
                  f"log {figures['log_bytes'].get('wall' if name == 'pit wall' else name, 0)} bytes")
    for fault in found:
        print(f"endurance: {fault}")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
