"""The tables of docs/auv.md on control and on filters, which of them, with which Q, R and N, and a frame."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import gymnasium as gym
import numpy as np

import thruster_env.auv  # noqa: F401 - registers the envs
from docs.scripts import by_name, digits, returns_of, save_frame
from docs.scripts.ranking import leaderboard
from filters import EstimateState
from filters.augmented import Unknown
from filters.consistency.nees import Interval
from thruster_env.auv.dynamics import ROTATING, angled_state
from thruster_env.auv.paths import MANOEUVRES, DepthAndCourse
from thruster_env.core.files import new_figure, save_figure, tidy
from thruster_env.core.text_tables import markdown_table
from thruster_env.env.env import ObserveStateVector
from thruster_env.model import rotations
from thruster_env.model.turns import difference
from tuning.evaluation.compare import Contender, Row, contender
from tuning.plants.auv import Scenario, find_scenario
from tuning.problems.problem import Problem
from tuning.search.space import Choice

EPISODES, STILL = 50, (2.845, 0.0, 0.0)  # copies of an env; its action that cruises with planes held still


def frame(path: Path) -> Path:
    """A frame of path IV under PD on the estimate of an extended Kalman filter."""
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    env = EstimateState(gym.make("SegorogeniAUVPath-v0", path="IV", render_mode="rgb_array"), "ekf")
    controller, state = DepthAndCourse.for_env(env, "navigation"), None
    observation, _ = env.reset(seed=3)
    for _ in range(420):
        action, state = controller.predict(observation, state)
        observation, *_ = env.step(action)
    return save_frame(env, path)


def loop(path: Path) -> Path:
    """Over the top with a quaternion: the path from the side, pitch, and the error of attitude."""
    arguments = {"attitude": "quaternion", "sensors": "vectors", "max_thrust": 8.0, "depth": 20.0}
    env = EstimateState(gym.make("SegorogeniAUV-v0", **arguments), "ekf")
    env.reset(seed=1)
    states, estimates, covs = [], [], []
    for _ in range(240):
        info = env.step([8.0, -np.radians(15.0), 0.0])[-1]
        for values, name in ((states, "state"), (estimates, "estimate"), (covs, "estimate_cov")):
            values.append(info[name])
    truth, time = np.transpose(states), 0.05 * np.arange(1, 241)
    off = np.array([difference(x, y, ROTATING)[6:9] for x, y in zip(states, estimates, strict=True)])
    std = np.sqrt(np.array([np.trace(cov[6:9, 6:9]) for cov in covs]))
    figure = new_figure((7.5, 3.0))
    side, rise, error = figure.subplots(1, 3)
    side.plot(truth[10], truth[12], color="0.6")
    for k in range(0, 240, 12):
        ahead, _, down = rotations.to_world(truth[6:10, k], (1.0, 0.0, 0.0))
        side.plot(
            truth[10, k] + np.array([-0.4, 0.4]) * ahead, truth[12, k] + np.array([-0.4, 0.4]) * down, color="C0"
        )
    side.invert_yaxis()
    side.set_aspect("equal", adjustable="datalim")
    side.set(xlabel="north [m]", ylabel="depth [m]")
    level = rotations.to_world(truth[6:10], (0.0, 0.0, 1.0))[2] > 0.0
    pitch = np.degrees(angled_state(truth)[7])
    rise.plot(time, np.where(level, pitch, np.nan), color="C0", label="upright")
    rise.plot(time, np.where(level, np.nan, pitch), color="C3", label="on its back")
    rise.axhline(90.0, color="0.6", linewidth=0.8)
    rise.set(xlabel="time [s]", ylabel="pitch [deg]", ylim=(-5.0, 140.0), yticks=range(0, 91, 30))
    rise.legend(loc="upper right")
    error.plot(time, np.degrees(np.linalg.norm(off, axis=1)), color="C0", label="error")
    error.plot(time, np.degrees(std), color="0.6", label="standard deviation")
    error.set(xlabel="time [s]", ylabel="attitude [deg]", ylim=(0.0, 0.9))
    error.legend(loc="upper right")
    tidy((side, rise, error))
    return save_figure(figure, path)


def returns() -> str:
    """Mean return of an episode: PD on measurements, on the true state, and planes held still."""
    tasks = [("Path", {"path": name}) for name in MANOEUVRES] + [("Depth", {})]
    rows = []
    for task, arguments in tasks:
        name = f"SegorogeniAUV{task}-v0"
        env = gym.make_vec(name, EPISODES, **arguments)
        true = ObserveStateVector(gym.make_vec(name, EPISODES, **arguments))
        scores = (
            returns_of(env, DepthAndCourse.for_env(env), STILL).mean(),
            returns_of(true, DepthAndCourse.for_env(true, "navigation"), STILL).mean(),
            returns_of(env, None, STILL).mean(),
        )
        rows.append([f"path {arguments['path']}" if arguments else "depth", *(digits(score) for score in scores)])
    return markdown_table(["task", "PD on measurements", "PD on the true state", "planes still, 2.845 N"], rows)


RUNS, FEW = 50, 20  # 1 kHz runs of 5 s are few: each is 5000 steps of every member
EKF, ROBUST, UKF = (contender(name) for name in ("ekf", "ekf-robust", "ukf"))
ENKF, ETKF = contender("enkf", ensemble_size=100), contender("etkf", ensemble_size=50)
FILTERS = (EKF, ROBUST, ENKF, ETKF)
MOTION = ("auv:motion", "auv:dvl_outliers", "auv:wrong_drag")
NAVIGATION = ("auv:navigation", "auv:dvl_dropout", "auv:current", "auv:usbl", "auv:no_dvl", "auv:loop")
HEADER = ("filter", "over the EKF's", "NEES", "NIS / m")
AXIAL_DRAG = {"x_uu": Unknown(std=1.5, walk_std=0.005)}
"""The drag ahead [kg/m]: believed to within its own size at first, and slow to change."""

DRAG = {**AXIAL_DRAG, "y_uv": Unknown(std=8.0, walk_std=0.03), "z_uw": Unknown(std=8.0, walk_std=0.03)}
"""With it what the hull's and fins' lift does across, u v and u w [kg/m], to within a fifth."""


def small(name: str, size: int = 50, **numbers: float) -> Contender:
    """An ensemble of so many members."""
    return contender(name, ensemble_size=size, **numbers)


def restless(filter_: Contender, variance: float) -> Contender:
    """The same with so much process noise of roll and pitch [rad^2] a step in its model."""

    def choose(problem: Problem) -> Choice:
        known = filter_.choose(problem)
        cov = (*known.model["process_noise_cov"][:6], variance, variance)
        return known._replace(model={**known.model, "process_noise_cov": cov})

    return Contender(f"{filter_.label}, angles {variance:g} rad^2", choose)


MEMBERS = [small("enkf", size) for size in (50, 100, 200, 300)]
CURES = [
    *(small("enkf"), *(small("enkf", inflation=inflation) for inflation in (1.02, 1.05))),
    *(small("enkf", relaxation=0.5), small("enkf", inflation=1.05, relaxation=0.3), restless(small("enkf"), 1e-6)),
    *(small("etkf"), small("etkf", relaxation=0.45), small("etkf", inflation=1.02, relaxation=0.3)),
]
FAST_CURES = [
    *(small("enkf", size) for size in (50, 300, 1000)),
    *(small("enkf", inflation=inflation) for inflation in (1.02, 1.05)),
    *(small("enkf", relaxation=0.5), restless(small("enkf"), 1e-6), small("etkf")),
    *(small("etkf", inflation=inflation) for inflation in (1.01, 1.02)),
    *(small("etkf", relaxation=0.4), small("etkf", 300)),
]


def filters_current() -> str:
    """RMSE in a current, of a filter without the current and of one with two states for it."""
    symbols = ("u", "v", "psi", "x", "y", "c_x", "c_y")
    lines, units = [], {}
    for name in ("auv:current", "auv:estimated_current"):
        (row,) = rows_of(name, [EKF])
        evaluation = row.evaluation
        errors = {state.symbol: error for state, error in zip(evaluation.states, evaluation.rmse, strict=True)}
        units |= {state.symbol: state.unit for state in evaluation.states}
        known = [digits(errors[symbol].value, 2) if symbol in errors else "" for symbol in symbols]
        lines.append([f"`{name}`, {len(errors)} states", *known, f"{about(evaluation.nees)} of {len(errors)}"])
    return markdown_table(["EKF", *(f"{symbol} [{units[symbol]}]" for symbol in symbols), "NEES"], lines)


def rows_of(scenario: str | Scenario, filters: Sequence[Contender], runs: int = RUNS) -> list[Row]:
    """Filters on a scenario's held-out seeds."""
    problem = find_scenario(scenario) if isinstance(scenario, str) else scenario
    return leaderboard(problem, filters, runs).rows


