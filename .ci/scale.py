"""What many cars cost: a pit wall, its page and a recorder, and two halls with routers of their own.

    python3 .ci/scale.py PATH/TO/pitwall PATH/TO/test-car [--cars 10,25,50] [--for 20] [--halls 200] [--write docs/scale.md] [--json]

Fake cars send everything at full rate, as a real car does, with 40 scans a second for the recorder. Cost is
processor time, so that a busy machine changes it little. Where the machine has no time for so many cars, they send less; cost is then
that of what came, times what would come at full rate. First the pit wall alone, then with one open page, which asks for snapshots as
fast as it gets them; then a recorder alone. Then light cars in two halls behind zenoh's routers with the configurations of
compose/scale/, and a pit wall at the centre. That part needs the Python package eclipse-zenoh, and is skipped without it.
"""

import argparse
import base64
import contextlib
import json
import os
import pathlib
import re
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request

from links import write

TICKS = os.sysconf("SC_CLK_TCK")
SCALE = pathlib.Path(__file__).parent.parent / "compose" / "scale"
# Less than a core for the whole of the largest fleet, and no message lost.
MOST_CORES = 1.0
# Messages a second of one car: poses, health and two views, and a little more; and with the five streams of a recorder.
LIVE = 40 + 3 * 10 + 2.5
RECORDED = LIVE + 5 * 40


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


def cpu(pid):
    """Processor time of a process [s]."""
    with open(f"/proc/{pid}/stat") as file:
        fields = file.read().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def memory(pid):
    """Resident memory [MB]."""
    with open(f"/proc/{pid}/status") as file:
        return int(re.search(r"VmRSS:\s+(\d+)", file.read())[1]) / 1e3


def handles(pid):
    return len(os.listdir(f"/proc/{pid}/fd"))


class Page(threading.Thread):
    """An open page without a browser: takes each snapshot and asks for the next."""

    def __init__(self, port):
        super().__init__(daemon=True)
        self.port, self.count, self.last, self.ended, self.bytes, self.connections = port, 0, None, False, 0, 0
        # Cars that were live in a snapshot.
        self.lively = set()
        self.connect()
        self.start()

    def connect(self):
        self.socket = socket.create_connection(("127.0.0.1", self.port), timeout=20)
        key = base64.b64encode(os.urandom(16)).decode()
        self.socket.sendall(
            f"GET /ws HTTP/1.1\r\nHost: 127.0.0.1:{self.port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\nOrigin: http://127.0.0.1:{self.port}\r\n\r\n".encode())
        self.stream = self.socket.makefile("rb")
        status = self.stream.readline()
        if b" 101 " not in status:
            raise OSError(f"the page answers {status}")
        while self.stream.readline().strip():
            pass
        self.connections += 1
        self.send({"select": None, "operator": None})

    def send(self, message):
        data, mask = json.dumps(message).encode(), os.urandom(4)
        head = bytes([0x81, 0x80 | len(data)]) if len(data) < 126 else struct.pack(">BBH", 0x81, 0xFE, len(data))
        self.socket.sendall(head + mask + bytes(byte ^ mask[i % 4] for i, byte in enumerate(data)))

    def run(self):
        """Like the real page it connects again when the connection ends."""
        while not self.ended:
            with contextlib.suppress(OSError, ValueError, struct.error):
                self.follow()
            while not self.ended:
                time.sleep(0.5)
                with contextlib.suppress(OSError, ValueError):
                    self.connect()
                    break

    def follow(self):
        while not self.ended:
            first, length = self.stream.read(2)
            if length == 126:
                (length,) = struct.unpack(">H", self.stream.read(2))
            elif length == 127:
                (length,) = struct.unpack(">Q", self.stream.read(8))
            data = self.stream.read(length)
            if first & 15 != 1:
                continue
            self.last = json.loads(data)
            self.lively |= {car["car"] for car in self.last["cars"] if car["alive"] and not car["blind"]}
            self.bytes += length
            self.count += 1
            self.send({"drawn": self.last["number"]})

    def close(self):
        self.ended = True
        self.socket.close()


