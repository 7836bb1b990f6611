"""The report of a trained estimator: scores on held-out, longer and noisier runs, its training, and one run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from filters.filter import Filter
from thruster_env.core.files import write_whole
from tuning.problems.check import data_of
from tuning.problems.problem import Problem
from tuning.reporting.page import Section, Table, Words, html_page, of_estimates
from tuning.reporting.search_figures import Sketchbook
from tuning.reporting.sections import (
    AXES,
    READ,
)
from tuning.reporting.time_figures import draw_estimates


def write_training_report(
    page: str | Path,
    title: str,
    advice: Sequence[str],
    table: Table,
    training: Figure,
    pair: Mapping[str, Filter],
    problem: Problem,
    seed: int,
) -> Path:
    """Write a page on a trained estimator.

    Args:
        page: the .html file.
        title: of the page.
        advice: its summary.
        table: scores of all filters.
        training: picture of the checks.
        pair: the first filter and the estimator, for a picture of one run.
        problem: on whose runs it was trained.
        seed: of a held-out run.
    """
    book, data, dt = Sketchbook(), data_of(problem, [seed]), problem.dt
    scored = np.flatnonzero(np.isfinite(problem.scale or ())).tolist()
    where = f"{problem.name}, held-out {problem.seed_word.removesuffix('s')} {seed}"
    caption = f"Truth, estimate and 95 % band, if there is a covariance, on {where}. {AXES} {READ}"
    run = book.picture(draw_estimates(pair, data, 0, dt, scored), caption, of_estimates(pair, data, 0, dt))
    course = book.picture(training, "Scores of validation runs during the training.", "The score falls.")
    sections = [
        Section("Held-out runs", [table, Words(advice)]),
        Section("The training", [course]),
        Section("One run over time", [run]),
    ]
    write_whole(page, html_page(title, advice, sections))
    return Path(page)
