"""The time from a move of a slider until the page of `thruster explore` shows its picture, measured in Chromium.

    python -m benchmarks.slider            # EKF on outliers: 8 runs of 500 steps, on 1400 x 1000 pixels

The server has a process of its own. A move lasts from the slider's event to the end of the frame that shows the
picture; the processor time is that of the page's thread, which other load of the machine changes less.
"""

from __future__ import annotations

import os
import shutil
import statistics
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from playwright.sync_api import CDPSession, Page, sync_playwright

MOVES, ROUNDS = 60, 5  # the first round, in which the browser compiles, does not count
PAUSE = 200  # [ms] between two moves
PATIENCE = 120_000  # [ms]
MEASURED = "performance.getEntriesByName('move to picture').map(one => one.duration)"


@contextmanager
def served(*options: str) -> Iterator[str]:
    """The address of a page."""
    command = [sys.executable, "-m", "tuning.cli", "explore", "--no-browser", *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        yield next(line.strip() for line in process.stdout if line.startswith("http"))
        process.terminate()


def drag(page: Page, knob: str = "#knob-R") -> list[float]:
    """Times [ms] of the moves of one drag there and back."""
    page.evaluate("performance.clearMeasures()")
    box = page.locator(knob).bounding_box()
    assert box is not None
    height = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + 0.3 * box["width"], height)
    page.mouse.down()
    for move in range(MOVES):
        part = 0.3 + 0.4 * (1.0 - abs(1.0 - 2.0 * move / MOVES))
        page.mouse.move(box["x"] + part * box["width"], height)
        page.wait_for_timeout(PAUSE)
    page.mouse.up()
    page.wait_for_timeout(1000)
    return page.evaluate(MEASURED)


def thread_time(devtools: CDPSession) -> float:
    """Processor time [ms] of the page's thread so far."""
    metrics = {metric["name"]: metric["value"] for metric in devtools.send("Performance.getMetrics")["metrics"]}
    return 1e3 * metrics["TaskDuration"]


def main() -> None:
    """Print a line for each round, and one of all."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    everything, of_thread = [], []
    with served(*sys.argv[1:]) as url, sync_playwright() as started:
        browser = started.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1400, "height": 1000})
        page.set_default_timeout(PATIENCE)
        page.goto(url)
        page.wait_for_selector("#figures dd")
        page.wait_for_function("!document.body.classList.contains('busy')")
        devtools = page.context.new_cdp_session(page)
        devtools.send("Performance.setTimeDomain", {"timeDomain": "threadTicks"})
        devtools.send("Performance.enable")
        for number in range(ROUNDS):
            before = thread_time(devtools)
            times = drag(page)
            spent = (thread_time(devtools) - before) / len(times)
            print(_line("first" if number == 0 else str(number), times, spent), flush=True)
            if number:
                everything += times
                of_thread.append(spent)
        browser.close()
    print(_line("all", everything, statistics.median(of_thread)))


def _line(name: str, times: list[float], spent: float) -> str:
    median, late = np.percentile(times, [50, 95])
    text = f"{name:>5}: {len(times)} moves, median {median:.0f} ms, 95th percentile {late:.0f} ms"
    return f"{text}, {spent:.0f} ms of the page's thread each; load {os.getloadavg()[0]:.1f}"


if __name__ == "__main__":
    main()
