"""The vehicle in continuous time: its rates and spectral densities, from which follows a model for any dt."""

from __future__ import annotations

from collections.abc import Callable

from thruster_env.auv import dynamics
from thruster_env.auv.model import MODELS, auv_model, forces_of
from thruster_env.core.pickling import makes_functions
from thruster_env.core.sources import tuple_of, written_out
from thruster_env.model.continuous import ContinuousModel

RATES = {
    "velocities": dynamics.velocity_rates,
    "motion": dynamics.motion_rates,
    "navigation": dynamics.navigation_rates,
    "current": dynamics.drifting_rates,
}
"""By the states of `thruster_env.auv.model.MODELS`."""


@makes_functions
def rates_of(states: str, torque_is_input: bool, attitude_is_input: bool) -> Callable:
    """The rates of a model, as a function of its own inputs."""
    inputs = tuple_of(forces_of(states, torque_is_input, attitude_is_input))
    return written_out("rates", "x, u, c", f"move(x, {inputs}, c)", move=RATES[states])


def continuous_auv(**arguments) -> ContinuousModel:
    """The vehicle in continuous time, from plain arguments that JSON can hold.

    The spectral densities of its noise are those whose Q of a step `dt` is `process_noise_cov`: `at(dt)` is
    `thruster_env.auv.model.auv_model(**arguments)`, and `at` of another sample time is its model, with Q by
    `thruster_env.model.diffusion.noise_for_dt`.

    Args:
        **arguments: those of `auv_model`; `integration` must be "runge-kutta".

    Raises:
        ValueError: if an argument is wrong, and for a Q that no white noise has.
    """
    model = auv_model(**arguments)
    states = next(name for name, steps in MODELS.items() if steps.count == model.n)
    symbols = [one.symbol for one in model.input_quantities]
    return ContinuousModel.of(model, rates_of(states, "K_prop" in symbols, "phi" in symbols))
