"""What a pit wall shows over bad links: a table, made by trying.

    python3 .ci/links.py PATH/TO/car-node PATH/TO/pitwall [--long] [--write docs/links.md]

A car and a pit wall with keys, each in a network namespace, on the radio of slow_link.py: cuts, slow links, loss, bursts, and programs that
are killed and started again. Each row says how soon the pit wall said BLIND, how soon it was live again, how old the poses were, and what was
missing in the end of what must be complete. A row fails where BLIND or live takes longer than 3 s, or health or events stay missing.
--long adds a cut of 120 s. Needs root and /dev/net/tun; where it cannot have them, it says so and ends with 0.
"""

import argparse
import contextlib
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time

from slow_link import PORT, WALL, Lines, ip, sides

GOOD = (50e6, 0.002, 0.0)
# BLIND and live again within this time [s]. A pit wall that restarts needs a moment of its own.
SOON = 3.0
RESTART = 10.0


class Bench:
    """A car and a pit wall that can be killed and started again."""

    def __init__(self, stack, node, wall):
        self.node, self.program = node, wall
        tag = f"lnk{os.getpid() % 10000}"
        self.radio, self.car_side, self.wall_side = sides(stack, tag)
        self.link(*GOOD)
        self.radio.start()
        self.folder = stack.enter_context(tempfile.TemporaryDirectory())
        subprocess.run([wall, "keys", "new", "--folder", self.folder, "--pit", "pit", "--car", "car-1", "--viewer", "fan"], check=True,
                       capture_output=True)
        self.car = self.wall = self.views = None
        self.others = []
        stack.callback(self.stop)

    def link(self, rate, delay, loss):
        self.radio.rate, self.radio.delay, self.radio.loss = rate, delay, loss

    def spawn(self, space, *words):
        return subprocess.Popen(["ip", "netns", "exec", space, *words], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True)

    def start_car(self):
        self.car = self.spawn(self.car_side, self.node, "run", "--source", "simulator", "--map", "club", "--car", "car-1",
                              "--keys", f"{self.folder}/car-1.keys", "--connect", f"tls/{WALL}:{PORT}", "--state", f"{self.folder}/state")

    def start_wall(self):
        self.wall = self.spawn(self.wall_side, self.program, "--json", "--keys", f"{self.folder}/pit.keys",
                               "--listen", f"tls/{WALL}:{PORT}", "--listen", f"tls/127.0.0.1:{PORT}", "watch", "--rate", "10")
        self.views = Lines(self.wall)

    def start_other(self, space, keys, address):
        """Another pit wall or viewer, which joins the first one. Returns its views."""
        process = self.spawn(space, self.program, "--json", "--keys", f"{self.folder}/{keys}.keys",
                             "--connect", f"tls/{address}:{PORT}", "watch", "--rate", "10")
        self.others.append(process)
        return Lines(process)

    def stop(self):
        self.radio.ended = True
        for process in (self.car, self.wall, *self.others):
            if process:
                process.kill()
                process.wait()

    def cars(self, since, until=None, views=None):
        """Views of the car, with their time, from `since` on."""
        for when, view in list((views or self.views).seen):
            if when >= since and (until is None or when <= until):
                for car in view:
                    if car["car"] == "car-1":
                        yield when, car

    def first(self, since, condition, patience, views=None):
        """Time from `since` to the first view that is so; None when there is none in time."""
        deadline = since + patience
        while time.monotonic() < deadline:
            for when, car in self.cars(since, views=views):
                if condition(car):
                    return when - since
            time.sleep(0.05)
        return None

    def command(self):
        """Time of a command, in seconds; None when it is not executed."""
        began = time.monotonic()
        process = self.spawn(self.wall_side, self.program, "--json", "--keys", f"{self.folder}/pit.keys",
                             "--connect", f"tls/127.0.0.1:{PORT}", "rates", "car-1")
        process.communicate(timeout=40)
        return time.monotonic() - began if process.returncode == 0 else None


def live(car):
    age = (car["pose"] or {}).get("age_s", 99)
    return car["alive"] and not car["blind"] and age < 1.0


def blind(car):
    return car["blind"]


