"""All filters on the same runs of a path: truth, estimates, scores, and a picture of the paths.

The papers do not define their paths. These are ours with the same names: each starts at rest at the origin, and on
IV the planes are chosen so that the path ends at the printed point, (10, 18, 6) m.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from filters.bounds import path_bound, wrapped_variances
from filters.consistency.nees import Interval, mean_interval, normalized_squares, rmse_intervals
from filters.engine.batch import run
from filters.filter import Filter
from filters.logs.findings import TRUTH as TRUTH_LOOK
from filters.logs.findings import plot_style
from thruster_env.auv.paths import CRUISE_THRUST, MANOEUVRES, TORQUE_PER_THRUST
from thruster_env.core.checks import at_least, one_of
from thruster_env.core.files import BLUE, GREEN, PLUM, SKY, legend_below, new_figure, save_figure
from thruster_env.model.simulate import Truth, simulate
from tuning.experiments.vehicle_papers import (
    DT,
    MEASURED,
    NGATINI2017,
    NGATINI2019,
    PRINTED_MEMBERS,
    RUNS,
    Estimator,
    Paper,
    ensembles,
    full_pose,
    fuzzy,
    kalman,
    measured,
    papers_model,
    planar_pose,
    pose_errors,
)

THRUST = 2.84531  # [N]; holds 1 m/s, the printed speed
MOST_RUNS = 10_000
AT_A_TIME = 4  # runs: 31560 steps of eight states and covariances are 23 MB a run, and Ctrl-C waits for them
SETTLED = 2000  # steps, after which velocities are scored
OnPart = Callable[[int, int, str], None]  # (done, total, what was done)

# Of the papers' studies.
OTHER_WORLD = "no restoring moments"

# Of the picture.
TRUTH = "truth"
STYLES = {
    TRUTH: TRUTH_LOOK,
    "EnKF8 N=50": plot_style("enkf") | {"linewidth": 1.4},
    "EnKF8 N=100": {"color": GREEN, "linewidth": 1.2, "linestyle": (0, (6, 3))},
    "EnKF8 N=200": {"color": SKY, "linewidth": 1.2, "linestyle": (0, (3, 3))},
    "EnKF8 N=300": {"color": PLUM, "linewidth": 1.2, "linestyle": (0, (1, 2))},
    "EnKF8 N=50 by yaw alone": {"color": BLUE, "linewidth": 1.4, "linestyle": (0, (4, 2))},
    "fuzzy 0..1": plot_style("fuzzy") | {"linewidth": 1.2, "linestyle": (0, (1, 1))},
}
LEAST_SPAN = 2.0  # of an axis [m]: millimetres of a straight path are no shape
EVERY = 20  # steps between points of a line


PATHS = dict(zip(MANOEUVRES, ("turn", "dive", "straight", "three-dimensional", "dynamic"), strict=True))
"""What each path is, by name. The meanings of I, II and III are inferred from the order of a conclusion."""


def path_inputs(name: str, steps: int | None = None) -> np.ndarray:
    """X_prop [N], K_prop [N m], delta_s and delta_r [rad] of the first so many steps, all if None, (K, 4)."""
    manoeuvre = MANOEUVRES[one_of("path", name, tuple(PATHS))]
    count = math.floor(manoeuvre.duration / DT)
    middles = DT * (np.arange(count if steps is None else min(steps, count)) + 0.5)
    inputs = np.array([manoeuvre.inputs(time) for time in middles])
    inputs[:, 0] *= THRUST / CRUISE_THRUST
    if manoeuvre.thrust_period is not None:
        inputs[:, 1] = TORQUE_PER_THRUST * inputs[:, 0]
    return inputs


class Scores(NamedTuple):
    """A filter's errors in B runs; NaN where it has no estimate.

    Velocities are u, v, w [m/s] and p, q, r [rad/s], attitude is roll and pitch [rad]; both are scored from 2 s
    on, as the NEES is. A pose is x, y, z [m] and psi [rad], scored over the whole run as the papers do, it seems.
    """

    velocities: np.ndarray  # (B, 6), mean squares
    attitude: np.ndarray  # (B, 2), mean squares
    full: np.ndarray  # (B, 4), mean squares of the pose by the full transformation
    planar: np.ndarray  # (B, 4), the same by yaw alone
    planar_both: np.ndarray  # (B, 4), by yaw alone, against the path that true velocities give by yaw alone
    full_end: np.ndarray  # (B, 4), absolute errors at the end
    planar_end: np.ndarray  # (B, 4)
    nees: np.ndarray  # (B,), mean
    divergences: np.ndarray  # (B,), filter resets: restarts from the prior
    seconds: np.ndarray  # (B,), of one core

    def rmse(self, field: str) -> np.ndarray:
        """RMSE of each component of a field of mean squares."""
        return np.sqrt(getattr(self, field).mean(axis=0))

    def intervals(self, field: str) -> tuple[Interval, ...]:
        """The same with 95 % intervals by bootstrap over runs."""
        return rmse_intervals(getattr(self, field))

    @property
    def nees_interval(self) -> Interval:
        """Mean NEES with its interval."""
        return mean_interval(self.nees)


def joined(parts: Sequence[Scores]) -> Scores:
    """Scores of all runs from those of some at a time."""
    return Scores(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


MEASURED_PLACES = tuple("uvwpqr".index(name) for name in MEASURED)


class Bound(NamedTuple):
    """Least RMSE of any estimate along the noise-free path: roots of mean variances over the scored steps."""

    velocities: np.ndarray  # (6,)
    attitude: np.ndarray  # (2,)
    pose: np.ndarray  # (4,)


class PathResult(NamedTuple):
    """All filters on one path of one world."""

    path: str
    world: str
    steps: int
    end: np.ndarray  # (4,), x, y, z [m] and psi [rad] at the end without noise
    planar_gap: np.ndarray  # (4,), RMSE of the transformation by yaw alone, of the velocities without noise
    outside: np.ndarray  # (7,), fraction of time in which each velocity is outside 0..1, then in which any is
    bound: Bound
    scores: dict[str, Scores]  # by label of the filter


class Task(NamedTuple):
    """A path, a world, and the filters to run there."""

    path: str
    world: str
    estimators: Sequence[Estimator]


def settled(steps: int) -> slice:
    """The scored steps of velocities: from 2 s on, or the second half of a shorter run."""
    return slice(min(SETTLED, steps // 2) + 1, None)


def keys_of(path: str, runs: int, seed: int) -> np.ndarray:
    """Keys of the runs of one path, (runs, 2), for both truth and filters, whose random streams differ."""
    generator = np.random.default_rng([seed, tuple(PATHS).index(path)])
    return generator.integers(0, 2**32, size=(runs, 2)).astype(np.float64)


def run_tasks(
    tasks: Sequence[Task],
    *,
    runs: int = RUNS,
    seed: int = 0,
    steps: int | None = None,
    on_part: OnPart = lambda done, total, label: None,
) -> list[PathResult]:
    """Run every task's filters on the same runs.

    Args:
        tasks: the tasks.
        runs: number of independent runs of each path, at least 2.
        seed: seed of all random numbers.
        steps: number of first steps of each path; all if None.
        on_part: called with the number of finished parts, the number of all parts, and the next one.

    Raises:
        ValueError: if an argument breaks its rule.
    """
    runs, seed = at_least("runs", runs, 2, MOST_RUNS), at_least("seed", seed, 0)
    if steps is not None:
        steps = at_least("steps", steps, 2, max(len(path_inputs(name)) for name in PATHS))
    parts = [slice(first, min(first + AT_A_TIME, runs)) for first in range(0, runs, AT_A_TIME)]
    total, done, results = sum(len(task.estimators) for task in tasks) * len(parts), 0, []
    for task in tasks:
        inputs, keys = path_inputs(task.path, steps), keys_of(task.path, runs, seed)
        by_estimator: dict[str, list[Scores]] = {estimator.label: [] for estimator in task.estimators}
        for part in parts:
            truth = true_runs(task.world, keys[part], inputs)
            for estimator in task.estimators:
                on_part(done, total, f"path {task.path}, {estimator.label}")
                by_estimator[estimator.label].append(scores_of(estimator, truth, keys[part], inputs))
                done += 1
        scores = {label: joined(several) for label, several in by_estimator.items()}
        results.append(PathResult(task.path, task.world, len(inputs), *along_path(task.world, inputs), scores))
    on_part(done, total, "done")
    return results


def true_runs(world: str, keys: np.ndarray, inputs: np.ndarray) -> Truth:
    """True states (B, K + 1, 12) and measurements (B, K + 1, 4), one run for each of the keys (B, 2)."""
    return simulate(papers_model("navigation", world), keys, for_all(inputs, len(keys)))


def for_all(inputs: np.ndarray, runs: int) -> np.ndarray:
    """The same inputs (K, p) for each of so many runs, (B, K, p)."""
    return np.ascontiguousarray(np.broadcast_to(inputs, (runs, *inputs.shape)))


def for_filter(filter_: Filter, inputs: np.ndarray, runs: int) -> np.ndarray:
    """Inputs of a filter's model; where roll and pitch are inputs, they are zero."""
    level = np.zeros((len(inputs), filter_.model.inputs - inputs.shape[1]))
    return for_all(np.concatenate([inputs, level], axis=1), runs)