def by_scenario(scenarios: Sequence[str], filters: Sequence[Contender]) -> Callable[[], str]:
    """A table with the scenario in the first column."""

    def table() -> str:
        rows = [[f"`{name}`", *cells(row)] for name in scenarios for row in rows_of(name, filters)]
        return markdown_table(["scenario", *HEADER], rows)

    return table


def compared(scenario: str, filters: Sequence[Contender], runs: int = RUNS) -> Callable[[], str]:
    """A table of one scenario."""
    return lambda: markdown_table(HEADER, [cells(row) for row in rows_of(scenario, filters, runs)])


def cells(row: Row) -> list[str]:
    """The paired ratio of scores, NEES, and NIS over what is right."""
    evaluation = row.evaluation
    return [
        row.label,
        about(row.score_ratio, 3),
        about(evaluation.nees),
        f"{evaluation.nis.value / evaluation.expected_nis:.2f}",
    ]


def about(value: Interval, decimals: int = 2) -> str:
    """A value with half of its interval; large ones to three figures."""
    half = (value.high - value.low) / 2
    if abs(value.value) >= 100:
        return f"{digits(value.value)} ± {digits(half, 2)}"
    return f"{value.value:.{decimals}f} ± {half:.{decimals}f}"


FIGURES = {"auv_frame.png": frame, "auv_loop.png": loop}
SCALED = contender("ekf", knows="scaled")._replace(label="ekf, scaled default")
JOINT = [contender("ekf", unknown=unknown) for unknown in (AXIAL_DRAG, DRAG)]  # coefficients as further states
TABLES = {
    **by_name(returns, filters_current),
    "filters_motion": by_scenario(MOTION, FILTERS),
    "filters_navigation": by_scenario(NAVIGATION, (EKF, ROBUST)),
    "filters_members": compared("auv:papers_20hz", [EKF, UKF, *MEMBERS]),
    "filters_cures": compared("auv:papers_20hz", [EKF, *CURES]),  # settings with which 50 members suffice
    "filters_fast": compared("auv:papers", [EKF, *FAST_CURES], FEW),  # at 1 kHz, where the spread collapses
    "filters_drag": compared("auv:wrong_drag", [EKF, SCALED, *JOINT]),
}
