"""How often `tuning.fit` is right, for docs/q_and_r.md.

Sets are drawn from a level, a velocity, an acceleration and an oscillation, exactly at their times: 50 to 5000
rows, steps that are equal or jitter by up to a fifth, 5 % of the rows missing in gaps. The noise of the state
moves the measurement within a step by a tenth of to ten times R's deviation; an oscillation has such a deviation,
a period of 10 to 100 rows and a damping of 0.01 to 0.3.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import betaincinv

import tuning
from docs.scripts import by_name
from filters.models import named_model
from thruster_env.core.text_tables import markdown_table

SETS, CHOICES = 200, 40  # of each model, for intervals, and for the choice among models
MODELS = "constant", "constant-velocity", "constant-acceleration", "oscillator"
LEAST_ROWS, ENOUGH, MOST_ROWS = 50, 500, 5000  # of a set; a model is chosen from ENOUGH rows on
R = 1.0
GAPS, LONGEST_GAP = 0.05, 10  # share of the rows, and rows
WEAK = 0.1**0.5  # of the noise's deviation: an oscillation below a tenth of the noise's variance
# over R, and the square of the deviation within a step: a density of 1 adds its inverse to the variance in 1 s
IN_A_STEP = {"constant": 1.0, "constant-velocity": 3.0, "constant-acceleration": 20.0}


class Set(NamedTuple):
    """Numbers of a named model at their times."""

    name: str
    times: np.ndarray
    z: np.ndarray
    values: dict[str, float]  # that drew them: of the free numbers, and R
    ratio: float  # of the state's deviation within a step, or of an oscillation's, to the noise's


def drawn(name: str, seed: int, least: int = LEAST_ROWS, most: int = MOST_ROWS) -> Set:
    """A set of a model, of a number of rows between two."""
    generator = np.random.default_rng([seed, MODELS.index(name)])
    rows = round(least * (most / least) ** generator.uniform())
    times = np.arange(rows) + generator.integers(2) * generator.uniform(-0.1, 0.1, rows)
    present = np.ones(rows, dtype=bool)
    while present.mean() > 1.0 - GAPS:
        first = generator.integers(1, rows - 1)
        present[first : first + generator.integers(1, LONGEST_GAP + 1)] = False
    times, ratio = times[present] - times[0], 10.0 ** generator.uniform(-1.0, 1.0)
    if name == "oscillator":
        period, damping = 10.0 ** generator.uniform(1.0, 2.0), 0.01 * 30.0 ** generator.uniform()
        values = {"frequency": 1.0 / period, "damping": damping, "std": ratio}
    else:
        values = {named_model(name).free[0].name: IN_A_STEP[name] * ratio**2}
    signal = named_model(name).signal(values)
    f, noises = signal.steps(signal.slope, np.diff(times), 1.0)
    squares, axes = np.linalg.eigh(np.tensordot(np.diag(signal.densities)[list(signal.driven)], noises, 1))
    roots, n = axes * np.sqrt(np.maximum(squares, 0.0))[:, None, :], len(signal.output)
    first_variances = np.diag(signal.first)
    x = np.sqrt(np.where(np.isfinite(first_variances), first_variances, 0.0)) * generator.normal(size=n)
    z = np.empty(len(times))
    for k in range(len(times)):
        if k:
            x = f[k - 1] @ x + roots[k - 1] @ generator.normal(size=n)
        z[k] = signal.output @ x + np.sqrt(R) * generator.normal()
    return Set(name, times, z, {**values, "R": R}, ratio)


def hits(data: Set) -> dict[str, bool]:
    """Whether the interval of each number holds the value that drew the set."""
    fit = tuning.fit(data.z, times=data.times, model=data.name)
    return {number.name: number.low <= data.values[number.name] <= number.high for number in fit.numbers}


def share(right: list[bool]) -> str:
    """How many are right, and a 95 % interval of their rate by Clopper and Pearson."""
    count, n = sum(right), len(right)
    low = betaincinv(count, n - count + 1, 0.025) if count else 0.0
    high = betaincinv(count + 1, n - count, 0.975) if count < n else 1.0
    return f"{100 * count / n:.0f} % [{100 * low:.0f}, {100 * high:.0f}]"


def coverage() -> str:
    """Of each model, how often `auto` finds it and intervals hold its numbers."""
    rows = []
    for name in MODELS:
        of_sets = [hits(drawn(name, seed)) for seed in range(SETS)]
        rates = [f"{number} {share([of_set[number] for of_set in of_sets])}" for number in of_sets[0]]
        sets = [drawn(name, 500 + seed, ENOUGH, 3 * ENOUGH) for seed in range(CHOICES)]
        chosen = [tuning.fit(data.z, times=data.times).name == name for data in sets]
        strong = [right for right, data in zip(chosen, sets, strict=True) if data.ratio >= WEAK]
        choice = share(strong if name == "oscillator" else chosen)
        rows.append((f"`{name}`", choice, ", ".join(rates[:-1]), rates[-1].removeprefix("R ")))
    return markdown_table(("data of", "`auto` finds it", "intervals hold", "of R"), rows)


TABLES = by_name(coverage)