def estimate(estimator: Estimator, truth: Truth, keys: np.ndarray, inputs: np.ndarray):
    """Estimates of a filter on some runs, and its seconds of one core without compilation."""
    if estimator.filter is None:
        raise ValueError(f"an estimate must be by a filter, but {estimator.label} has none")
    filter_inputs = for_filter(estimator.filter, inputs, len(keys))
    run(estimator.filter, keys[:1], filter_inputs[:1, :1], truth.measurements[:1, :2])
    began = time.process_time()
    estimates = run(estimator.filter, keys, filter_inputs, truth.measurements)
    return estimates, time.process_time() - began


def scores_of(estimator: Estimator, truth: Truth, keys: np.ndarray, inputs: np.ndarray) -> Scores:
    """The scores of an estimator on some runs."""
    count, steps, true_pose = len(keys), settled(len(inputs)), truth.states[..., [9, 10, 11, 8]]
    nothing = np.full((count, 4), np.nan)
    if estimator.filter is None:
        velocities = measured_velocities(truth)
        errors = (velocities - truth.states[..., :6])[:, steps]
        errors[..., 3:5] = np.nan
        attitude, nees, divergences, seconds = nothing[:, :2], nothing[:, 0], np.zeros(count), 0.0
        full = None
    else:
        estimates, seconds = estimate(estimator, truth, keys, inputs)
        n = estimator.filter.model.n
        all_errors = (estimates.means - truth.states[..., :n])[:, steps]
        nees = normalized_squares(all_errors, estimates.covs[:, steps]).mean(axis=1)
        divergences = estimates.divergences
        velocities, errors = estimates.means[..., :6], all_errors[..., :6]
        attitude = np.square(all_errors[..., 6:]).mean(axis=1) if estimator.has_attitude else nothing[:, :2]
        reckoned = full_pose(velocities, estimates.means[..., 6:] if estimator.has_attitude else None, DT)
        full = pose_errors(reckoned, true_pose)
    by_yaw = planar_pose(velocities, DT)
    planar = pose_errors(by_yaw, true_pose)
    both = pose_errors(by_yaw, planar_pose(truth.states[..., :6], DT))
    return Scores(
        np.square(errors).mean(axis=1),
        attitude,
        nothing if full is None else np.square(full).mean(axis=1),
        np.square(planar).mean(axis=1),
        np.square(both).mean(axis=1),
        nothing if full is None else np.abs(full[:, -1]),
        np.abs(planar[:, -1]),
        nees,
        divergences,
        np.full(count, seconds / count),
    )