def spawn(stack, *words, **options):
    process = subprocess.Popen([str(word) for word in words], stdin=subprocess.DEVNULL, **options)

    def stop():
        process.kill()
        process.wait()

    stack.callback(stop)
    return process


def start_cars(stack, test_car, kind, count, endpoint, *more, seconds=0):
    minutes = 10 + int(seconds / 60)
    return spawn(stack, test_car, kind, count, endpoint, *more, env={**os.environ, "TEST_CAR_MINUTES": str(minutes)})


def wait(what, condition, patience=120):
    deadline = time.monotonic() + patience
    while time.monotonic() < deadline:
        with contextlib.suppress(OSError, KeyError, TypeError):
            if condition():
                return
        time.sleep(0.2)
    raise RuntimeError(f"not within {patience} s: {what}")


def cost(process, seconds):
    """Cores over a while."""
    began, busy = time.monotonic(), cpu(process.pid)
    time.sleep(seconds)
    return (cpu(process.pid) - busy) / (time.monotonic() - began)


def received(page_port):
    """Messages that the pit wall has got."""
    with urllib.request.urlopen(f"http://127.0.0.1:{page_port}/snapshot", timeout=20) as reply:
        return sum(stream["received"] for car in json.load(reply)["cars"] for stream in car["streams"].values())


def missing(snapshot):
    return sum(stream["missing"] for car in snapshot["cars"] for stream in car["streams"].values())


