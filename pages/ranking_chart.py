"""The picture at the head of docs/ranking.md: which filter to take, as a list of questions.

`python -m pages.ranking_chart [FOLDER]` draws it into docs.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NamedTuple

from filters.logs.figure import colour_of
from pages.page import DOCS
from thruster_env.core.plots import DARK, GREY, new_figure, save_figure

FILE = "ranking_chart.png"
WIDTH, ROW = 9.6, 0.56  # [in]
QUESTION, ANSWER, WHY = 0.02, 0.455, 0.68  # left edges, as parts of the width


class Step(NamedTuple):
    """A question; if the answer is yes, the filters to take, and why."""

    question: str
    filters: tuple[str, ...]
    why: str


STEPS = (
    Step("Is the model linear and all noise Gaussian?", ("kf", "kf-steady"), "no filter has a smaller error"),
    Step("Are some measurements wrong (outliers)?", ("imm", "ekf-robust"), "a wrong reading barely moves them"),
    Step("Does the plant switch between models?", ("imm",), "probabilities of the models"),
    Step("Is it one of several models, but which?", ("mmae",), "the same, without switching"),
    Step("Could the state be in two places at once?", ("pf", "gsf"), "a mean and P cannot say that"),
    Step("Is it linear where a few states are known?", ("rbpf",), "particles for those few alone"),
    Step("Is it strongly curved within its uncertainty?", ("iekf", "ukf", "gsf"), "one tangent is not enough"),
    Step("A poor first guess, or bounds on the past?", ("mhe",), "it estimates them again, too"),
    Step("Does the noise of the sensor change?", ("vb", "sage-husa"), "they estimate R as they run"),
    Step("More states than you can afford members?", ("letkf",), "localised by distance"),
    Step("Are there dozens of states, or no Jacobian?", ("etkf", "enkf-n"), "enkf-n needs no inflation"),
    Step("Is the model wrong, and are states recorded?", ("gru", "kalmannet"), "networks trained on those runs"),
    Step("Is the model wrong in an unknown way?", ("fading", "h-infinity"), "they trust it less; or tune Q"),
)
OTHERWISE = Step("Otherwise", ("ekf",), "the least cost, gradients, C code")


def as_text() -> str:
    """The same as a numbered list, which a phone shows in letters large enough."""
    return "\n".join(
        f"{number}. {step.question} {', '.join(f'`{name}`' for name in step.filters)}: {step.why}."
        for number, step in enumerate((*STEPS, OTHERWISE), 1)
    )


def draw(folder: Path) -> Path:
    """Draw all questions, from the top; the first yes decides."""
    rows = len(STEPS) + 1
    figure = new_figure((WIDTH, ROW * rows + 0.25))
    figure.set_layout_engine("none")
    axis = figure.add_axes((0, 0, 1, 1))
    axis.set(xlim=(0, 1), ylim=(rows - 0.4, -0.6))
    axis.axis("off")
    box = {"boxstyle": "round,pad=0.35", "facecolor": "white", "edgecolor": GREY, "linewidth": 0.8}
    arrow = {"arrowstyle": "->", "color": GREY, "lw": 0.8}
    small = {"fontsize": 8, "color": GREY}
    for row, step in enumerate((*STEPS, OTHERWISE)):
        axis.text(QUESTION, row, step.question, va="center", fontsize=10, color=DARK, bbox=box)
        axis.annotate("", (ANSWER - 0.012, row), (ANSWER - 0.055, row), arrowprops=arrow)
        if step is not OTHERWISE:
            axis.text(ANSWER - 0.034, row - 0.17, "yes", ha="center", **small)
            axis.annotate("", (0.06, row + 0.72), (0.06, row + 0.3), arrowprops=arrow)
            axis.text(0.068, row + 0.51, "no", va="center", **small)
        left = ANSWER
        for name in step.filters:
            axis.text(left, row, name, va="center", fontsize=10, weight="bold", color=colour_of(name))
            left += 0.0118 * len(name) + 0.02
        axis.text(WHY, row, step.why, va="center", fontsize=9.5, color=DARK)
    return save_figure(figure, folder / FILE)


if __name__ == "__main__":
    print(draw(Path(sys.argv[1]) if len(sys.argv) > 1 else DOCS))
    print(as_text())
