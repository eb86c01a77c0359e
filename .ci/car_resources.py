"""What the node takes on a car: memory, processor time and start, on a club's map, on one with cells of 5 mm, and in a building.

    python3 .ci/car_resources.py PATH/TO/car-node PATH/TO/pitwall [--for SECONDS] [--write README.md]

The same simulated drive is played at its own speed against each map, with the set hq and the default limit of the range tables. The maps are made
of the bundled club: its cells divided into 10 x 10, and the club inside a building of 60 x 45 m with cells of 3 cm, behind a door. The node starts without a
pose and searches the map.
"""

import argparse
import contextlib
import glob
import os
import re
import signal
import struct
import subprocess
import sys
import tempfile
import time
import zlib

sys.path.insert(0, os.path.dirname(__file__))
from scale import cpu, free_port, spawn  # noqa: E402
from slow_link import Lines  # noqa: E402

CLUB = os.path.join(os.path.dirname(__file__), "..", "maps", "tracks", "club")
FREE, OCCUPIED = 254, 0


def png(path):
    """Width, height and rows of an 8-bit grayscale image."""
    with open(path, "rb") as file:
        data = file.read()
    at, packed = 8, b""
    while at < len(data):
        (length,) = struct.unpack(">I", data[at:at + 4])
        kind, body = data[at + 4:at + 8], data[at + 8:at + 8 + length]
        if kind == b"IHDR":
            width, height, depth, colour = struct.unpack(">IIBB", body[:10])
            if (depth, colour) != (8, 0):
                raise ValueError(f"{path}: not 8-bit grayscale")
        if kind == b"IDAT":
            packed += body
        at += length + 12
    raw, rows, above = zlib.decompress(packed), [], bytearray(width)
    for y in range(height):
        how, row = raw[y * (width + 1)], bytearray(raw[y * (width + 1) + 1:(y + 1) * (width + 1)])
        for x in range(width):
            left, up, corner = (row[x - 1] if x else 0), above[x], (above[x - 1] if x else 0)
            guess = left + up - corner
            paeth = min((left, up, corner), key=lambda value: abs(guess - value))
            row[x] = (row[x] + (0, left, up, (left + up) // 2, paeth)[how]) & 255
        rows.append(bytes(row))
        above = row
    return width, height, rows


def write_map(folder, name, rows, resolution, origin):
    with open(f"{folder}/{name}.pgm", "wb") as file:
        file.write(f"P5 {len(rows[0])} {len(rows)} 255\n".encode())
        file.writelines(rows)
    with open(f"{folder}/{name}.yaml", "w") as file:
        file.write(f"image: {name}.pgm\nresolution: {resolution}\norigin: [{origin[0]}, {origin[1]}, 0.0]\nnegate: 0\n"
                   "occupied_thresh: 0.65\nfree_thresh: 0.196\nmode: trinary\n")
    return f"{folder}/{name}.yaml"


def scaled(rows, factor):
    """The nearest cell's value."""
    width, height = int(len(rows[0]) * factor), int(len(rows) * factor)
    columns = [int(x / factor) for x in range(width)]
    cache = {}
    out = []
    for y in range(height):
        source = int(y / factor)
        if source not in cache:
            cache = {source: bytes(rows[source][x] for x in columns)}
        out.append(cache[source])
    return out


def building(rows, cell=0.03, size=(60.0, 45.0)):
    """Rooms of 6 x 5 m with doors, and the club in the middle. Returns the rows and where the club's corner is [m]."""
    club = scaled(rows, 0.05 / cell)
    width, height = (int(side / cell) for side in size)
    out = [bytearray([FREE]) * width for _ in range(height)]
    metre = int(1 / cell)

    def wall(x0, y0, x1, y1):
        for y in range(y0, y1):
            out[y][x0:x1] = bytes([OCCUPIED]) * (x1 - x0)

    for x in range(0, width, 6 * metre):
        wall(x, 0, x + 3, height)
    for y in range(0, height, 5 * metre):
        wall(0, y, width, y + 3)
    wall(width - 3, 0, width, height)
    wall(0, height - 3, width, height)
    # Doors in the middle of each room's walls.
    for x in range(0, width - 3, 6 * metre):
        for y in range(0, height - 3, 5 * metre):
            for dy in range(2 * metre, 3 * metre):
                if x and y + dy < height - 3:
                    out[y + dy][x:x + 3] = bytes([FREE]) * 3
            for dx in range(2 * metre, 3 * metre):
                if y and x + dx < width - 3:
                    for k in range(3):
                        out[y + k][x + dx] = FREE
    left, top = (width - len(club[0])) // 2, (height - len(club)) // 2
    for y, row in enumerate(club):
        # What the club's map does not know stays the building's.
        for x, value in enumerate(row):
            if value in (FREE, 255, OCCUPIED) or value < 100 or value > 220:
                out[top + y][left + x] = value
    # A door from the club into the building: up from the first free cell of the middle column.
    middle = left + len(club[0]) // 2
    y = next(top + y for y in range(len(club)) if club[y][len(club[0]) // 2] > 220)
    while y > top - 2 * metre:
        y -= 1
        out[y][middle:middle + metre] = bytes([FREE]) * metre
    return [bytes(row) for row in out], (left * cell, (height - top - len(club)) * cell)


def memory_peak(pid):
    with open(f"/proc/{pid}/status") as file:
        text = file.read()
    return [int(re.search(rf"{name}:\s+(\d+)", text)[1]) / 1e3 for name in ("VmRSS", "VmHWM")]


def record(node, folder, seconds):
    """A bag of a drive on the club."""
    with contextlib.ExitStack() as stack:
        car = spawn(stack, node, "run", "--source", "simulator", "--map", "club", "--car", "recorded", "--record", f"{folder}/bag",
                    "--connect", f"tcp/127.0.0.1:{free_port()}", "--state", f"{folder}/state", stderr=subprocess.DEVNULL)
        time.sleep(seconds)
        car.send_signal(signal.SIGINT)
        car.wait(20)
    return max(glob.glob(f"{folder}/bag/**/*.mcap", recursive=True), key=os.path.getsize)


def measure(node, wall, map_file, bag, seconds):
    with contextlib.ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        port = free_port()
        views = Lines(spawn(stack, wall, "--json", "--listen", f"tcp/127.0.0.1:{port}", "watch", "--rate", "10", stdout=subprocess.PIPE, text=True))
        time.sleep(1)
        log = open(f"{folder}/log", "w+")
        began = time.monotonic()
        car = spawn(stack, node, "run", "--source", "bag", "--bag", bag, "--map", map_file, "--car", "car-1", "--connect",
                    f"tcp/127.0.0.1:{port}", "--state", f"{folder}/state", "--stay", stderr=log)
        first = None
        while first is None and time.monotonic() < began + 120:
            for when, view in list(views.seen):
                if any(each["pose"] and each["state"] == "LOCALIZED" for each in view):
                    first = when - began
                    break
            time.sleep(0.02)
        if first is None:
            log.seek(0)
            raise RuntimeError(f"{map_file}: not localized within 120 s: {log.read()[-500:]}")
        time.sleep(2)
        busy, at = cpu(car.pid), time.monotonic()
        time.sleep(seconds)
        cores = (cpu(car.pid) - busy) / (time.monotonic() - at)
        now, peak = memory_peak(car.pid)
        log.seek(0)
        said = re.search(r"full range tables.*", log.read())
    return {"start": first, "memory": now, "peak": peak, "cores": cores, "note": said[0] if said else ""}


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("node")
    parser.add_argument("wall")
    parser.add_argument("--for", dest="seconds", type=float, default=12)
    parser.add_argument("--write")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        bag = record(arguments.node, folder, arguments.seconds + 25)
        _, _, rows = png(f"{CLUB}/map.png")
        origin = (-5.0, -1.9)
        inside, corner = building(rows)
        maps = [
            ("club, 23 x 10 m, cells of 5 cm", f"{CLUB}/map.yaml"),
            ("the same, cells of 5 mm", write_map(folder, "fine", scaled(rows, 10), 0.005, origin)),
            ("in a building, 60 x 45 m, cells of 3 cm",
             write_map(folder, "building", inside, 0.03, (origin[0] - corner[0], origin[1] - corner[1]))),
        ]
        table = ["| map | from start to LOCALIZED [s] | memory [MB] | at most [MB] | cores | range tables |", "|---|---|---|---|---|---|"]
        print(*table, sep="\n", flush=True)
        for name, file in maps:
            row = measure(arguments.node, arguments.wall, file, bag, arguments.seconds)
            note = row["note"].split(" they ")[-1] if row["note"] else "full"
            table.append(f"| {name} | {row['start']:.1f} | {row['memory']:.0f} | {row['peak']:.0f} | {row['cores']:.2f} | {note} |")
            print(table[-1], flush=True)
    if arguments.write:
        with open(arguments.write) as file:
            text = file.read()
        before, rest = text.split("<!-- resources -->\n", 1)
        _, after = rest.split("<!-- end of resources -->\n", 1)
        with open(arguments.write, "w") as file:
            file.write(before + "<!-- resources -->\n\n" + "\n".join(table) + "\n\n<!-- end of resources -->\n" + after)


if __name__ == "__main__":
    main()
