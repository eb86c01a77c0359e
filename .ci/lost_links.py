"""Sessions over a link that is cut, with a car that records on its own disk: what is missing before fetch and merge, and after.

    python .ci/lost_links.py PITWALL CAR_NODE [--long]

A car and a laptop, each in a network namespace, on the radio of slow_link.py. The link is cut for a while; in some sessions the car is
killed meanwhile and started again. Then the laptop's recording ends, and `pitwall check` must name exactly what the car has on its disk
and the laptop has not. After `pitwall fetch` and `pitwall merge`, `check` must find nothing missing but what the killed car itself has
lost, which is at most a second, and no message may be there twice. The numbers are counted here, from the headers of the messages.

Usually cuts of 5 s and of 10 s with a reboot. --long: 5, 30 and 60 s, 5 and 20 minutes, 30 s and 5 minutes with a reboot, all in real
time. Needs root, /dev/net/tun and Python's mcap; where there are no namespaces, it says so and ends with 0.
"""

import argparse
import concurrent.futures
import contextlib
import json
import os
import re
import signal
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader

from slow_link import PORT, WALL, Lines, sides

SHORT = [(5, False), (10, True)]
LONG = [(1200, False), (300, True), (300, False), (60, False), (30, True), (30, False), (5, False)]
GOOD = (50e6, 0.002, 0.0)
NAME = "car-1"
# What the car itself may lose when its power is cut [s].
MOST_LOST = 1.0
# Sessions at once.
AT_ONCE = 3


class Fault(Exception):
    pass


def check(holds, fault):
    if not holds:
        raise Fault(fault)


class Session:
    def __init__(self, stack, pitwall, car_node, number):
        self.pitwall, self.car_node = pitwall, car_node
        tag = f"cut{os.getpid() % 10000}{number}"
        self.radio, self.car_side, self.wall_side = sides(stack, tag)
        self.radio.rate, self.radio.delay, self.radio.loss = GOOD
        self.radio.start()
        self.folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        self.running = []
        stack.callback(self.stop)

    def start(self, space, *words):
        process = subprocess.Popen(["ip", "netns", "exec", space, *map(str, words)], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                                   stderr=subprocess.DEVNULL, text=True)
        self.running.append(process)
        return process

    def stop(self):
        self.radio.ended = True
        for process in self.running:
            process.kill()
            process.wait()

    def start_car(self):
        return self.start(self.car_side, self.car_node, "run", "--source", "simulator", "--map", "club", "--car", NAME, "--connect",
                          f"tcp/{WALL}:{PORT}", "--state", self.folder / "state", "--record", self.disk)

    @property
    def disk(self):
        return self.folder / "disk"

    def at_the_wall(self, *words):
        return [self.pitwall, "--json", "--insecure", "--connect", f"tcp/127.0.0.1:{PORT}", *words]

    def command(self, *words, codes=(0,), patience=600):
        process = self.start(self.wall_side, *words)
        said, _ = process.communicate(timeout=patience)
        check(process.returncode in codes, f"{' '.join(map(str, words[1:]))}: exit code {process.returncode}: {said[-2000:]}")
        return process.returncode, said


def numbers(files):
    """How often each number of each stream and run is there, and when the last message of each run was published [s]."""
    counts, last = {}, {}
    for file in files:
        with open(file, "rb") as stream, contextlib.suppress(McapError, EOFError, struct.error):
            for _, channel, message in NonSeekingReader(stream).iter_messages(log_time_order=False):
                found = re.fullmatch(rf"synpf/v1/{NAME}/(.+)", channel.topic)
                if not found or len(message.data) < 40 or message.data[:4] != b"SYPF":
                    continue
                run, number, _, published = struct.unpack_from("<QQqq", message.data, 8)
                topic = found[1].replace("/", "_")
                counts.setdefault((topic, run), Counter())[number] += 1
                last[run] = max(last.get(run, 0.0), published * 1e-9)
    return counts, last


def named(outcome):
    """The numbers that `pitwall check` says are missing."""
    gaps = {}
    for stream in outcome["cars"][0]["streams"]:
        if stream["required"]:
            for gap in stream["gaps"]:
                first, until = gap["numbers"]
                gaps.setdefault((stream["topic"], gap["run_id"]), set()).update(range(first, until + 1))
    return gaps