def missing(car):
    return sum(stream["missing"] for topic, stream in car["streams"].items() if topic in ("health", "event"))


def cut(bench, seconds):
    bench.radio.out = True
    began = time.monotonic()
    dark = bench.first(began, blind, max(seconds, SOON)) if seconds > 1 else None
    time.sleep(max(0.0, began + seconds - time.monotonic()))
    bench.radio.out = False
    return {"blind": dark, "live": bench.first(time.monotonic(), live, 20.0), "expect_blind": seconds > 2, "soon": SOON}


def bad(bench, rate, delay, loss, seconds=25.0):
    bench.link(rate, delay, loss)
    began = time.monotonic()
    time.sleep(seconds / 2)
    command = bench.command()
    time.sleep(max(0.0, began + seconds - time.monotonic()))
    settled = [car for _, car in bench.cars(began + seconds / 2)]
    bench.link(*GOOD)
    return row_of(settled, command, bench.first(time.monotonic(), live, 20.0))


def row_of(views, command, back):
    ages = [car["pose"]["age_s"] for car in views if car["pose"] and not car["blind"]]
    rates = [car["streams"]["pose"]["rate_hz"] for car in views if "pose" in car["streams"]]
    return {
        "live": back,
        "age": statistics.median(ages) if ages else None,
        "worst": sorted(ages)[int(0.95 * len(ages))] if ages else None,
        "rate": statistics.median(rates) if rates else None,
        "dark": sum(map(blind, views)) / len(views) if views else None,
        "command": command,
        "soon": SOON,
    }


def bursts(bench, seconds=20.0):
    began = time.monotonic()
    while time.monotonic() < began + seconds:
        bench.radio.out = True
        time.sleep(0.4)
        bench.radio.out = False
        time.sleep(1.2)
    views = [car for _, car in bench.cars(began + 3)]
    return row_of(views, bench.command(), bench.first(time.monotonic(), live, 20.0))


def wall_killed(bench):
    bench.wall.send_signal(signal.SIGKILL)
    bench.wall.wait()
    time.sleep(2)
    bench.start_wall()
    return {"live": bench.first(time.monotonic(), live, 30.0), "soon": RESTART}


def car_killed(bench):
    bench.car.send_signal(signal.SIGKILL)
    bench.car.wait()
    began = time.monotonic()
    dark = bench.first(began, blind, 5.0)
    bench.start_car()
    # What a killed program had not sent is lost.
    return {"blind": dark, "expect_blind": True, "live": bench.first(began + (dark or 0.0) + 0.5, live, 30.0), "soon": RESTART,
            "may_lack": True}


def both_killed(bench):
    for process in (bench.car, bench.wall):
        process.send_signal(signal.SIGKILL)
        process.wait()
    bench.start_wall()
    bench.start_car()
    return {"live": bench.first(time.monotonic(), live, 40.0), "soon": RESTART}


def roaming(bench):
    """The car gets another address, as behind another access point."""
    other = "10.77.0.9"
    name = bench.radio.names[0]
    ip("-n", bench.car_side, "addr", "flush", "dev", name)
    ip("-n", bench.car_side, "addr", "add", other, "peer", WALL, "dev", name)
    ip("-n", bench.wall_side, "route", "replace", other, "dev", bench.radio.names[1])
    began = time.monotonic()
    dark = bench.first(began, blind, 8.0)
    return {"blind": dark, "expect_blind": False, "live": bench.first(began + (dark or 0.0), live, 30.0), "soon": RESTART}


def seen_by_another(bench, space, keys, address, seconds=30):
    """A cut, as a second pit wall or a viewer sees it."""
    views = bench.start_other(space, keys, address)
    if bench.first(time.monotonic(), live, 30.0, views) is None:
        return {"live": None, "soon": SOON}
    bench.radio.out = True
    began = time.monotonic()
    dark = bench.first(began, blind, SOON + 1, views)
    time.sleep(max(0.0, began + seconds - time.monotonic()))
    bench.radio.out = False
    row = {"blind": dark, "expect_blind": True, "live": bench.first(time.monotonic(), live, 20.0, views), "soon": SOON}
    process = bench.others.pop()
    process.kill()
    process.wait()
    return row