def fleet(arguments, count):
    """The cost of `count` cars at full rate."""
    row = {"cars": count}
    with contextlib.ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        port, page_port = free_port(), free_port()
        wall = spawn(stack, arguments.pitwall, "--listen", f"tcp/127.0.0.1:{port}", "--page", f"127.0.0.1:{page_port}",
                     "--recordings", folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        wait("the page is there", lambda: socket.create_connection(("127.0.0.1", page_port), 1).close() is None)
        start_cars(stack, arguments.test_car, "rings", count, f"tcp/127.0.0.1:{port}", "full", seconds=4 * arguments.seconds)
        page = Page(page_port)
        wait(f"{count} cars", lambda: len(page.lively) >= count)
        page.close()
        time.sleep(3)
        full = count * LIVE
        came, since = received(page_port), time.monotonic()
        row["wall_cores"] = cost(wall, arguments.seconds)
        row["share"] = (received(page_port) - came) / (time.monotonic() - since) / full
        row["wall_cores"] /= row["share"]
        row["memory_mb"] = memory(wall.pid)
        page = Page(page_port)
        time.sleep(1)
        before, at = page.count, time.monotonic()
        lost = missing(page.last)
        came, since = received(page_port), time.monotonic()
        with_page = cost(wall, arguments.seconds)
        # Without the page it would cost what came now.
        share = (received(page_port) - came) / (time.monotonic() - since) / full
        row["page_cores"] = with_page - row["wall_cores"] * share
        row["snapshots_per_s"] = (page.count - before) / (time.monotonic() - at)
        row["snapshot_kb"] = page.bytes / page.count / 1e3
        row["missing"] = max(0, missing(page.last) - lost)
        row["growth_mb"] = memory(wall.pid) - row["memory_mb"]
        row["handles"] = handles(wall.pid)
        page.close()
    with contextlib.ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        port = free_port()
        recorder = spawn(stack, arguments.pitwall, "--json", "--listen", f"tcp/127.0.0.1:{port}", "record", "-o", f"{folder}/r.mcap",
                         stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        time.sleep(1)
        start_cars(stack, arguments.test_car, "rings", count, f"tcp/127.0.0.1:{port}", "full", seconds=4 * arguments.seconds)
        time.sleep(8)
        written, began = os.path.getsize(f"{folder}/r.mcap"), time.monotonic()
        row["recorder_cores"] = cost(recorder, arguments.seconds)
        row["recorder_kb_per_s"] = (os.path.getsize(f"{folder}/r.mcap") - written) / 1e3 / (time.monotonic() - began)
        row["recorder_memory_mb"] = memory(recorder.pid)
        recorder.send_signal(signal.SIGINT)
        said, _ = recorder.communicate(timeout=90)
        summary = json.loads(said)
        streams = summary["streams"]
        share = sum(stream["received"] for stream in streams) / summary["duration_s"] / (count * RECORDED)
        row["recorder_cores"] /= share
        row["recorder_kb_per_s"] /= share
        row["recorded"] = sum(stream["received"] for stream in streams)
        row["recorded_missing"] = sum(stream["missing"] for stream in streams)
    return row


ROUTER = """
import sys, time, zenoh
config = zenoh.Config.from_file(sys.argv[1])
for pair in sys.argv[2:]:
    key, value = pair.split("=", 1)
    config.insert_json5(key, value)
session = zenoh.open(config)
print("open", flush=True)
time.sleep(3600)
"""


def router(stack, file, *settings):
    process = spawn(stack, sys.executable, "-c", ROUTER, SCALE / file, *settings, stdout=subprocess.PIPE, text=True)
    if process.stdout.readline().strip() != "open":
        raise RuntimeError(f"no router with {file}")
    return process


def halls(arguments, count):
    """`count` light cars in two halls, and a pit wall at the centre."""
    with contextlib.ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        centre, page_port = free_port(), free_port()
        ports = [free_port(), free_port()]
        listen = 'listen/endpoints=["tcp/127.0.0.1:{}"]'
        # A library has no plugins.
        routers = {"centre": router(stack, "centre.json5", listen.format(centre), "plugins/storage_manager=null")}
        for name, port in zip("ab", ports):
            routers[f"hall {name}"] = router(stack, "hall.json5", listen.format(port), f'connect/endpoints=["tcp/127.0.0.1:{centre}"]')
        wall = spawn(stack, arguments.pitwall, "--connect", f"tcp/127.0.0.1:{centre}", "--page", f"127.0.0.1:{page_port}",
                     "--recordings", folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        for name, port in zip("ab", ports):
            start_cars(stack, arguments.test_car, "light", count // 2, f"tcp/127.0.0.1:{port}", f"hall-{name}")
        wait("the page is there", lambda: socket.create_connection(("127.0.0.1", page_port), 1).close() is None)
        page = Page(page_port)
        wait(f"{count} cars at the centre", lambda: len(page.lively) >= count, 180)
        page.lively = set()
        time.sleep(5)
        row = {"cars": count}
        busy, began = {name: cpu(process.pid) for name, process in routers.items()}, time.monotonic()
        before = page.count
        row["wall_cores"] = cost(wall, arguments.seconds)
        passed = time.monotonic() - began
        row["snapshots_per_s"] = (page.count - before) / passed
        row["routers"] = {name: {"cores": (cpu(process.pid) - busy[name]) / passed, "memory_mb": memory(process.pid)}
                          for name, process in routers.items()}
        row["memory_mb"] = memory(wall.pid)
        rates = [car["streams"].get("pose", {"rate_hz": 0})["rate_hz"] for car in page.last["cars"]]
        row["poses_per_s"], row["without_poses"] = sum(rates), sum(rate == 0 for rate in rates)
        row["live"] = len(page.lively)
        whole = [car["streams"].get(topic, {"missing": 0})["missing"] for car in page.last["cars"] for topic in ("health", "event")]
        row["missing"] = sum(whole)
        page.close()
    return row


def slope(rows, name):
    """Least squares: cost of no car, and of each."""
    count = len(rows)
    x = [row["cars"] for row in rows]
    y = [row[name] for row in rows]
    mean_x, mean_y = sum(x) / count, sum(y) / count
    spread = sum((value - mean_x) ** 2 for value in x)
    each = sum((a - mean_x) * (b - mean_y) for a, b in zip(x, y)) / spread if spread else mean_y / mean_x
    return mean_y - each * mean_x, each


HEAD = ["| cars | sent | pit wall [cores] | and a page | snapshots/s | recorder [cores] | memory [MB] | growth [MB] | missing | recorded | recorded, missing |",
        "|---|---|---|---|---|---|---|---|---|---|---|"]


def line(row):
    return (f"| {row['cars']} | {100 * row['share']:.0f} % | {row['wall_cores']:.2f} | {row['page_cores']:+.2f} | {row['snapshots_per_s']:.1f} | {row['recorder_cores']:.2f} "
            f"| {row['memory_mb']:.0f} | {row['growth_mb']:+.1f} | {row['missing']} | {row['recorded']} | {row['recorded_missing']} |")


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("pitwall")
    parser.add_argument("test_car")
    parser.add_argument("--cars", default="10,25,50")
    parser.add_argument("--for", dest="seconds", type=float, default=20)
    parser.add_argument("--halls", type=int, default=200)
    parser.add_argument("--page-rate", type=float, default=9.0, help="snapshots a second that a page must get; an overloaded machine gives it less")
    parser.add_argument("--write")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    rows, faults, out = [], [], []

    def say(text):
        out.append(text)
        if not arguments.json:
            print(text, flush=True)

    for text in HEAD:
        say(text)
    for count in map(int, filter(None, arguments.cars.split(","))):
        row = fleet(arguments, count)
        rows.append(row)
        say(line(row))
        if row["wall_cores"] + row["page_cores"] > MOST_CORES:
            faults.append(f"{count} cars: more than {MOST_CORES:.0f} core")
        if row["recorder_cores"] > MOST_CORES:
            faults.append(f"{count} cars: the recorder takes more than {MOST_CORES:.0f} core")
        if row["missing"] or row["recorded_missing"]:
            faults.append(f"{count} cars: {row['missing']} messages missing in the page, {row['recorded_missing']} in the recording")
        if row["snapshots_per_s"] < arguments.page_rate:
            faults.append(f"{count} cars: {row['snapshots_per_s']:.1f} snapshots a second")
    if len(rows) > 1:
        say("")
        for name, key in (("pit wall", "wall_cores"), ("page", "page_cores"), ("recorder", "recorder_cores")):
            base, each = slope(rows, key)
            say(f"- {name}: {1e3 * each:.1f} thousandths of a core for each car, and {base:.2f} cores")
        _, each = slope(rows, "memory_mb")
        say(f"- memory: {each:.1f} MB for each car; a recording grows by {rows[-1]['recorder_kb_per_s'] / rows[-1]['cars']:.0f} kB/s for each")
    hall = None
    if arguments.halls:
        try:
            import zenoh  # noqa: F401, PLC0415: it is there or not
        except ImportError:
            say("two halls: skipped, without the Python package eclipse-zenoh")
        else:
            hall = halls(arguments, arguments.halls)
            loads = ", ".join(f"{name} {load['cores']:.2f} cores and {load['memory_mb']:.0f} MB" for name, load in hall["routers"].items())
            say(f"- {hall['cars']} light cars in two halls: {hall['live']} live at the centre, {hall['poses_per_s']:.0f} poses/s there, "
                f"{hall['missing']} of health and events missing; routers: {loads}; pit wall {hall['wall_cores']:.2f} cores, "
                f"{hall['memory_mb']:.0f} MB, {hall['snapshots_per_s']:.1f} snapshots/s")
            if hall["live"] != hall["cars"] or hall["missing"]:
                faults.append(f"two halls: {hall['live']} of {hall['cars']} cars, {hall['missing']} missing")
            if hall["without_poses"]:
                faults.append(f"two halls: the centre gets no poses of {hall['without_poses']} cars")
    if arguments.json:
        print(json.dumps({"fleets": rows, "halls": hall, "faults": faults}))
    if arguments.write:
        write(arguments.write, out)
    for fault in faults:
        print(f"scale: {fault}")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
