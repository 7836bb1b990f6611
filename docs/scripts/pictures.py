"""The pictures of README.md, which show the filter that `make demo` tunes, and that of `thruster explore`."""

from __future__ import annotations

import io
import math
import shutil
import tempfile
from functools import cache
from pathlib import Path

import gymnasium as gym
import numpy as np
from PIL import Image

import thruster_env  # noqa: F401 - registers the envs
from docs.scripts import subplots
from filters import EstimateState
from filters.engine.batch import run
from filters.filter import Filter
from thruster_env.core.files import BLUE, DARK, RUST, legend_below, save_figure, write_whole
from tuning.api.study import Study
from tuning.api.tune import run_tuning
from tuning.cli.demo import FILTER, SCENARIO
from tuning.cli.output import progress_console
from tuning.evaluation.baselines import NOISE, ORACLE, TUNED, baselines
from tuning.exploring.bench import Bench
from tuning.exploring.page.session import Server, page_of
from tuning.problems.find import find_problem
from tuning.reporting.time_figures import axis_label
from tuning.search.plan import Plan

SEED = 5
FIRST, LAST, EVERY = 400, 1000, 8  # steps of the episode of 10 ms each: twelve pictures and a half a second
COLOURS = 64
FLOW = 1  # place of the flow velocity in the state


@cache
def demo() -> Study:
    """The study of `make demo`."""
    folder = Path(tempfile.mkdtemp())
    plan = Plan(FILTER, (find_problem(SCENARIO),), seed=0)
    return run_tuning(plan, 50, progress_console, f"{folder}/studies.journal", out=folder / "tuned.json")


def before_and_after(tuning: Study) -> dict[str, Filter]:
    """The best baseline and the tuned filter, by the titles of their pictures."""
    before = best_baseline(tuning)
    choices = {before: baselines(FILTER, tuning.problem, tuning.plan.seed)[before], TUNED: tuning.result.choice}
    words = (f"before: {before}", f"after: {TUNED}")
    return {word: choice.filter(tuning.problem) for word, choice in zip(words, choices.values(), strict=True)}


def best_baseline(tuning: Study) -> str:
    """The baseline with the lowest score among those that need no truth."""
    evaluations = tuning.comparison.evaluations
    return min(
        (name for name in evaluations if name not in (TUNED, NOISE, ORACLE)),
        key=lambda name: evaluations[name].score.value,
    )


def tuned(path: Path) -> Path:
    """The flow velocity, which nothing measures, on a held-out run: estimate and error before and after tuning."""
    tuning = demo()
    scenario = tuning.problem
    data, unit = scenario.data(tuning.comparison.seeds[:1]), scenario.model().states[FLOW]
    time = scenario.dt * np.arange(data.states.shape[1])
    figure, axes = subplots((10.8, 4.4), 2, 2, sharex=True, sharey="row", height_ratios=(3, 2))
    for (above, below), (title, filter_) in zip(axes.T, before_and_after(tuning).items(), strict=True):
        estimates, truth = run(filter_, data.filter_keys, data.inputs, data.measurements), data.states[0, :, FLOW]
        mean, band = estimates.means[0, :, FLOW], 1.96 * np.sqrt(estimates.covs[0, :, FLOW, FLOW])
        above.fill_between(time, mean - band, mean + band, color=BLUE, alpha=0.3, linewidth=0, label="95 % band")
        above.plot(time, truth, color=DARK, linewidth=2.4, label="truth")
        above.plot(time, mean, color=BLUE, linewidth=1.0, label="estimate")
        below.fill_between(time, -band, band, color=BLUE, alpha=0.3, linewidth=0)
        below.plot(time, mean - truth, color=RUST, linewidth=1.0, label="error of the estimate")
        above.set_title(title)
        below.set_xlabel("time [s]")
    axes[0, 0].set_ylabel(axis_label(unit))
    axes[1, 0].set_ylabel(f"error\n[{unit.unit}]")
    legend_below(figure, axes[:, 0])
    return save_figure(figure, path)


def thruster(path: Path) -> Path:
    """The reversal task, filmed: truth, measurements with outliers, and what the tuned filter believes.

    The voltage is the one that would hold the reference in the steady state.
    """
    tuning = demo()
    sensors = tuning.problem.plant_arguments["sensors"]
    env = gym.make("BowThrusterReversal-v0", render_mode="rgb_array", sensors=sensors)
    env = EstimateState(env, tuned=str(tuning.file))
    top, full = env.unwrapped.plant.max_voltage, env.unwrapped.thrust_scale
    _, info = env.reset(seed=SEED)
    frames = []
    for step in range(1, LAST + 1):
        share = info["reference"] / full  # the thrust grows nearly with the square of the voltage
        voltage = top * math.copysign(abs(share) ** 0.5, share)
        *_, info = env.step(np.array([voltage], dtype=np.float32))
        if step > FIRST and step % EVERY == 0:
            frames.append(Image.fromarray(env.render()))
    env.close()
    palette = frames[len(frames) // 2].quantize(COLOURS, method=Image.Quantize.MEDIANCUT)
    first, *rest = (frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames)
    options = {"save_all": True, "append_images": rest, "duration": 10 * EVERY, "loop": 0, "optimize": True}
    write_whole(path, lambda stream: first.save(stream, format="gif", **options))
    return path


WIDE = {"width": 1360, "height": 900}
PAGE_COLOURS = 200  # a fraction of the bytes, and no difference to see
PATIENCE = 180_000  # [ms]
MOVED = 5.5  # R [N^2], where it stood at the 0.25 of the sensor's data sheet


def screenshot(page, url: str) -> bytes:
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


def explore(path: Path) -> None:
    """The page of `thruster explore` after a drag and a study, in Debian's Chromium."""
    from playwright.sync_api import sync_playwright

    server = Server(page_of(Bench(find_problem("outliers"), "ekf")), ends_when_left=False).start()
    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        picture = Image.open(io.BytesIO(screenshot(browser.new_page(viewport=WIDE), server.url)))
        browser.close()
    server.stop()
    picture.convert("RGB").quantize(PAGE_COLOURS, dither=Image.Dither.NONE).save(path, optimize=True)


FIGURES = {"tuned.png": tuned, "thruster.gif": thruster, "explore.png": explore}