ROWS = [
    ("cut of 1 s", lambda bench: cut(bench, 1)),
    ("cut of 5 s", lambda bench: cut(bench, 5)),
    ("cut of 30 s", lambda bench: cut(bench, 30)),
    ("600 kbit/s, 20 ms", lambda bench: bad(bench, 600e3, 0.020, 0.0)),
    ("150 kbit/s, 20 ms", lambda bench: bad(bench, 150e3, 0.020, 0.0)),
    ("20 Mbit/s, 5 ms, 20 % lost", lambda bench: bad(bench, 20e6, 0.005, 0.20)),
    ("bursts: 0.4 s out of 1.6 s nothing", bursts),
    ("car gets another address", roaming),
    ("second pit wall, cut of 30 s", lambda bench: seen_by_another(bench, bench.wall_side, "pit", "127.0.0.1")),
    ("viewer beyond the radio, cut of 30 s", lambda bench: seen_by_another(bench, bench.car_side, "fan", WALL)),
    ("pit wall and its router killed", wall_killed),
    ("car killed", car_killed),
    ("both killed", both_killed),
]
LONG = [("cut of 120 s", lambda bench: cut(bench, 120))]


def number(value, form="{:.1f}", none="-"):
    return none if value is None else form.format(value)


HEAD = "| link | BLIND after [s] | live again after [s] | pose age, median and 95 % [s] | poses/s | BLIND share | command [s] | missing |"


def line(name, row):
    ages = f"{number(row.get('age'), '{:.2f}')} {number(row.get('worst'), '{:.2f}')}" if "age" in row else "-"
    share = number(row.get("dark"), "{:.0%}")
    return (f"| {name} | {number(row.get('blind'))} | {number(row.get('live'))} | {ages} | {number(row.get('rate'), '{:.0f}')} | {share} "
            f"| {number(row.get('command'))} | {row['missing']} |")


def faults_of(name, row):
    faults = []
    if row.get("expect_blind") and (row.get("blind") is None or row["blind"] > SOON):
        faults.append(f"{name}: BLIND after {number(row.get('blind'))} s")
    if row.get("live") is None or row["live"] > row["soon"]:
        faults.append(f"{name}: live after {number(row.get('live'))} s")
    if row["missing"] and not row.get("may_lack"):
        faults.append(f"{name}: {row['missing']} of health and events missing")
    return faults


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("node")
    parser.add_argument("wall")
    parser.add_argument("--long", action="store_true")
    parser.add_argument("--write")
    arguments = parser.parse_args()
    with contextlib.ExitStack() as stack:
        try:
            bench = Bench(stack, arguments.node, arguments.wall)
        except (OSError, subprocess.CalledProcessError) as error:
            print(f"links: skipped: no namespaces or TUN devices here: {getattr(error, 'stderr', None) or error}")
            return 0
        bench.start_wall()
        bench.start_car()
        if bench.first(time.monotonic(), live, 60.0) is None:
            print("links: the car was never seen")
            return 1
        time.sleep(3)
        table, faults = [HEAD, "|---|---|---|---|---|---|---|---|"], []
        print(*table, sep="\n", flush=True)
        for name, measure in ROWS + (LONG if arguments.long else []):
            row = measure(bench)
            # Gaps are filled after the link is back.
            whole = bench.first(time.monotonic(), lambda car: missing(car) == 0, 20.0)
            row["missing"] = 0 if whole is not None else max(missing(car) for _, car in bench.cars(time.monotonic() - 2))
            table.append(line(name, row))
            faults += faults_of(name, row)
            print(table[-1], flush=True)
            time.sleep(2)
    if arguments.write:
        write(arguments.write, table)
    print(*faults, sep="\n")
    return 1 if faults else 0


def write(path, table):
    """Replaces the table in a Markdown file."""
    with open(path) as file:
        text = file.read()
    before, rest = text.split("<!-- table -->\n", 1)
    _, after = rest.split("<!-- end -->\n", 1)
    with open(path, "w") as file:
        file.write(before + "<!-- table -->\n\n" + "\n".join(table) + "\n\n<!-- end -->\n" + after)


if __name__ == "__main__":
    sys.exit(main())
