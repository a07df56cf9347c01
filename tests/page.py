#!/usr/bin/env python3
"""Looks at the page of skein watch in a headless Chromium: page.py [--shots FOLDER] [--follow RUN] RUNS.

Opens every view in light and dark, wide and narrow; drives it by keyboard; plays a recorded flight, if a run of the
folder RUNS has one. Fails on an error on the console, a request that fails, or a page wider than its window. With
--follow, watches until the page calls RUN complete. Without Chromium it says so and ends with status 77.

Needs: Chromium (Debian: apt install chromium), target/release/skein-watch (launch/watch.sh builds it; SKEIN_WATCH names
another). tests/viewers.sh runs this with a run of its own.
"""

import argparse
import base64
import json
import os
import select
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

WATCH = os.environ.get("SKEIN_WATCH") or Path(__file__).resolve().parent.parent / "target/release/skein-watch"
VIEWS = ["curves", "actors", "settings", "failures", "flights"]
DEADLINE_SECS = 60
WIDE, NARROW = (1280, 860), (390, 844)


class Browser:
    """Chromium, spoken to over its debugging pipe: JSON messages, each ended by a zero byte."""

    def __init__(self, program, profile):
        here_read, its_write = os.pipe()
        its_read, here_write = os.pipe()

        def connect():
            # Chromium reads from 3 and writes to 4; the copies keep both apart from what is there.
            read, write = os.dup(its_read), os.dup(its_write)
            os.dup2(read, 3)
            os.dup2(write, 4)

        self.process = subprocess.Popen(
            [program, "--headless=new", "--remote-debugging-pipe", f"--user-data-dir={profile}", "--no-first-run",
             "--disable-dev-shm-usage", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--hide-scrollbars"]
            + (["--no-sandbox"] if os.geteuid() == 0 else []) + ["about:blank"],
            close_fds=False, preexec_fn=connect, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        os.close(its_write)
        os.close(its_read)
        self.read, self.write = here_read, here_write
        self.buffer, self.last, self.problems, self.session = b"", 0, [], None
        target = self.ask("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ["Page", "Runtime", "Log", "Network"]:
            self.ask(f"{domain}.enable")

    def ask(self, method, **parameters):
        """Sends a command and returns its result; notes problems that the page reports meanwhile."""
        self.last += 1
        message = {"id": self.last, "method": method, "params": parameters}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.write, json.dumps(message).encode() + b"\0")
        end = time.monotonic() + DEADLINE_SECS
        while True:
            answer = self.next_message(end, method)
            if answer.get("id") == self.last:
                if "error" in answer:
                    sys.exit(f"{method}: {answer['error']['message']}")
                return answer["result"]
            self.note(answer)

    def next_message(self, end, waiting_for):
        while b"\0" not in self.buffer:
            if not select.select([self.read], [], [], max(0, end - time.monotonic()))[0]:
                sys.exit(f"Chromium does not answer {waiting_for} within {DEADLINE_SECS} s")
            piece = os.read(self.read, 1 << 20)
            if not piece:
                sys.exit("Chromium has ended")
            self.buffer += piece
        message, self.buffer = self.buffer.split(b"\0", 1)
        return json.loads(message)

    def note(self, event):
        parameters = event.get("params", {})
        match event.get("method"):
            case "Runtime.exceptionThrown":
                details = parameters["exceptionDetails"]
                self.problems.append(details.get("exception", {}).get("description", details["text"]))
            case "Runtime.consoleAPICalled" if parameters["type"] in ("error", "assert"):
                self.problems.append(" ".join(str(part.get("value", part.get("description"))) for part in parameters["args"]))
            case "Log.entryAdded" if parameters["entry"]["level"] == "error":
                self.problems.append(f"{parameters['entry']['text']} {parameters['entry'].get('url', '')}")

    def evaluate(self, script):
        result = self.ask("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in result:
            sys.exit(f"{script}: {result['exceptionDetails']}")
        return result["result"].get("value")

    def wait_for(self, condition, what, secs=DEADLINE_SECS):
        end = time.monotonic() + secs
        while not self.evaluate(condition):
            if time.monotonic() > end:
                sys.exit(f"{what}: not within {secs} s; the page shows: {self.evaluate('document.body.innerText')[:800]}")
            time.sleep(0.1)

    def press(self, key):
        for kind in ["keyDown", "keyUp"]:
            self.ask("Input.dispatchKeyEvent", type=kind, key=key, code=key)

    def shoot(self, path):
        path.write_bytes(base64.b64decode(self.ask("Page.captureScreenshot", format="png")["data"]))

    def appear(self, size, scheme):
        width, height = size
        self.ask("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        self.ask("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])

    def close(self):
        self.process.terminate()
        try:
            self.process.wait(10)
        except subprocess.TimeoutExpired:
            self.process.kill()


def check(condition, problem):
    if not condition:
        sys.exit(problem)


DRAWN = "view.getAttribute('aria-busy') === 'false'"


RECORDED = """(async () => {
  for (const { id } of state.runs) {
    const { recordings } = await ask("recordings", [["run", id]]);
    if (recordings.length > 0) { state.chosen = [id]; showList(); return id; }
  }
  return null;
})()"""


def look_at_all(browser, address, shots):
    """Opens every view in every appearance."""
    for scheme in ["light", "dark"]:
        for size, name in [(WIDE, "wide"), (NARROW, "narrow")]:
            browser.appear(size, scheme)
            browser.ask("Page.navigate", url="about:blank")
            browser.ask("Page.navigate", url=address)
            browser.wait_for("document.querySelectorAll('#list li').length > 0", "the list of runs")
            browser.evaluate(RECORDED)
            for view in VIEWS:
                browser.evaluate(f"document.getElementById('tab-{view}').click()")
                browser.wait_for(DRAWN, view)
                # Plots are drawn in the next frames.
                time.sleep(1.0)
                if shots:
                    browser.shoot(shots / f"{view}-{scheme}-{name}.png")
                fits = browser.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
                check(fits, f"{view} is wider than a {name} window")


def go_by_keyboard(browser):
    """Reaches every tab and the steps of a flight without a pointer."""
    browser.appear(WIDE, "light")
    browser.evaluate("document.getElementById('tab-curves').click(), document.getElementById('tab-curves').focus()")
    for view in VIEWS[1:]:
        browser.press("ArrowRight")
        check(browser.evaluate("state.view") == view, f"the right arrow does not lead to {view}")
    browser.wait_for(DRAWN, "flights")
    if not browser.evaluate("view.querySelector('.flight') !== null"):
        print("no run here has a recording: none was played")
        return
    step = "view.querySelector('input[type=range]').value"
    seen = "view.querySelector('canvas.depth').toDataURL()"
    browser.evaluate("view.querySelector('input[type=range]').focus()")
    browser.press("End")
    browser.wait_for(f"Number({step}) > 0", "the last step")
    (last, end) = (browser.evaluate(step), browser.evaluate(seen))
    browser.press("Home")
    browser.wait_for(f"{step} === '0' && {seen} !== {json.dumps(end)}", "the first step")
    browser.evaluate("view.querySelector('.play').focus(), view.querySelector('.play').click()")
    browser.wait_for(f"Number({step}) >= 3", "a flight that plays")
    browser.evaluate("view.querySelector('.play').click()")
    check(int(browser.evaluate(step)) < int(last), "the flight does not stop when it is told to")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", type=Path)
    parser.add_argument("--shots", type=Path)
    parser.add_argument("--follow", metavar="RUN")
    parser.add_argument("--follow-secs", type=int, default=900)
    arguments = parser.parse_args()
    program = next(filter(None, map(shutil.which, ["chromium", "chromium-browser", "google-chrome"])), None)
    if program is None:
        print("there is no Chromium here (Debian: apt install chromium): the page is NOT tested")
        sys.exit(77)
    if arguments.shots:
        arguments.shots.mkdir(parents=True, exist_ok=True)
    watch = subprocess.Popen([WATCH, arguments.runs, "--port", "0"], stdout=subprocess.PIPE, text=True)
    with tempfile.TemporaryDirectory() as profile:
        browser = None
        try:
            address = watch.stdout.readline().split()[0]
            browser = Browser(program, profile)
            look_at_all(browser, address, arguments.shots)
            go_by_keyboard(browser)
            if arguments.follow:
                run = json.dumps(arguments.follow)
                browser.evaluate("document.getElementById('tab-curves').click()")
                browser.wait_for(f"state.runs.some((run) => run.id === {run} && run.state === 'complete')", "the run's end", arguments.follow_secs)
                if arguments.shots:
                    browser.shoot(arguments.shots / "followed.png")
            check(not browser.problems, "\n".join(["the page reports:", *browser.problems]))
            print("every view is drawn, light and dark, wide and narrow; no error on the console")
        finally:
            if browser:
                browser.close()
            watch.terminate()
            watch.wait(10)


if __name__ == "__main__":
    main()
