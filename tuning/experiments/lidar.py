"""Turning targets seen by a lidar: noise in range and bearing, for a Kalman filter whose R is in Cartesian axes.

    x' = x + v + a/2,   v' = v + a,   z = (r + 2 m n_1)(cos, sin)(theta + 1.5 deg n_2)

A target begins within +-600 m at 30 to 90 m/s; four to six intervals of 5 to 8 steps have each one acceleration,
N(0, 2^2) along the path and uniform within +-15 across it. Only positions count. Our methods are compared with the
package `Optimized-Kalman-Filter` on equal data; without that package, of the extra `peers`, they run alone.

Source: the example of I. Greenberg, N. Yannay, S. Mannor (2023), "Optimization or architecture: how to hack Kalman
filtering", NeurIPS, arXiv 2310.00675, in that package; written anew.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import time
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from filters import affine_model
from filters.consistency.nees import Interval
from thruster_env.core.text_tables import markdown_table
from tuning.evaluation.baselines import with_covariances
from tuning.evaluation.evaluate import Evaluation, evaluate, mse
from tuning.methods.task import Task, find_method
from tuning.problems.model_problem import RunsProblem
from tuning.search.space import Choice, untuned_choice

RANGE, BEARING = 2.0, np.deg2rad(1.5)  # deviations [m, rad]
FIELD, SPEEDS = 600.0, (30.0, 90.0)  # [m], [m/s]
INTERVALS, STEPS = (4, 7), (5, 9)  # from, and up to but without
ALONG, ACROSS = 2.0, 15.0  # [m/s^2]
PRIOR = 1000.0  # variance of each state before the first measurement, whose position is taken
A = np.eye(4) + np.eye(4, k=2)
C = np.eye(2, 4)
LEARN, TEST = 700, 300  # runs of a draw
DRAWS = 3
FULL = {"full_q": True, "full_r": True}
OKF, NOISE, GRADIENT = "OKF, default", "noise estimation", "MSE by its gradient"
IN_A_FIFTH = "the same in a fifth of OKF's time"
METHODS: Mapping[str, tuple[str, Mapping[str, bool]]] = {  # names of rows, with the method and its options
    NOISE: ("noise-estimation", FULL),
    "ours, the method okf": ("okf", FULL),
    GRADIENT: ("mse", FULL),
    "-log p(z) by its gradient": ("likelihood", FULL),
    "EM": ("em", FULL),
    "log score by its gradient": ("log-score", FULL),
    "MSE by its gradient, diagonal": ("mse", {}),
    "log score by its gradient, diagonal": ("log-score", {}),
}
RESAMPLES = 2000


class Run(NamedTuple):
    """A target, and where it was seen."""

    states: np.ndarray  # (K + 1, 4), position and velocity
    measurements: np.ndarray  # (K + 1, 2)


def drawn(count: int, seed: int = 0) -> list[Run]:
    """Some targets."""
    rng, runs = np.random.default_rng([seed, count]), []
    for _ in range(count):
        speed, course = rng.uniform(*SPEEDS), rng.uniform(0.0, 2.0 * np.pi)
        states = [np.array([*rng.uniform(-FIELD, FIELD, 2), speed * np.cos(course), speed * np.sin(course)])]
        for _ in range(rng.integers(*INTERVALS)):
            along, across = rng.normal(0.0, ALONG), rng.uniform(-ACROSS, ACROSS)
            for _ in range(rng.integers(*STEPS)):
                x, v = states[-1][:2], states[-1][2:]
                ahead = v / np.hypot(*v)
                a = along * ahead + across * np.array([-ahead[1], ahead[0]])
                states.append(np.concatenate([x + v + a / 2.0, v + a]))
        path = np.array(states)
        distance = np.hypot(path[:, 0], path[:, 1]) + rng.normal(0.0, RANGE, len(path))
        angle = np.arctan2(path[:, 1], path[:, 0]) + rng.normal(0.0, BEARING, len(path))
        runs.append(Run(path, distance[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])))
    return runs


def lidar_problem(runs: list[Run], held_out: int) -> RunsProblem:
    """The problem of OKF's own filter: it begins where the first measurement is, with P_0 = 1000 I.

    Its model does not know where the origin is, so each run is seen from its first measurement: the prior's mean
    is zero, and so is the first innovation.

    Args:
        runs: the last of them are held out.
        held_out: how many.
    """
    logs = []
    for target in runs:
        first = target.measurements[0]
        states = target.states - np.concatenate([first, [0.0, 0.0]])
        logs.append({"measurements": target.measurements - first, "states": states})
    g = np.vstack([0.5 * np.eye(2), np.eye(2)])
    model = affine_model(
        a=A,
        b=np.zeros((4, 0)),
        c=C,
        process_noise_cov=25.0 * g @ g.T,
        measurement_noise_cov=[400.0, 400.0],
        prior_mean=[0.0] * 4,
        prior_cov=[PRIOR] * 4,
        states=[("easting", "x", "m"), ("northing", "y", "m"), ("speed", "v_x", "m/s"), ("speed", "v_y", "m/s")],
        measurements=[("measured easting", "z_x", "m"), ("measured northing", "z_y", "m")],
    )
    start = {"process_noise_cov": (25.0, 25.0, 100.0, 100.0), "measurement_noise_cov": (400.0, 400.0)}
    return RunsProblem(
        logs,
        model,
        held_out=range(len(runs) - held_out, len(runs)),
        scale=(1.0, 1.0, np.inf, np.inf),
        untuned=start,
        name="lidar",
        about="turning targets seen by a lidar; noise in range and bearing, R in Cartesian axes",
    )


class Row(NamedTuple):
    """A method on the runs that are held out, of D draws with B runs each."""

    name: str
    choices: tuple[Choice, ...]  # of each draw
    seconds: float  # of processor time for a draw, without compilation
    squares: np.ndarray  # (D, B) sum over the steps of a run of squared errors of the position
    steps: np.ndarray  # (D, B)
    nis: float  # over the number of channels
    nees: float  # over the number of states
    log_likelihood: float  # of a held-out run

    @property
    def mse(self) -> float:
        """Mean square error of the position over all steps [m^2]."""
        return float(self.squares.sum() / self.steps.sum())

    def over(self, other: Row) -> Interval:
        """The ratio of mean square errors, with a 95 % interval by bootstrap over draws, and over runs of each."""
        generator, (draws, runs) = np.random.default_rng(0), self.steps.shape
        of_draws = generator.integers(draws, size=(RESAMPLES, draws))[..., None]
        of_runs = generator.integers(runs, size=(RESAMPLES, draws, runs))
        ours, theirs = (row.squares[of_draws, of_runs].sum(axis=(1, 2)) for row in (self, other))
        return Interval(self.mse / other.mse, *np.quantile(ours / theirs, (0.025, 0.975)).tolist())

    @classmethod
    def pooled(cls, rows: Sequence[Row]) -> Row:
        """One method on all draws: means of what is not of a run."""
        columns = zip(*rows, strict=True)
        names, choices, seconds, squares, steps, *means = (list(column) for column in columns)
        joined = np.concatenate(squares), np.concatenate(steps)
        nis, nees, likelihood = (float(np.mean(column)) for column in means)
        return cls(names[0], sum(choices, ()), float(np.mean(seconds)), *joined, nis, nees, likelihood)


def compared(
    learn: int = LEARN,
    test: int = TEST,
    draws: int = DRAWS,
    methods: Mapping[str, tuple[str, Mapping[str, bool]]] = METHODS,
) -> list[Row]:
    """All methods, and OKF itself where it is installed, on the same runs of some draws."""
    by_draw = [of_draw(learn, test, seed, methods) for seed in range(draws)]
    return [Row.pooled(rows) for rows in zip(*by_draw, strict=True)]


def of_draw(learn: int, test: int, seed: int, methods: Mapping[str, tuple[str, Mapping[str, bool]]]) -> list[Row]:
    """All methods on the runs of one seed."""
    runs = drawn(learn + test, seed)
    problem, rows = lidar_problem(runs, test), []
    data, held_out = problem.data(range(learn)), problem.data(range(learn, learn + test))
    if is_installed():
        okf_itself(runs[:20], seed)  # packages are loaded
        begin = time.process_time()
        q, r = okf_itself(runs[:learn], seed)
        choice = with_covariances(untuned_choice("kf", problem), q, r)
        rows.append(row_of(OKF, choice, time.process_time() - begin, problem, held_out))
    for name, (method, options) in methods.items():
        task = Task("kf", problem, data, options=options)
        find_method(method).run(method, task, guarded=False)
        rows.append(row_of(name, task.best, task.seconds, problem, held_out))
        if name == GRADIENT and rows[0].name == OKF:
            fifth = rows[0].seconds / 5.0
            rows.append(row_of(IN_A_FIFTH, task.best_within(seconds=fifth), fifth, problem, held_out))
    return rows


def row_of(name: str, choice: Choice, seconds: float, problem: RunsProblem, held_out) -> Row:
    """A choice on held-out runs."""
    evaluation: Evaluation = evaluate(choice.filter(problem), held_out, problem.scale)
    steps = held_out.scored_counts
    squares = steps * np.array(
        [mse(run_squares[None], evaluation.scale) for run_squares in evaluation.mean_squares]
    )
    nis, nees = evaluation.nis.value / evaluation.expected_nis, evaluation.nees.value / len(evaluation.rmse)
    return Row(name, (choice,), seconds, squares[None], steps[None], nis, nees, evaluation.log_likelihood)


def is_installed() -> bool:
    """Whether OKF's package is there, with what it imports and does not declare."""
    return all(importlib.util.find_spec(package) is not None for package in ("okf", "pandas", "seaborn", "torch"))


