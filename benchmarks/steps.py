"""Single steps as a user takes them through Gymnasium: the env alone, and with a filter around it."""

from __future__ import annotations

from collections.abc import Iterator

import gymnasium as gym
import numpy as np

import thruster_env  # noqa: F401 - registers BowThruster-v0
from benchmarks.peers import EnsembleStep, KalmanStep, UnscentedStep, compiled_model, python_model
from benchmarks.rates import arithmetic_limit, step_of_env, step_of_filtered
from benchmarks.timing import Measure, Row, seconds_a_call, side_by_side
from filters.wrappers.single import EstimateState
from thruster_env.core.streams import ACTION_SPACE, derived_seed
from thruster_env.thruster.plant import Plant

ENSEMBLE_SIZE = 50
PEER_STEPS = 100  # of FilterPy's slow filters in a round; their time a step does not depend on their number


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """Measure, one row after the other."""
    voltages, measurements = recorded_episode(seed)
    plant = gym.make("BowThruster-v0").unwrapped.plant
    kalman = EstimateState(gym.make("BowThruster-v0"), filter="kf")

    ours, peer = episode(gym.make("BowThruster-v0"), seed), episode(gym.make("Pendulum-v1"), seed)
    timing = side_by_side(ours, peer, 20 if quick else 600)
    limit = arithmetic_limit(step_of_env(gym.make("BowThruster-v0")))
    yield Row("env step", "Pendulum-v1", timing, ratio_goal=0.29, limit=limit)

    for model, peer_name, goal in (
        (python_model, "FilterPy", 1 / 40),
        (compiled_model, "FilterPy with numba", None),
    ):
        wrapped = EstimateState(gym.make("BowThruster-v0"), filter="enkf", ensemble_size=ENSEMBLE_SIZE)
        peer = peer_ensemble(plant, model, voltages, measurements, seed)
        timing = side_by_side(episode(wrapped, seed), peer, 4 if quick else 60)
        limit = arithmetic_limit(step_of_filtered(wrapped))
        yield Row(f"EnKF step, N = {ENSEMBLE_SIZE}", peer_name, timing, ratio_goal=goal, limit=limit)

    for name in ("kf", "ekf"):
        wrapped = EstimateState(gym.make("BowThruster-v0"), filter=name)
        step = KalmanStep(kalman.filter.kernel_model)
        inputs = np.column_stack([voltages, np.ones_like(voltages)])
        peer = seconds_a_call(step, zip(inputs, measurements, strict=True), step.reset)
        timing = side_by_side(episode(wrapped, seed), peer, 10 if quick else 200)
        limit = arithmetic_limit(step_of_filtered(wrapped))
        yield Row(f"{name.upper()} step", "FilterPy's KF", timing, ratio_goal=0.31, limit=limit)

    wrapped = EstimateState(gym.make("BowThruster-v0"), filter="ukf")
    points = wrapped.filter.alpha, wrapped.filter.beta, wrapped.filter.kappa
    step = UnscentedStep(plant, points, python_model)
    recorded = zip(voltages[:PEER_STEPS].tolist(), measurements[:PEER_STEPS], strict=True)
    peer = seconds_a_call(step, recorded, step.reset)
    timing = side_by_side(episode(wrapped, seed), peer, 10 if quick else 100)
    limit = arithmetic_limit(step_of_filtered(wrapped))
    yield Row("UKF step", "FilterPy's UKF", timing, ratio_goal=1 / 10, limit=limit)


def recorded_episode(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Voltages (K,) and measurements (K, 1) of an episode, for filters that run beside no env."""
    env = gym.make("BowThruster-v0")
    env.reset(seed=seed)
    actions = _actions(env, seed)
    measurements = [env.step(action)[-1]["measurement"] for action in actions]
    return np.array(actions, dtype=np.float64)[:, 0], np.array(measurements)


def episode(env: gym.Env, seed: int) -> Measure:
    """A measure of one step: a whole episode under random actions; the reset is not timed."""
    env.reset(seed=seed)
    return seconds_a_call(env.step, [(action,) for action in _actions(env, seed)], env.reset)


def _actions(env: gym.Env, seed: int) -> list[np.ndarray]:
    env.action_space.seed(derived_seed(seed, ACTION_SPACE))
    return [env.action_space.sample() for _ in range(env.spec.max_episode_steps)]


def peer_ensemble(plant: Plant, model, voltages, measurements, seed: int) -> Measure:
    """A measure of one predict and update of FilterPy's ensemble Kalman filter."""
    np.random.seed(seed)  # FilterPy draws from the global generator
    step = EnsembleStep(plant, ENSEMBLE_SIZE, model)
    recorded = zip(voltages[:PEER_STEPS].tolist(), measurements[:PEER_STEPS], strict=True)
    return seconds_a_call(step, recorded, step.reset)
