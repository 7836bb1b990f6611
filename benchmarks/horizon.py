"""A step of moving-horizon estimation through Gymnasium, beside do-mpc's of the same model and window."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Iterator
from importlib.util import find_spec

import gymnasium as gym
import numpy as np

from benchmarks.steps import PEER_STEPS, episode, recorded_episode
from benchmarks.timing import Row, alone, seconds_a_call, side_by_side
from filters.wrappers.single import EstimateState
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.thruster.model import thruster_model

HORIZON = 10
GOAL = 1 / 10


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """The step, beside do-mpc's where that is installed."""
    wrapped = EstimateState(gym.make("BowThruster-v0"), filter="mhe", horizon=HORIZON, loss="quadratic")
    ours, what = episode(wrapped, seed), f"MHE step, L = {HORIZON}"
    if find_spec("do_mpc") is None:
        yield Row(what, None, alone(ours, 4 if quick else 40))
        return
    step, reset = do_mpc_step(thruster_model())
    voltages, measurements = recorded_episode(seed)
    recorded = list(zip(voltages[:PEER_STEPS].tolist(), measurements[:PEER_STEPS, 0].tolist(), strict=True))
    peer = seconds_a_call(step, recorded, reset)
    yield Row(what, "do-mpc", side_by_side(ours, peer, 2 if quick else 10), ratio_goal=GOAL)


def do_mpc_step(model: StateSpaceModel) -> tuple[Callable[[float, float], np.ndarray], Callable[[], None]]:
    """Functions step(u, z) and reset() of do-mpc's estimator of a model with one input and one channel."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of parts of do-mpc that are not installed
        import do_mpc
    import casadi

    logging.getLogger("do_mpc").setLevel(logging.ERROR)
    plant = do_mpc.model.Model("discrete", "SX")
    x, u = plant.set_variable("_x", "x", (model.n, 1)), plant.set_variable("_u", "u")
    propagated = tuple(casadi.vertsplit(x))
    for _ in range(model.substeps):
        propagated = model.transition(propagated, (u,), model.constants)
    plant.set_meas(
        "z", casadi.vertcat(*model.observe(tuple(casadi.vertsplit(x)), model.constants)), meas_noise=True
    )
    plant.set_meas("given", u, meas_noise=False)
    plant.set_rhs("x", casadi.vertcat(*propagated), process_noise=True)
    plant.setup()
    estimator = do_mpc.estimator.MHE(plant, [])
    estimator.settings.n_horizon, estimator.settings.t_step = HORIZON, 1.0
    estimator.settings.meas_from_data = True
    estimator.settings.supress_ipopt_output()
    weights = (
        np.linalg.inv(cov) for cov in (model.prior_cov, model.measurement_noise_cov, model.process_noise_cov)
    )
    prior, noise, disturbance = weights
    estimator.set_default_objective(P_x=prior, P_v=noise, P_w=disturbance)
    estimator.setup()

    def reset() -> None:
        estimator.reset_history()
        estimator.x0 = model.prior_mean
        estimator.set_initial_guess()

    def step(voltage: float, z: float) -> np.ndarray:
        return estimator.make_step(np.array([[z], [voltage]]))

    return step, reset
