"""The bridge: the thruster as a `StateSpaceModel`. No other file of this package knows the thruster."""

from __future__ import annotations

from collections.abc import Mapping

from filters.model import StateSpaceModel
from thruster_env.checks import covariance, finite, positive
from thruster_env.compiled import inlined
from thruster_env.dynamics import substep, substep_jacobian, thrust_and_torque, thrust_and_torque_tangent
from thruster_env.linear import steady_state
from thruster_env.parameters import ThrusterParameters, checked
from thruster_env.plant import Plant, make_plant


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
    """The measured quantity: thrust [N]."""
    return (thrust_and_torque(x, c)[0],)


@inlined
def observe_jacobian(x, c):
    """Jacobian of `observe` by rows."""
    by_speed, _ = thrust_and_torque_tangent(x, (1.0, 0.0), c)
    by_flow, _ = thrust_and_torque_tangent(x, (0.0, 1.0), c)
    return ((by_speed, by_flow),)


MODEL_ARGUMENTS = ("process_noise_cov", "measurement_noise_cov", "parameter_factors", "operating_voltage")


def thruster_model(
    *,
    parameter_factors: Mapping[str, float] | None = None,
    operating_voltage: float | None = None,
    **plant_arguments,
) -> StateSpaceModel:
    """What a filter assumes of a thruster, from plain arguments that JSON can hold.

    Args:
        parameter_factors: factors on fields of `ThrusterParameters`, by which the assumed thruster differs.
        operating_voltage: where a Kalman filter approximates the model [V]; half of max_voltage if None.
        **plant_arguments: those of `thruster_env.plant.make_plant`; the noise covariances are the filter's.

    Raises:
        ValueError: states the rule and the value.
    """
    return model_of_plant(
        make_plant(**plant_arguments),
        parameter_factors=parameter_factors,
        operating_voltage=operating_voltage,
    )


def model_of_plant(
    plant: Plant,
    *,
    parameter_factors: Mapping[str, float] | None = None,
    operating_voltage: float | None = None,
    process_noise_cov=None,
    measurement_noise_cov=None,
) -> StateSpaceModel:
    """The model of a plant, exact unless told otherwise; see `thruster_model` for the arguments."""
    plant = plant._replace(parameters=_scaled(plant.parameters, parameter_factors or {}))
    if process_noise_cov is not None:
        plant = plant._replace(process_noise_cov=covariance("process_noise_cov", process_noise_cov, 2))
    if measurement_noise_cov is not None:
        r = covariance("measurement_noise_cov", measurement_noise_cov, 1)
        plant = plant._replace(measurement_noise_cov=r)
    if operating_voltage is None:
        operating_voltage = plant.max_voltage / 2
    operating_voltage = finite("operating_voltage", operating_voltage)
    return StateSpaceModel(
        transition=transition,
        observe=observe,
        transition_jacobian=transition_jacobian,
        observe_jacobian=observe_jacobian,
        process_noise_cov=plant.process_noise_cov,
        measurement_noise_cov=plant.measurement_noise_cov,
        prior_mean=plant.initial_mean,
        prior_cov=plant.initial_cov,
        constants=plant.constants,
        substeps=plant.substeps,
        operating_state=steady_state(plant.parameters, operating_voltage, plant.ambient_velocity)[:2],
        operating_input=[operating_voltage],
    )


def model_of_env(env, **changes) -> StateSpaceModel:
    """The model of a `BowThruster` env; changes are those of `model_of_plant`.

    Raises:
        ValueError: if the env has no plant that this package knows.
    """
    plant = getattr(env.unwrapped, "plant", None)
    if not isinstance(plant, Plant):
        raise ValueError(f"an env other than a bow thruster must come with a model, but got {env}")
    unknown = sorted(set(changes) - set(MODEL_ARGUMENTS))
    if unknown:
        known = ", ".join(MODEL_ARGUMENTS)
        raise ValueError(f"arguments must be numbers of the filter or {known}, but got {unknown}")
    return model_of_plant(plant, **changes)


def _scaled(parameters: ThrusterParameters, factors: Mapping[str, float]) -> ThrusterParameters:
    names = [name for name in ThrusterParameters._fields if name != "angles"]
    unknown = sorted(set(factors) - set(names))
    if unknown:
        raise ValueError(f"parameter_factors must name fields of {', '.join(names)}, but got {unknown}")
    scaled = {name: getattr(parameters, name) * positive(name, factor) for name, factor in factors.items()}
    return checked(parameters._replace(**scaled))
