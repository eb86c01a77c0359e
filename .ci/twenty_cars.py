"""Twenty cars at full rate, and one recorder: what it costs, and that nothing is lost.

    .ci/twenty_cars.py PITWALL TEST_CAR [--minutes 10] [--cars 20]

PITWALL should be a release build. TEST_CAR is the bin `test-car` of the tests, which sends what real cars send: poses, health,
odometry, truth and scans of 1081 beams 40 times a second, and the live views. Checked: `pitwall check` finds nothing missing, the
recorder takes less than half a core, and its memory does not grow after the first minute. CPU time is that of the recorder's
process. It is also the router of the cars. Where the machine has no time for so many cars, they send less; so the cost of a message
is what counts, multiplied by the messages of twenty cars.
"""

import argparse
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

MOST_CORES = 0.5
# The kernel and the allocator take a while to settle [MB].
MOST_GROWTH = 30
# Messages a second of one car: five full-rate streams, poses, health and two views, and a little more.
RATE = 5 * 40 + 40 + 3 * 10 + 2.5


def cpu_seconds(pid):
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def memory(pid):
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) / 1e3
    return 0.0


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("pitwall")
    parser.add_argument("test_car")
    parser.add_argument("--minutes", type=float, default=10)
    parser.add_argument("--cars", type=int, default=20)
    options = parser.parse_args()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "session.mcap"
        record = subprocess.Popen([options.pitwall, "--json", "--listen", endpoint, "record", "-o", file], stdout=subprocess.PIPE, text=True,
                                  stderr=subprocess.DEVNULL)
        cars = subprocess.Popen([options.test_car, "rings", str(options.cars), endpoint, "full"], stdout=subprocess.DEVNULL,
                                stderr=subprocess.DEVNULL)
        try:
            time.sleep(10)
            begun, busy, samples, size = time.monotonic(), cpu_seconds(record.pid), [], file.stat().st_size
            print(f"{'time':>7} {'cores':>7} {'memory':>9} {'file':>9}   load {os.getloadavg()[0]:.0f}", flush=True)
            last, used = begun, busy
            while time.monotonic() < begun + 60 * options.minutes:
                time.sleep(min(30, 60 * options.minutes / 4))
                now, spent = time.monotonic(), cpu_seconds(record.pid)
                samples.append((now - begun, memory(record.pid)))
                print(f"{now - begun:5.0f} s {(spent - used) / (now - last):7.3f} {samples[-1][1]:6.0f} MB "
                      f"{file.stat().st_size / 1e6:6.0f} MB   load {os.getloadavg()[0]:.0f}", flush=True)
                last, used = now, spent
            seconds, spent = last - begun, used - busy
            written = (file.stat().st_size - size) / seconds
            record.send_signal(signal.SIGINT)
            said, _ = record.communicate(timeout=120)
        finally:
            cars.kill()
            cars.wait()
            record.kill()
            record.wait()
        if record.returncode != 0:
            sys.exit(f"FAILED  record exits with {record.returncode}")
        summary = json.loads(said)
        checked = subprocess.run([options.pitwall, "--json", "check", file], capture_output=True, text=True, timeout=1200)
        outcome = json.loads(checked.stdout)
    received = sum(stream["received"] for stream in summary["streams"])
    rate = received / summary["duration_s"]
    full = options.cars * RATE
    cost = spent / seconds / rate
    missing = sum(car["missing"] for car in outcome["cars"])
    settled = [mb for at, mb in samples if at > min(60, seconds / 3)]
    growth = settled[-1] - settled[0]
    print(f"{len(outcome['cars'])} cars, {seconds:.0f} s, {rate:.0f} messages/s of {full:.0f}, {written / 1e6:.2f} MB/s written")
    print(f"{spent / seconds:.3f} cores; {cost * 1e6:.1f} us a message, at full rate {cost * full:.3f} cores; wanted: {MOST_CORES} at most")
    print(f"memory {settled[-1]:.0f} MB, {growth:+.0f} MB since the first minute; wanted: {MOST_GROWTH} MB at most")
    print(f"{missing} messages missing, check exits with {checked.returncode}")
    faults = [
        (len(outcome["cars"]) != options.cars, "not every car is in the recording"),
        (missing or checked.returncode, "messages are missing"),
        (cost * full > MOST_CORES, "more than half a core"),
        (growth > MOST_GROWTH, "memory grows"),
    ]
    for is_fault, fault in faults:
        if is_fault:
            print(f"FAILED  {fault}")
    return 1 if any(is_fault for is_fault, _ in faults) else 0


if __name__ == "__main__":
    os.environ.setdefault("RUST_LOG", "error")
    sys.exit(main())
