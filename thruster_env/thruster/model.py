"""The thruster as a `StateSpaceModel`: the model that a filter assumes."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from thruster_env.core.checks import covariance, finite, positive
from thruster_env.core.compiled import inlined
from thruster_env.core.equal_functions import makes_functions
from thruster_env.core.matrices import scaled, zero_order_hold
from thruster_env.env.copies import functions_of
from thruster_env.model.affine import affine_model
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.thruster.channels import CHANNELS
from thruster_env.thruster.dynamics import (
    Constants,
    substep,
    substep_jacobian,
    thrust_and_torque,
    thrust_and_torque_tangent,
)
from thruster_env.thruster.linear.analysis import LinearModel, steady_state
from thruster_env.thruster.parameters import INPUTS, STATES, THRUST, ThrusterParameters, checked
from thruster_env.thruster.plant import Plant, make_plant
from thruster_env.thruster.rendering import Overlay


@inlined
def transition(x, u, c):
    """One Runge-Kutta step of the thruster under voltage u = (V_s,)."""
    return substep(x, (u[0], c.ambient_velocity), c)


@inlined
def transition_jacobian(x, u, c):
    """Jacobian of `transition` by rows."""
    return substep_jacobian(x, (u[0], c.ambient_velocity), c)


@inlined
def observe(x, c):
    """The quantity that is measured by default: thrust [N]."""
    return (thrust_and_torque(x, c)[0],)


@inlined
def observe_jacobian(x, c):
    """Jacobian of `observe` by rows."""
    by_speed, _ = thrust_and_torque_tangent(x, (1.0, 0.0), c)
    by_flow, _ = thrust_and_torque_tangent(x, (0.0, 1.0), c)
    return ((by_speed, by_flow),)


@makes_functions
def channel_functions(names: tuple[str, ...]) -> tuple[Callable, Callable]:
    """`observe` and its Jacobian for some measured quantities."""
    if names == ("thrust",):
        return observe, observe_jacobian
    _check_channels("that a model of the state can predict", names, lambda channel: channel.slopes is not None)
    return functions_of([CHANNELS[name] for name in names], observe, observe_jacobian, len(STATES))


def _check_channels(which: str, names: tuple[str, ...], fit: Callable) -> None:
    """Raise ValueError unless all channels of these names fit."""
    known = [name for name, channel in CHANNELS.items() if fit(channel)]
    unknown = sorted(set(names) - set(known))
    if unknown:
        raise ValueError(f"channels {which} must be {', '.join(known)}, but got {unknown}")


def thruster_model(
    *,
    parameter_factors: Mapping[str, float] | None = None,
    operating_voltage: float | None = None,
    prior_cov_factor: float = 1.0,
    **plant_arguments,
) -> StateSpaceModel:
    """The model of a thruster that a filter assumes, from plain arguments that JSON can hold.

        x_{k+1} = F(x_k, V_s) + w,  w ~ N(0, Q);   z_k = h(x_k) + v,  v ~ N(0, R);   x = (omega_m, U_a)

    F integrates the equations of `thruster_env.thruster.dynamics` over one sample time. Covariances are per step
    and do not scale with dt: another dt needs another Q.

    Args:
        parameter_factors: factors on fields of `ThrusterParameters`, by which the assumed thruster differs.
        operating_voltage: voltage about which a Kalman filter linearises the model [V]; half of max_voltage if
            None.
        prior_cov_factor: P_0, the covariance of the filter's prior, divided by that of the plant's initial state.
        **plant_arguments: those of `thruster_env.thruster.plant.make_plant`; the noise covariances are the
            filter's.

    Raises:
        ValueError: if an argument is wrong; the message states the rule and the value.
    """
    return model_of_plant(
        make_plant(**plant_arguments),
        parameter_factors=parameter_factors,
        operating_voltage=operating_voltage,
        prior_cov_factor=prior_cov_factor,
    )


def model_of_plant(
    plant: Plant,
    *,
    parameter_factors: Mapping[str, float] | None = None,
    operating_voltage: float | None = None,
    process_noise_cov=None,
    measurement_noise_cov=None,
    prior_cov_factor: float = 1.0,
) -> StateSpaceModel:
    """The model of a plant, exact unless changed; see `thruster_model` for the arguments."""
    if plant.linear is not None and parameter_factors:
        raise ValueError(f"parameter_factors must be none for a linear plant, but got {parameter_factors}")
    if parameter_factors is not None:
        names = [name for name in ThrusterParameters._fields if name != "angles"]
        plant = plant._replace(parameters=checked(scaled(plant.parameters, parameter_factors, names)))
    if process_noise_cov is not None:
        plant = plant._replace(process_noise_cov=covariance("process_noise_cov", process_noise_cov, 2))
    if measurement_noise_cov is not None:
        r = covariance("measurement_noise_cov", measurement_noise_cov, len(plant.channels))
        plant = plant._replace(measurement_noise_cov=r)
    plant = plant._replace(initial_cov=positive("prior_cov_factor", prior_cov_factor) * plant.initial_cov)
    if operating_voltage is None:
        operating_voltage = plant.max_voltage / 2
    operating_voltage = finite("operating_voltage", operating_voltage)
    if plant.linear is not None:
        return _linear_model(plant, plant.linear)
    of_channels, of_channels_jacobian = channel_functions(plant.channels)
    model = StateSpaceModel(
        transition=transition,
        observe=of_channels,
        transition_jacobian=transition_jacobian,
        observe_jacobian=of_channels_jacobian,
        process_noise_cov=plant.process_noise_cov,
        measurement_noise_cov=plant.measurement_noise_cov,
        prior_mean=plant.initial_mean,
        prior_cov=plant.initial_cov,
        constants=plant.constants,
        substeps=plant.substeps,
        operating_state=steady_state(plant.parameters, operating_voltage, plant.ambient_velocity)[:2],
        operating_input=[operating_voltage],
        operating_points=partial(_operating_points, plant),
        outputs={"T": (THRUST, thrust_of)},
        **_quantities(plant),
        **_operating_range(plant),
    )
    if plant.dead_band == (0.0, 0.0):
        return model
    from thruster_env.thruster.logged import Recorder, with_recorder

    return with_recorder(model, plant, Recorder(*plant.dead_band))


def thrust_of(x, c):
    """Thrust [N] at components x of the state, floats or arrays."""
    return thrust_and_torque(x, c)[0]


MODEL_ARGUMENTS = tuple(inspect.signature(model_of_plant).parameters)[1:]


def overlay_of(label: str, model: StateSpaceModel, mean: np.ndarray, cov: np.ndarray) -> Overlay:
    """Overlay of a belief on a rendered thruster: the state and its thrust, each with a standard deviation."""
    # A model may have more states, such as parameters, behind these two.
    (omega, flow), (omega_std, flow_std) = mean[:2].tolist(), np.sqrt(np.diag(cov))[:2].tolist()
    if not isinstance(model.constants, Constants):  # a linear plant's model
        return Overlay(label, None, None, omega, omega_std, flow, flow_std)
    thrust, _ = thrust_and_torque((omega, flow), model.constants)
    slopes = np.array(observe_jacobian((omega, flow), model.constants)[0])
    thrust_std = float(slopes @ cov @ slopes) ** 0.5
    return Overlay(label, thrust, thrust_std, omega, omega_std, flow, flow_std)


def _linear_model(plant: Plant, linear: LinearModel) -> StateSpaceModel:
    """The exact model of a plant that moves by a published linear system."""
    a, b = zero_order_hold(linear.a, linear.b, plant.dt)
    _check_channels(
        "of a linear model", plant.channels, lambda channel: channel.slopes is not None and channel.affine
    )
    rest, slopes = np.zeros(2), [CHANNELS[name].slopes for name in plant.channels]
    return affine_model(
        a=a,
        b=b[:, :1],
        c=[slope(rest, linear.c, None) for slope in slopes if slope is not None],
        state_offset=b[:, 1] * plant.ambient_velocity,
        process_noise_cov=plant.process_noise_cov,
        measurement_noise_cov=plant.measurement_noise_cov,
        prior_mean=plant.initial_mean,
        prior_cov=plant.initial_cov,
        **_quantities(plant),
    )


def _quantities(plant: Plant) -> dict:
    measured = [CHANNELS[name].quantity for name in plant.channels]
    return {"states": STATES, "input_quantities": INPUTS, "measurements": measured}


def _operating_points(plant: Plant, count: int) -> list[tuple[tuple[float, float], tuple[float]]]:
    """Steady states and their voltages, evenly from -max_voltage to max_voltage."""
    voltages = np.linspace(-plant.max_voltage, plant.max_voltage, count).tolist()
    return [(steady_state(plant.parameters, v, plant.ambient_velocity)[:2], (v,)) for v in voltages]


def _operating_range(plant: Plant) -> dict[str, Any]:
    """Smallest and largest state that the voltages settle to, ambient flow added."""
    ends = [steady_state(plant.parameters, sign * plant.max_voltage)[:2] for sign in (1.0, -1.0)]
    flow = np.array([0.0, plant.ambient_velocity])
    return {
        "state_low": np.min(ends, axis=0) + np.minimum(flow, 0.0),
        "state_high": np.max(ends, axis=0) + np.maximum(flow, 0.0),
    }