def okf_itself(runs: list[Run], seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Q and R of the package's own training, with its defaults: one epoch."""
    from okf import OKF as OptimizedFilter
    from okf import train
    from okf.example.simple_lidar_model import model_args

    np.random.seed(seed)  # its batches are drawn from NumPy's global generator
    model = OptimizedFilter(**model_args(), optimize=True, model_name="OKF")
    with contextlib.redirect_stdout(io.StringIO()):
        measured, states = zip(*[(target.measurements, target.states) for target in runs], strict=True)
        train(model, list(measured), list(states), to_save=False, verbose=0)
    return model.get_Q(), model.get_R()


def markdown(rows: list[Row]) -> str:
    """The table, with ratios to OKF or, without it, to noise estimation."""
    first = next((row for row in rows if row.name == OKF), rows[0])
    heads = ["method", "seconds", "MSE [m^2]", f"over {first.name}", "NIS", "NEES", "log p(z) of a run"]
    cells = []
    for row in rows:
        ratio = row.over(first)
        ratio_text = f"{ratio.value:.3f} [{ratio.low:.3f}, {ratio.high:.3f}]" if row is not first else "1"
        numbers = f"{row.seconds:.1f}", f"{row.mse:.1f}", ratio_text, f"{row.nis:.2f}", f"{row.nees:.2f}"
        cells.append([row.name, *numbers, f"{row.log_likelihood:.3f}"])
    return markdown_table(heads, cells)


TABLES = {"okf": lambda: markdown(compared())}
