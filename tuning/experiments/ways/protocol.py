"""How much is done: cases, ways, data sets and budgets."""

from __future__ import annotations

from typing import NamedTuple

from tuning.experiments.ways.problems import CASES, QUICK, Case
from tuning.ways.registry import WAYS

RUNS, SECONDS = (1e3, 1e4, 1e5), (1.0, 10.0, 100.0)  # budgets
STARTS = ((1.0, 1.0), (100.0, 1.0), (0.01, 100.0))  # factors on the rule of thumb's Q and R, by turns of data sets
REFERENCE = "reference"  # the best constant numbers
START, SCALED, ORACLE = "start", "scaled default", "oracle"
STUDY, STUDY_LOG_SCORE = "study", "study of log-score"  # of 50 trials, as `thruster tune` makes them
TRIALS = 50
WITH_FULL = ", full"  # behind a way: it tunes full Q and R, where the others of a case tune diagonals
FROM_NOISE = ", full, from noise estimation"  # the same, and begins there: added after the first results
FULL_WAYS = (
    *(f"{way}{WITH_FULL}" for way in ("mse", "log-score", "likelihood", "als")),
    *(f"{way}{FROM_NOISE}" for way in ("mse", "log-score")),
)
ENTRIES = (*WAYS, *FULL_WAYS, START, SCALED, ORACLE, STUDY, STUDY_LOG_SCORE)


class Protocol(NamedTuple):
    """How much is done."""

    cases: tuple[Case, ...] = CASES
    ways: tuple[str, ...] = ENTRIES
    sets: int = 20
    runs: float = max(RUNS)
    seconds: float = max(SECONDS)
    held_out: int = 200
    many: int = 2000  # runs for the reference ...
    starts: int = 20  # ... and its starts


FAST = Protocol(
    QUICK, ("likelihood", "log-score", "em", "noise-estimation", "random", START), 3, 200, 2.0, 20, 20, 2
)
