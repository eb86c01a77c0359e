#!/usr/bin/env python3
"""Uses `pitwall watch` as an operator does: in a terminal, by keys.

    .ci/terminal.py PITWALL TEST_CAR

A pit wall with its page serves two cars. `watch` runs in a pseudo-terminal, and what it draws is read from an emulated screen.
Needs the package pyte.
"""

import fcntl
import json
import os
import pathlib
import pty
import select
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import termios
import time
import urllib.request

import pyte

sys.path.insert(0, os.path.dirname(__file__))
from scale import free_port, wait  # noqa: E402

DEADLINE = 60
KEYS = {"up": "\x1b[A", "down": "\x1b[B", "escape": "\x1b", "enter": "\r"}


class Terminal:
    """A program in a terminal of its own."""

    def __init__(self, arguments, columns=120, rows=40):
        self.screen = pyte.Screen(columns, rows)
        self.stream = pyte.ByteStream(self.screen)
        self.raw = b""
        self.side, theirs = pty.openpty()
        self.resize(columns, rows)
        self.before = termios.tcgetattr(theirs)
        self.theirs = theirs
        self.process = subprocess.Popen(
            arguments, stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True,
            env={**os.environ, "TERM": "xterm-256color"})

    def resize(self, columns, rows):
        self.screen.resize(rows, columns)
        fcntl.ioctl(self.side, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
        if hasattr(self, "process"):
            self.process.send_signal(signal.SIGWINCH)

    def read(self, seconds=0.1):
        """Draws what comes within this time."""
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0:
            if not select.select([self.side], [], [], left)[0]:
                return
            try:
                part = os.read(self.side, 65536)
            except OSError:
                return
            self.raw += part
            self.stream.feed(part)

    def text(self):
        return "\n".join(line.rstrip() for line in self.screen.display)

    def wait(self, what, condition):
        """Waits until a text is on the screen, or a condition on the text holds."""
        if isinstance(condition, str):
            wanted, condition = condition, lambda text: wanted in text
        until = time.monotonic() + DEADLINE
        while time.monotonic() < until:
            self.read()
            if condition(self.text()):
                return
        sys.exit(f"not within {DEADLINE} s: {what}\n{self.text()}")

    def press(self, *keys):
        for key in keys:
            os.write(self.side, KEYS.get(key, key).encode())
            self.read(0.15)

    def row(self, car):
        """The row of the table that has this car."""
        return next((line for line in self.text().split("\n") if line.startswith(f"│{car} ")), "")

    def ended(self):
        """Waits for the end: its exit code. The terminal must be as it was before."""
        until = time.monotonic() + DEADLINE
        while self.process.poll() is None:
            if time.monotonic() > until:
                sys.exit(f"it does not end\n{self.text()}")
            self.read()
        self.read()
        check(termios.tcgetattr(self.theirs) == self.before, "the terminal's settings are as they were")
        # Terminals keep the screen of a program apart from what was there before.
        check(self.raw.rfind(b"\x1b[?1049l") > self.raw.rfind(b"\x1b[?1049h"), "the program's screen is left")
        check(self.raw.rfind(b"\x1b[?25h") > self.raw.rfind(b"\x1b[?25l"), "the cursor is there again")
        return self.process.returncode

    def close(self):
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        os.close(self.side)
        os.close(self.theirs)


def check(condition, what):
    if not condition:
        sys.exit(f"FAILED: {what}")
    print(f"ok: {what}")


def main():
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    pitwall, test_car = sys.argv[1:]
    folder = pathlib.Path(tempfile.mkdtemp(prefix="terminal-"))
    started = []

    def start(*arguments):
        process = subprocess.Popen(arguments, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, stdin=subprocess.DEVNULL)
        started.append(process)
        return process

    try:
        endpoint, port = f"tcp/127.0.0.1:{free_port()}", free_port()
        url = f"http://127.0.0.1:{port}"
        start(pitwall, "--listen", endpoint, "--page", f"127.0.0.1:{port}", "--recordings", str(folder))

        def snapshot():
            try:
                with urllib.request.urlopen(f"{url}/snapshot", timeout=5) as answer:
                    return json.load(answer)
            except OSError:
                return None

        def post(path, body):
            request = urllib.request.Request(
                f"{url}{path}", json.dumps(body).encode(), {"Content-Type": "application/json", "Origin": url})
            with urllib.request.urlopen(request, timeout=60) as answer:
                return answer.read()

        wait("the page", snapshot, DEADLINE)
        start(test_car, "rings", "1", endpoint)
        racer = start(test_car, "race", "racer", "0", endpoint)
        wait("two cars", lambda: len(snapshot()["cars"]) == 2 and all(car["health"] for car in snapshot()["cars"]), DEADLINE)

        watch = Terminal([pitwall, "--connect", endpoint, "--operator", "ana", "watch"])
        started.append(watch)
        watch.wait("both cars and their states", lambda text: all(f"│{car} " in text for car in ["car-01", "racer"]) and text.count("LOCALIZED") >= 2)
        watch.wait("nobody records", "nobody at the pit wall records")
        print("ok: cars and states")

        # The recorder.
        post("/record", {"on": True, "operator": "ana"})
        watch.wait("what is recorded, and that it grows", lambda text: "recording " in text and ".mcap on " in text and "nothing missing" in text)
        post("/record", {"on": False, "operator": "ana"})
        watch.wait("it has ended", "nobody at the pit wall records")
        recorder = start(pitwall, "--connect", endpoint, "record", "-o", str(folder / "second.mcap"))
        watch.wait("the recorder of another program", "recording second.mcap on ")
        recorder.kill()
        recorder.wait()
        watch.wait("that it has died", "RECORDER SILENT for ")
        print("ok: recorders")

        # Keys: the help, a car, a set.
        watch.press("?")
        watch.wait("the keys", "any key closes this")
        watch.press("x")
        watch.wait("no keys any more", lambda text: "any key closes this" not in text)
        watch.press("2")
        watch.wait("the second car in detail", "┌ racer ─")
        set_of = lambda: next(car["set"]["name"] for car in snapshot()["cars"] if car["car"] == "racer")
        check(set_of() == "hq", "hq is in force")
        watch.press("s")
        watch.wait("the sets", "sets of racer")
        for _ in range(20):
            if "▶ lq " in watch.text():
                break
            watch.press("down")
        watch.press("enter")
        watch.wait("the answer of the car", lambda text: "✓" in text and "lq" in text)
        check(set_of() == "lq", "lq is in force after Enter in the list of sets")
        # What the car has answered goes with the next key, so that the keys are shown again.
        watch.press("up")
        watch.wait("the keys are in the last line again", "q quit")
        watch.press("2", "R")
        watch.wait("back to the set before", lambda text: "✓" in text and "hq" in text)
        check(set_of() == "hq", "R goes back to hq")

        # Alarms: those of one car that is cut, acknowledged here and on the page.
        racer.send_signal(signal.SIGSTOP)
        watch.wait("it is silent", lambda text: "BLIND" in watch.row("racer"))
        watch.wait("an alarm", "not acknowledged (a)")
        watch.press("a")
        watch.wait("no alarm any more", lambda text: "not acknowledged" not in text)
        racer.send_signal(signal.SIGCONT)
        watch.wait("it is back", lambda text: "LOCALIZED" in watch.row("racer"))
        racer.send_signal(signal.SIGSTOP)
        watch.wait("the next alarm", "not acknowledged (a)")
        post("/acknowledge", {"operator": "ben"})
        watch.wait("acknowledged on the page", lambda text: "not acknowledged" not in text)
        racer.send_signal(signal.SIGCONT)
        print("ok: alarms are acknowledged here and on the page")

        # Sizes.
        for columns, rows in [(80, 24), (60, 12), (20, 5), (200, 60), (120, 40)]:
            watch.resize(columns, rows)
            watch.wait(f"drawn at {columns} x {rows}", lambda text: text.strip() != "")
            if rows >= 12:
                watch.wait(f"cars at {columns} x {rows}", lambda text: "car-01" in text and "LOCALIZED" in text)
        check(watch.process.poll() is None, "every size is drawn")
        watch.press("q")
        check(watch.ended() == 0, "q ends it")

        for name, leave in [("Ctrl-C", lambda t: t.press("\x03")), ("SIGTERM", lambda t: t.process.send_signal(signal.SIGTERM)),
                            ("SIGINT", lambda t: t.process.send_signal(signal.SIGINT)), ("a time", lambda t: None)]:
            time_of = ["--for", "2s"] if name == "a time" else []
            watch = Terminal([pitwall, "--connect", endpoint, "watch", "car-01", *time_of])
            started.append(watch)
            watch.wait("the car", "LOCALIZED")
            leave(watch)
            check(watch.ended() in (0, 130, 143), f"{name} ends it")
        watch = Terminal([pitwall, "--connect", endpoint, "watch", "ghost", "--wait", "2s"])
        started.append(watch)
        watch.wait("no such car", "no such car: ghost")
        while watch.process.poll() is None:
            watch.read()
        check(watch.process.returncode == 4, "a car that is not there has its exit code")
    finally:
        for process in reversed(started):
            if isinstance(process, Terminal):
                process.close()
            elif process.poll() is None:
                process.kill()
                process.wait()
        shutil.rmtree(folder, ignore_errors=True)
    print("watch: all checks passed")
    return 0


if __name__ == "__main__":
    sys.exit(main())
