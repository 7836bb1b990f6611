"""Make docs/explore.png: the page of `thruster explore` after a drag and a study, in Debian's Chromium.

python -m pages.explore_page [FOLDER]
"""

from __future__ import annotations

import io
import shutil
import sys
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright

from tuning.exploring.bench import Bench
from tuning.exploring.page.server import Server, page_of
from tuning.problems.find import find_problem

WIDE = {"width": 1360, "height": 900}
COLOURS = 200  # a fraction of the bytes, and no difference to see
PATIENCE = 180_000  # [ms]
MOVED = 5.5  # R [N^2], where it stood at the 0.25 of the sensor's data sheet


def screenshot(page: Page, url: str) -> bytes:
    """A screenshot of the page after the start was held, R was raised and a study has run."""
    page.set_default_timeout(PATIENCE)
    page.goto(url)
    page.wait_for_selector("#figures dd")
    page.click("#hold")
    page.wait_for_selector("#held li")
    page.select_option("#y", "R")
    number = page.locator(".knob:has(#knob-R) input[type=text]")
    number.fill(str(MOVED))
    number.press("Tab")
    page.fill("#trials", "40")
    page.click("#run")
    page.wait_for_function("document.querySelector('#best').innerText.includes('40 of 40')")
    page.click("#map")
    page.wait_for_function("!document.body.classList.contains('busy')")
    page.mouse.move(0, 0)
    page.wait_for_timeout(2000)
    return page.screenshot(full_page=True)


def main(folder: Path) -> None:
    """Serve a bench of its own, and write the picture."""
    server = Server(page_of(Bench(find_problem("outliers"), "ekf")), ends_when_left=False).start()
    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        picture = Image.open(io.BytesIO(screenshot(browser.new_page(viewport=WIDE), server.url)))
        browser.close()
    server.stop()
    picture.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE).save(folder / "explore.png", optimize=True)


if __name__ == "__main__":
    main(Path(*sys.argv[1:2]) if sys.argv[1:] else Path(__file__).parents[1] / "docs")
