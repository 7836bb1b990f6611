"""Draw the two pictures of README.md: the thruster and its estimate, and a filter before and after tuning.

    python -m pages.readme_pictures [FOLDER]

They go into FOLDER, docs/ by default. Both show the filter that `make demo` tunes, tuned anew in some seconds. The
moving picture needs pygame. Every run gives the same.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Sequence
from pathlib import Path

import gymnasium as gym
import numpy as np
from PIL import Image

import thruster_env  # noqa: F401 - registers the envs
from filters import EstimateState
from filters.engine.batch import run
from pages.page import DOCS
from thruster_env.core.files import write_whole
from thruster_env.core.plots import BLUE, DARK, RUST, new_figure, save_figure, tidy
from tuning.api.run import Tuning
from tuning.cli.demo import FILTER, SCENARIO, before_and_after
from tuning.cli.tune import tune
from tuning.reporting.time_figures import axis_label
from tuning.search.plan import Plan
from tuning.thruster.scenario import find_scenario

SEED = 5
FIRST, LAST, EVERY = 400, 1000, 8  # steps of the episode of 10 ms each: twelve pictures and a half a second
COLOURS = 64
FLOW = 1  # place of the flow velocity in the state


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m pages.readme_pictures", description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, default=DOCS, metavar="FOLDER")
    folder = parser.parse_args(arguments).folder
    with tempfile.TemporaryDirectory() as scratch:
        plan = Plan(FILTER, (find_scenario(SCENARIO),), seed=0)
        tuning = tune(plan, 50, f"{scratch}/studies.journal", out=Path(scratch) / "tuned.json")
        tuned(folder / "tuned.png", tuning)
        thruster(folder / "thruster.gif", tuning)


def tuned(path: Path, tuning: Tuning) -> Path:
    """The flow velocity, which nothing measures, on a held-out run: estimate and error before and after tuning."""
    scenario = tuning.scenario
    data, unit = scenario.data(tuning.comparison.seeds[:1]), scenario.model().states[FLOW]
    time = scenario.dt * np.arange(data.states.shape[1])
    figure = new_figure((10.8, 4.4))
    axes = figure.subplots(2, 2, sharex=True, sharey="row", height_ratios=(3, 2))
    tidy(axes.flat)
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
    named = [pair for axis in axes[:, 0] for pair in zip(*axis.get_legend_handles_labels(), strict=True)]
    figure.legend(*zip(*named, strict=True), loc="outside lower center", ncols=len(named), frameon=False)
    return save_figure(figure, path)


def thruster(path: Path, tuning: Tuning) -> Path:
    """The reversal task, filmed: truth, measurements with outliers, and what the tuned filter believes.

    The voltage is the one that would hold the reference in the steady state.
    """
    sensors = tuning.scenario.plant_arguments["sensors"]
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
    return save_gif(path, frames, milliseconds=10 * EVERY)


def save_gif(path: Path, frames: Sequence[Image.Image], milliseconds: int) -> Path:
    """Pictures as one that moves, for ever, with one palette for all."""
    palette = frames[len(frames) // 2].quantize(COLOURS, method=Image.Quantize.MEDIANCUT)
    first, *rest = (frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames)
    options = {"save_all": True, "append_images": rest, "duration": milliseconds, "loop": 0, "optimize": True}
    write_whole(path, lambda stream: first.save(stream, format="gif", **options))
    return path


if __name__ == "__main__":
    main()