def drive(session, seconds, reboot):
    session.start(session.wall_side, session.pitwall, "--json", "--insecure", "--listen", f"tcp/{WALL}:{PORT}", "--listen",
                  f"tcp/127.0.0.1:{PORT}", "router")
    time.sleep(1)
    laptop, whole, fetched = (session.folder / name for name in ("laptop.mcap", "whole.mcap", "fetched"))
    record = session.start(session.wall_side, *session.at_the_wall("record", "-o", laptop))
    car = session.start_car()
    views = Lines(session.start(session.wall_side, *session.at_the_wall("watch", "--rate", "10")))

    def live(view):
        car = next((car for car in view if car["car"] == NAME), None)
        return car and car["alive"] and not car["blind"] and (car["pose"] or {}).get("age_s", 99) < 1.0

    def wait_live(patience):
        began = time.monotonic()
        while time.monotonic() < began + patience:
            when, view = views.seen[-1] if views.seen else (0.0, [])
            if when > began and live(view):
                return time.monotonic() - began
            time.sleep(0.1)
        raise Fault(f"the car is not seen within {patience} s")

    wait_live(90)
    time.sleep(6)
    session.radio.out = True
    killed = None
    if reboot:
        time.sleep(seconds * 0.6)
        killed = time.time()
        car.send_signal(signal.SIGKILL)
        car.wait()
        time.sleep(1)
        session.start_car()
        time.sleep(max(0.0, seconds * 0.4 - 1))
    else:
        time.sleep(seconds)
    session.radio.out = False
    back = wait_live(120)
    time.sleep(6)
    record.send_signal(signal.SIGINT)
    record.communicate(timeout=90)
    check(record.returncode == 0, f"record: exit code {record.returncode}")

    _, said = session.command(session.pitwall, "--json", "check", laptop, codes=(0, 7))
    before = json.loads(said)
    # A disk that is slow to close the file is given more time: the car then says that it did not answer, and goes on closing.
    for _ in range(6):
        code, said = session.command(*session.at_the_wall("record", "--on-car", NAME, "--stop"), codes=(0, 3))
        if code == 0:
            break
        time.sleep(2)
    check(code == 0, f"the car does not stop its recording: {said[-400:]}")
    began = time.monotonic()
    session.command(*session.at_the_wall("fetch", NAME, "--to", fetched, "--rate", "4M"), patience=2400)
    took = time.monotonic() - began
    ages = [car["pose"]["age_s"] for when, view in views.seen if when > began for car in view if car["car"] == NAME and car["pose"]]
    ages.sort()
    session.command(session.pitwall, "--json", "merge", laptop, fetched, "-o", whole)
    code, said = session.command(session.pitwall, "--json", "check", whole, codes=(0, 7, 8))
    after = json.loads(said)

    # The car's disk is read here, not over the link.
    on_car, last = numbers(sorted(session.disk.glob("*.mcap")))
    at_wall, last_at_wall = numbers([laptop])
    merged, _ = numbers([whole])
    required = {stream["topic"] for stream in before["cars"][0]["streams"] if stream["required"]}
    runs = {run["run_id"]: run for run in before["cars"][0]["runs"]}
    gaps = named(before)
    unknown = 0
    for (topic, run), have in on_car.items():
        if topic not in required:
            continue
        seen = at_wall.get((topic, run), Counter())
        if run not in runs:
            raise Fault(f"run {run} is not in the laptop's recording")
        first_run = run == min(runs)
        begin = min(seen, default=1) if first_run else 1
        end = max(seen, default=0)
        holes = {number for number in have if begin <= number < end and number not in seen}
        said = gaps.get((topic, run), set())
        check(holes <= said, f"{topic}: {len(holes - said)} missing messages are not named before fetch")
        check(not said & set(seen), f"{topic}: messages are called missing that are there")
        beyond = {number for number in said if number > end}
        check(said == holes | beyond and beyond <= set(have), f"{topic}: numbers are called missing that were never sent")
        tail = [number for number in have if number > end]
        if runs[run]["end"] is None:
            unknown += len(tail)
    lost = 0.0
    if reboot:
        old = min(last)
        check(runs[old]["end"] is None and not before["complete"], "before fetch, the end of the killed run is called known")
        at, until = runs[old]["to_s"], runs[old]["next_s"]
        check(until is not None and until - at > 0.3 * seconds, f"the hole of the killed run, {at} s to {until} s, is too short")
        lost = killed - max(last[old], last_at_wall.get(old, 0.0))
        check(lost <= MOST_LOST, f"the killed car has lost {lost:.2f} s")
    check(code == (8 if reboot else 0), f"check of the merged file: exit code {code}: {json.dumps(after)[:600]}")
    check(not any(named(after).values()), "after merge, something is missing")
    for key, have in merged.items():
        check(max(have.values()) == 1, f"{key}: a message is there twice")
        both = set(on_car.get(key, ())) | set(at_wall.get(key, ()))
        check(set(have) == both, f"{key}: {len(both - set(have))} messages are not in the merged file")
    count = lambda counts: sum(len(have) for (topic, _), have in counts.items() if topic in required)
    return (f"| {seconds} s{', rebooted' if reboot else ''} | {back:.0f} | {count(merged)} | {count(at_wall)} | "
            f"{sum(map(len, gaps.values()))} | {unknown} | 0 | {f'{lost:.2f} s' if reboot else '-'} | {took:.0f} s | "
            f"{statistics.median(ages) * 1e3:.0f}, {ages[int(0.95 * len(ages))] * 1e3:.0f} ms |")


def attempt(pitwall, car_node, number, seconds, reboot):
    with contextlib.ExitStack() as stack:
        try:
            session = Session(stack, pitwall, car_node, number)
        except (OSError, subprocess.CalledProcessError) as error:
            return None, f"no namespaces or TUN devices here: {getattr(error, 'stderr', None) or error}"
        try:
            line = drive(session, seconds, reboot)
            print(line, flush=True)
            return True, line
        except (Fault, subprocess.TimeoutExpired) as fault:
            print(f"FAULT   cut of {seconds} s{', rebooted' if reboot else ''}: {fault}", flush=True)
            return False, str(fault)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("pitwall")
    parser.add_argument("car_node")
    parser.add_argument("--long", action="store_true")
    options = parser.parse_args()
    print("| cut | live again after [s] | published | at the laptop | named as missing | beyond an end that is not known | missing after "
          "merge | lost by the car | fetch | pose age meanwhile, median and 95 % |\n|---|---|---|---|---|---|---|---|---|---|", flush=True)
    with concurrent.futures.ThreadPoolExecutor(AT_ONCE) as pool:
        cases = LONG if options.long else SHORT
        done = [pool.submit(attempt, options.pitwall, options.car_node, number, *case) for number, case in enumerate(cases)]
        outcomes = [one.result() for one in done]
    if any(outcome is None for outcome, _ in outcomes):
        print(f"lost links: skipped: {outcomes[0][1]}")
        return 0
    return 0 if all(outcome for outcome, _ in outcomes) else 1


if __name__ == "__main__":
    os.environ.setdefault("RUST_LOG", "error")
    sys.exit(main())
