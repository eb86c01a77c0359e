"""Ends a recorder at many moments: `kill -9`, and a power cut that loses what was not synced. Slow; for `.ci/run --heavy`.

    python .ci/recorder_kills.py PITWALL CAR_NODE [MOMENTS]

Needs Python's mcap. What a killed recorder has lost is counted against another one, which records the same session to its end: the
time from the last message in the killed one's file to the last that the other had by then.

A power cut is simulated from the system calls of the recorder, as strace reports them: a copy of the file is made of what had
been written at the last sync before the cut, and of random whole pages of what was written after it, as a disk may leave them.
Every file must recover, with at most a second of the recording gone, and nothing else damaged.
"""

import bisect
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from mcap.reader import make_reader

PAGE = 4096
MOST_LOST = 1.0  # [s]


def check(condition, text):
    if not condition:
        sys.exit(f"FAILED  {text}")


class Session:
    """A simulated car, and recorders that come and go."""

    def __init__(self, pitwall, car_node, folder, port):
        self.pitwall, self.folder = pitwall, folder
        self.endpoint = f"tcp/127.0.0.1:{port}"
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self.wall = subprocess.Popen(
            [pitwall, "--listen", self.endpoint, "--page", "127.0.0.1:0", "--recordings", folder], **quiet)
        self.car = subprocess.Popen(
            [car_node, "run", "--source", "simulator", "--map", "club", "--car", "blue", "--connect", self.endpoint,
             "--state", folder / "state"], **quiet)

    def end(self):
        for process in (self.car, self.wall):
            process.terminate()
            process.wait(timeout=30)

    def recorder(self, file, *before, lasting="1h"):
        record = [self.pitwall, "--connect", self.endpoint, "record", "-o", file, "--for", lasting]
        return subprocess.Popen([*map(str, before), *record],
                                stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def arrivals(file):
    """When the messages of a file arrived [s]."""
    with open(file, "rb") as stream:
        return sorted(message.log_time * 1e-9 for _, channel, message in make_reader(stream).iter_messages(log_time_order=False)
                      if channel.message_encoding == "synpf-v1")


def recover(pitwall, file):
    """What recover says of a file, and when its last message arrived."""
    repaired = file.with_suffix(".repaired.mcap")
    repaired.unlink(missing_ok=True)
    done = subprocess.run([pitwall, "--json", "recover", file, "-o", repaired], capture_output=True, text=True, timeout=60)
    check(done.returncode in (0, 7), f"{file}: recover exits with {done.returncode}: {done.stderr}")
    report = subprocess.run([pitwall, "--json", "report", repaired], capture_output=True, text=True, timeout=60)
    check(report.returncode == 0, f"{repaired}: report exits with {report.returncode}: {report.stderr}")
    last = arrivals(repaired)[-1:]
    repaired.unlink()
    return json.loads(done.stdout), *last


def kills(session, moments):
    """The recorder is killed: what it had handed to the system stays."""
    reference = session.folder / "reference.mcap"
    whole = session.recorder(reference)
    while not reference.exists() or reference.stat().st_size < 40_000:
        check(whole.poll() is None, "the reference recorder runs")
        time.sleep(0.05)
    ends = []
    for moment in range(moments):
        file = session.folder / f"kill-{moment}.mcap"
        recorder = session.recorder(file)
        # The map alone has less.
        while not file.exists() or file.stat().st_size < 40_000:
            check(recorder.poll() is None, "the recorder runs")
            time.sleep(0.01)
        time.sleep(random.uniform(0.0, 1.5))
        recorder.send_signal(signal.SIGKILL)
        killed = time.time()
        recorder.wait()
        saved, last = recover(session.pitwall, file)
        check(all(damage["to"] is None for damage in saved["damage"]), f"kill {moment}: damaged before the end: {saved}")
        ends.append((killed, last))
        file.unlink()
    whole.send_signal(signal.SIGINT)
    whole.wait(timeout=60)
    all_arrivals = arrivals(reference)
    # What arrived at the moment of the kill may not have got into the other file, either.
    lost = sorted(all_arrivals[bisect.bisect(all_arrivals, killed) - 1] - last for killed, last in ends)
    print(f"{moments} kills: {lost[len(lost) // 2]:.2f} s gone in the median, {lost[-1]:.2f} s at most", flush=True)
    check(lost[-1] <= MOST_LOST, f"a killed recorder has lost {lost[-1]:.2f} s")
    print(f"ok      {moments} kills, at most {lost[-1]:.2f} s gone")


CALL = re.compile(r"(\d+\.\d+) (write|fdatasync|fsync|lseek)\((\d+)<([^>]*)>(?:.*)\) = (\d+)")


def power_cuts(session, moments):
    """One recording under strace, and a disk at each of many moments."""
    file, trace = session.folder / "cut.mcap", session.folder / "strace.txt"
    recorder = session.recorder(
        file, "strace", "-f", "-y", "-ttt", "-s", "0", "-e", "trace=write,fdatasync,fsync,lseek", "-o", trace, lasting="12s")
    recorder.wait(timeout=90)
    # The size of a chunk is filled in by going back to its begin.
    calls, size, place = [], 0, 0
    for line in trace.read_text().splitlines():
        found = CALL.search(line)
        if found and found[4].endswith("cut.mcap"):
            if found[2] == "lseek":
                place = int(found[5])
            elif found[2] == "write":
                place += int(found[5])
                size = max(size, place)
            calls.append((float(found[1]), found[2].endswith("sync") or found[2] == "fdatasync", size))
    syncs = [(at, size) for at, synced, size in calls if synced]
    check(len(syncs) > 20, f"strace saw {len(syncs)} syncs")
    content = file.read_bytes()
    worst, begin = 0.0, calls[0][0]
    for moment in range(moments):
        cut = random.uniform(syncs[3][0], syncs[-3][0])
        last = max(at for at, _ in syncs if at <= cut)
        durable = max(size for at, size in syncs if at <= cut)
        written = max(size for at, _, size in calls if at <= cut)
        left = bytearray(content[:written])
        for page in range(durable, written, PAGE):
            if random.random() < 0.5:
                end = min(page + PAGE, written)
                left[page:end] = bytes(end - page)
        if random.random() < 0.3:
            del left[durable:]
        disk = session.folder / "disk.mcap"
        disk.write_bytes(left)
        saved, _ = recover(session.pitwall, disk)
        lost = cut - last
        worst = max(worst, lost)
        check(lost <= MOST_LOST, f"cut {moment}: {lost:.2f} s since the last sync")
        check(all(damage["to"] is None for damage in saved["damage"]), f"cut {moment}: damaged before the end: {saved}")
        check(saved["messages"] > 0 and saved["duration_s"] >= last - begin - 1.5, f"cut {moment}: {saved}")
    print(f"ok      {moments} power cuts, at most {worst:.2f} s gone")


def main(pitwall, car_node, moments):
    random.seed(7)
    with tempfile.TemporaryDirectory() as name:
        session = Session(pitwall, car_node, Path(name), 27462)
        try:
            time.sleep(2)
            kills(session, moments)
            if shutil.which("strace"):
                power_cuts(session, moments)
            else:
                print("power cuts: skipped, there is no strace")
        finally:
            session.end()


if __name__ == "__main__":
    os.environ.setdefault("RUST_LOG", "warn")
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]) if len(sys.argv) > 3 else 100)
