"""The thruster in continuous time: its rates and spectral densities, from which follows a model for any dt."""

from __future__ import annotations

from thruster_env.core.compiled import inlined
from thruster_env.model.continuous import ContinuousModel
from thruster_env.thruster.dynamics import rates
from thruster_env.thruster.effects.amplifier import outside
from thruster_env.thruster.logged import logged_model


@inlined
def voltage_rates(x, u, c):
    """Time derivatives [rad/s^2, m/s^2] under voltage u = (V_s,), in the ambient flow of the constants."""
    return rates(x, (u[0], c.ambient_velocity), c)


@inlined
def driven_rates(x, u, c):
    """The same behind a dead band."""
    return rates(x, (outside(u[0], c.dead_band_low, c.dead_band_high), c.ambient_velocity), c)


def continuous_thruster(**arguments) -> ContinuousModel:
    """The thruster in continuous time, from plain arguments that JSON can hold.

        d(omega_m, U_a)/dt = rates + w(t),   z = h(x) + v

    The spectral densities of w are those whose Q of a step `dt` is `process_noise_cov`: `at(dt)` is
    `thruster_env.thruster.logged.logged_model(**arguments)`, and `at` of another sample time is its model, with Q
    by `thruster_env.model.diffusion.noise_for_dt`.

    Args:
        **arguments: those of `logged_model` and so of `thruster_model`, but for `lag`: the memory of a lagging
            sensor is one of a sample time.

    Raises:
        ValueError: if an argument is wrong, and for a Q that no white noise has.
    """
    model = logged_model(**arguments)
    if model.n > 2:
        raise ValueError("a thruster in continuous time must have no lag, but got sensors with one")
    has_band = hasattr(model.constants, "dead_band_low")
    return ContinuousModel.of(model, driven_rates if has_band else voltage_rates)