def measured_velocities(truth: Truth) -> np.ndarray:
    """The measurements as velocities (B, K + 1, 6), with zeros for p and q."""
    velocities = np.zeros((*truth.measurements.shape[:2], 6))
    velocities[..., list(MEASURED_PLACES)] = truth.measurements
    return velocities


def noise_free(world: str, inputs: np.ndarray) -> np.ndarray:
    """States (K + 1, 12) from rest at the origin without any noise."""
    model = papers_model("navigation", world, process_noise_cov=(0.0,) * 12)
    still = model.replace(prior_cov=(0.0,) * 12)
    return simulate(still, np.zeros((1, 2)), inputs[None]).states[0]


def along_path(world: str, inputs: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, Bound]:
    """End, gap of the transformation by yaw alone, share outside the bounds, and the bound, all without noise.

    The bound is `filters.bounds.path_bound`: the posterior bound is useless with a noise of 1e-6 rad per step on
    the angles.
    """
    states, steps = noise_free(world, inputs), settled(len(inputs))
    pose = states[:, [9, 10, 11, 8]]
    gap = pose_errors(planar_pose(states[None, :, :6], DT)[0], pose)
    beyond = (states[:, :6] < 0.0) | (states[:, :6] > 1.0)
    outside = np.append(beyond.mean(axis=0), beyond.any(axis=1).mean())
    model = papers_model("navigation", world)
    covs = path_bound(model, inputs[None])[0]
    variances = wrapped_variances(np.diagonal(covs, axis1=1, axis2=2), model.shape.state_angles)
    bound = Bound(
        np.sqrt(variances[steps, :6].mean(axis=0)),
        np.sqrt(variances[steps, 6:8].mean(axis=0)),
        np.sqrt(variances[:, [9, 10, 11, 8]].mean(axis=0)),
    )
    return pose[-1], np.sqrt(np.square(gap).mean(axis=0)), outside, bound


PAPERS: dict[str, Paper] = {paper.name: paper for paper in (NGATINI2017, NGATINI2019)}


