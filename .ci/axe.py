#!/usr/bin/env python3
"""Checks the accessibility of every view of the page and of the report with axe, at three widths.

    .ci/axe.py PITWALL TEST_CAR [VIEW...]     the programs, and the views to check; all without one

Fails when axe finds anything that it calls serious or critical. PITWALL serves the page to three cars of TEST_CAR, which it
records; the recording is then replayed and reported. Needs Chromium and the package axe-playwright-python.
"""

import json
import os
import pathlib
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.request

import axe_playwright_python
from playwright.sync_api import sync_playwright

sys.path.insert(0, os.path.dirname(__file__))
from scale import free_port, wait  # noqa: E402

AXE = pathlib.Path(axe_playwright_python.__file__).with_name("axe.min.js").read_text(encoding="utf-8")
# Each with a theme, so that both are checked.
WIDTHS = [(390, 844, "dark"), (1366, 768, "light"), (1920, 1080, "dark")]
# For the page, the cars and the replay [s].
PATIENCE = 90
SERIOUS = {"serious", "critical"}
# Each view of the live page with what opens it.
VIEWS = {
    "live": "",
    "laps": "document.getElementById('tab-laps').click()",
    "numbers": "document.getElementById('tab-numbers').click()",
    "analysis": "document.getElementById('tab-analysis').click(); setTimeout(() => document.querySelector('[data-mode=laps]')?.click(), 500)",
    "health": "document.getElementById('tab-analysis').click(); setTimeout(() => document.querySelector('[data-mode=health]')?.click(), 500)",
    "large": "press('o')",
    "help": "press('?')",
    "limits": "document.getElementById('tab-log').click(); document.getElementById('limits-button').click()",
    "sheet": "press('w')",
    "note": "press('m')",
    "rates": "press('y')",
    "ask": "press('L')",
    "sessions": "press('b')",
}
OPEN = """(act) => {
  const press = (key) => document.body.dispatchEvent(new KeyboardEvent('keydown', {key, bubbles: true}));
  for (const box of document.querySelectorAll('dialog[open]')) box.close();
  document.getElementById('tab-log').click();
  press('Escape');
  eval(act);
}"""


class Checker:
    def __init__(self, browser):
        self.browser = browser
        self.found = 0
        self.checked = 0

    def check(self, page, view):
        """Runs axe at every width. What it finds is printed at once."""
        begun = time.monotonic()
        for width, height, theme in WIDTHS:
            page.set_viewport_size({"width": width, "height": height})
            page.evaluate("(theme) => { document.documentElement.dataset.theme = theme; }", theme)
            page.emulate_media(color_scheme=theme)
            page.wait_for_timeout(250)
            if not page.evaluate("typeof axe !== 'undefined'"):
                page.evaluate(AXE + "; 0")
            result = page.evaluate("axe.run(document, {resultTypes: ['violations']})")
            self.checked += 1
            for violation in result["violations"]:
                if violation["impact"] in SERIOUS:
                    for node in violation["nodes"][:3]:
                        self.found += 1
                        summary = node["failureSummary"].replace("\n", "\n    ")
                        print(f"{view}, {width} px, {theme}: {violation['id']}: {node['html'][:160]}\n    {summary}", flush=True)

        print(f"{view}: checked in {time.monotonic() - begun:.0f} s", flush=True)

    def open(self, url):
        # Scripts of this check are no part of the page: its Content-Security-Policy would refuse them.
        context = self.browser.new_context(bypass_csp=True)
        page = context.new_page()
        page.goto(url)
        return page


def main():
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    pitwall, test_car, *only = sys.argv[1:]
    wanted = lambda view: not only or view in only
    folder = pathlib.Path(tempfile.mkdtemp(prefix="axe-"))
    started = []

    def start(*arguments):
        started.append(subprocess.Popen(arguments, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, stdin=subprocess.DEVNULL))

    def serves(url):
        try:
            with urllib.request.urlopen(f"{url}/snapshot", timeout=5) as answer:
                return json.load(answer)
        except OSError:
            return None

    try:
        cars, page_port = f"tcp/127.0.0.1:{free_port()}", free_port()
        url = f"http://127.0.0.1:{page_port}"
        start(pitwall, "--listen", cars, "--page", f"127.0.0.1:{page_port}", "--recordings", str(folder))
        wait("the page", lambda: serves(url), PATIENCE)
        start(test_car, "rings", "3", cars)

        def post(path, body):
            request = urllib.request.Request(
                f"{url}{path}", json.dumps(body).encode(), {"Content-Type": "application/json", "Origin": url})
            with urllib.request.urlopen(request, timeout=180) as answer:
                return answer.read()

        wait("three cars", lambda: len(serves(url)["cars"]) == 3 and all(c["health"] for c in serves(url)["cars"]), PATIENCE)
        post("/record", {"on": True, "operator": "axe"})
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox", "--disable-gpu"])
            checker = Checker(browser)
            page = checker.open(url)
            page.wait_for_function("document.querySelectorAll('.card').length === 3", timeout=90000)
            for view, act in VIEWS.items():
                if wanted(view):
                    page.evaluate(OPEN, act)
                    page.wait_for_timeout(1500)
                    checker.check(page, view)
            post("/record", {"on": False, "operator": "axe"})
            file = next(folder.glob("*.mcap"))
            if wanted("replay"):
                port = free_port()
                start(pitwall, "--page", f"127.0.0.1:{port}", "replay", str(file))
                wait("the replay", lambda: serves(f"http://127.0.0.1:{port}"), PATIENCE)
                page = checker.open(f"http://127.0.0.1:{port}")
                page.wait_for_function("document.querySelectorAll('.card').length === 3", timeout=90000)
                checker.check(page, "replay")
            if wanted("report"):
                report = folder / "report.html"
                subprocess.run([pitwall, "report", str(file), "-o", str(report)], check=True, stdout=subprocess.DEVNULL)
                page = checker.open(report.as_uri())
                page.wait_for_timeout(1500)
                checker.check(page, "report")
            browser.close()
    finally:
        for process in started:
            process.kill()
            process.wait()
        shutil.rmtree(folder, ignore_errors=True)
    print(f"axe: {checker.checked} checks, {checker.found} violations that are serious or critical")
    return 1 if checker.found else 0


if __name__ == "__main__":
    sys.exit(main())