def tasks_of(paper: str) -> list[Task]:
    """The tasks of "ngatini2017" or "ngatini2019"; ValueError for another name."""
    if one_of("paper", paper, tuple(PAPERS)) == NGATINI2019.name:
        return [Task("IV", "vehicle", [measured(), *kalman(), *ensembles(8)])]
    (printed, *wide), ekf8, enkf = fuzzy(), kalman()[0], ensembles(8, members=(PRINTED_MEMBERS,))[0]
    few = [measured(), ekf8, enkf, printed]
    paths = [Task(name, "vehicle", few) for name in ("I", "II", "III")]
    paths += [Task(name, "vehicle", [*few, *wide]) for name in ("IV", "dynamic")]
    ekf8, _, ekf6, _ = kalman(OTHER_WORLD)
    closed = [measured(), ekf8, ekf6, *ensembles(6, OTHER_WORLD), *fuzzy(OTHER_WORLD)]
    return [*paths, Task("dynamic", OTHER_WORLD, closed)]


class PathRun(NamedTuple):
    """One run of a path."""

    path: str
    time: np.ndarray  # (T,) [s]
    positions: dict[str, np.ndarray]  # x, y, z [m] by what they are, (T, 3)


def path_run(path: str, estimators: Sequence[Estimator], *, seed: int = 0, steps: int | None = None) -> PathRun:
    """The first of the runs that the study makes with the same seed, every 20 ms of it."""
    inputs, keys = path_inputs(path, steps), keys_of(path, 1, at_least("seed", seed, 0))
    truth = true_runs("vehicle", keys, inputs)
    positions = {TRUTH: truth.states[0, :, 9:]}
    for estimator in estimators:
        means = estimate(estimator, truth, keys, inputs)[0].means
        pose = full_pose(means[..., :6], means[..., 6:] if estimator.has_attitude else None, DT)
        positions[estimator.label] = pose[0, :, :3]
        if estimator is estimators[0]:
            positions[f"{estimator.label} by yaw alone"] = planar_pose(means[..., :6], DT)[0, :, :3]
    thinned = {label: line[::EVERY] for label, line in positions.items()}
    return PathRun(path, DT * np.arange(len(inputs) + 1)[::EVERY], thinned)


def path_runs(paper: str, *, seed: int = 0, steps: int | None = None) -> list[PathRun]:
    """One run of every path that a paper shows."""
    if paper == NGATINI2019.name:
        return [path_run("IV", ensembles(8)[:-1], seed=seed, steps=steps)]
    both = [ensembles(8, members=(PRINTED_MEMBERS,))[0], fuzzy()[0]]
    return [path_run(path, both, seed=seed, steps=steps) for path in PATHS]


def paths_figure(path: str | Path, runs: Sequence[PathRun]) -> Path:
    """Paths to the north, to the east and down as PNG, a panel each."""
    columns = min(3, len(runs))
    rows = -(-len(runs) // columns)
    side = 4.2 if columns > 1 else 7.0
    figure = new_figure((side * columns + 0.5, 0.84 * side * rows + 0.4))
    width = 1.0 - 0.5 / figure.get_figwidth()  # labels of depth stick out
    figure.get_layout_engine().set(rect=(0.0, 0.0, width, 1.0))
    for panel, drawn in enumerate(runs, start=1):
        axis = figure.add_subplot(rows, columns, panel, projection="3d")
        for label, line in drawn.positions.items():
            axis.plot(*line.T, label=label, **STYLES[label])
        _arrange(axis, np.concatenate(list(drawn.positions.values())))
        meaning = PATHS[drawn.path]
        axis.set_title(drawn.path if drawn.path == meaning else f"{drawn.path}: {meaning}", fontsize=11, y=0.94)
    if rows * columns > len(runs):
        corner = figure.add_subplot(rows, columns, rows * columns)
        corner.axis("off")
        corner.legend(*axis.get_legend_handles_labels(), loc="center", frameon=False)
    else:
        legend_below(figure, [axis], 3)
    return save_figure(figure, path)


def _arrange(axis, points: np.ndarray) -> None:
    """Labels, limits with a least span, depth downwards."""
    from matplotlib.ticker import MaxNLocator

    low, high = points.min(axis=0), points.max(axis=0)
    middle, half = (low + high) / 2, np.maximum(1.04 * (high - low), LEAST_SPAN) / 2
    (north, east, down) = zip(middle - half, middle + half, strict=True)
    axis.set(xlabel="north [m]", ylabel="east [m]", zlabel="down [m]", xlim=north, ylim=east, zlim=down[::-1])
    for each in (axis.xaxis, axis.yaxis, axis.zaxis):
        each.set_major_locator(MaxNLocator(5))
        each.set_pane_color((0.97, 0.97, 0.97))
        each._axinfo["grid"].update(color="#dddddd", linewidth=0.6)
    axis.tick_params(labelsize=8, pad=0)
    axis.set_box_aspect((4, 4, 3), zoom=0.95)  # or the label of depth is cut off
    axis.patch.set_visible(False)  # or it lies over that of the panel to the left
    axis.view_init(elev=24, azim=-58)
