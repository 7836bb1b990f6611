"""The vehicle as a `StateSpaceModel` that a filter assumes, with six to fourteen states.

They act for one step, as the action does, and are not measurements of the model. Their noise drives the model's
states, so that

    Q = Q_plant + B R_a B',   B = df/d(phi, theta) straight ahead,

with the covariance R_a of these two channels, unless Q is given. By the righting moments it affects roll rates
most.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping

import numpy as np

from thruster_env.auv import dynamics
from thruster_env.auv.dynamics import (
    MODELS,
    angle_rates,
    attitude_of,
    cruise_thrust,
    in_earth_axes,
    operating_range,
)
from thruster_env.auv.parameters import VehicleParameters, checked
from thruster_env.auv.plant import (
    ATTITUDE_INPUTS,
    CHANNELS_BY_ATTITUDE,
    CRUISE_SPEED,
    CURRENT_STATES,
    MEASURED,
    QUATERNION,
    ROTATING_CHANNELS,
    ROTATING_STATES,
    STATES,
    SYMBOLS,
    VECTORS,
    Plant,
    channels_of,
    make_plant,
    suite,
)
from thruster_env.core.checks import covariance, one_of, positive
from thruster_env.core.derivatives import euler, euler_jacobian, runge_kutta, runge_kutta_jacobian
from thruster_env.core.equal_functions import makes_functions
from thruster_env.core.matrices import scaled
from thruster_env.core.sources import tuple_of, written_out
from thruster_env.env.copies import functions_of
from thruster_env.model import rotations
from thruster_env.model.continuous import ContinuousModel
from thruster_env.model.quantities import Quantity
from thruster_env.model.state_space import StateSpaceModel

# Roll and pitch, measured by an AHRS, as inputs of the model of six velocities.


TILT = 1e-4  # rad


def split_channels(channels: tuple[str, ...], states: str, attitude: str) -> tuple[list[int], list[int]]:
    """Indices of the channels that are inputs of a model, phi and theta, and of those that it measures.

    Raises ValueError if an attitude that is to be measured is not.
    """
    names = [quantity.symbol for quantity in ATTITUDE_INPUTS]
    if states != "velocities" or attitude != "measured":
        return [], list(range(len(channels)))
    if not set(names) <= set(channels):
        raise ValueError(
            f"sensors of a measured attitude must measure phi and theta, but got {', '.join(channels)}"
        )
    attitude_channels = [channels.index(name) for name in names]
    return attitude_channels, [i for i in range(len(channels)) if i not in attitude_channels]


def derivative_by_attitude(move: Callable, state: np.ndarray, inputs: list[float], plant: Plant) -> np.ndarray:
    """Derivative (n, 2) of a whole step with respect to its last inputs, roll and pitch (central differences)."""

    def propagated(tilt: np.ndarray) -> np.ndarray:
        x, u = state.tolist(), [*inputs[:-2], *tilt.tolist()]
        for _ in range(plant.substeps):
            x = move(x, u, plant.constants)
        return np.array(x)

    return np.transpose([(propagated(tilt) - propagated(-tilt)) / (2.0 * TILT) for tilt in TILT * np.eye(2)])


CURRENT_STD, CURRENT_TIME = 0.2, 60.0  # m/s, s; assumed, of tides and wind about a coast
METHODS = ("runge-kutta", "euler")
ATTITUDES = ("input", "measured", "level")


@makes_functions
def transition_of(states: str, method: str, torque_is_input: bool, attitude: str) -> tuple[Callable, Callable]:
    """One step of a model, and its Jacobian, as functions of the model's own inputs."""
    model = MODELS[states]
    if method == "euler":
        step, jacobian = euler(model.rates, model.count), euler_jacobian(model.tangent, model.count)
    else:
        step = runge_kutta(model.rates, model.count)
        jacobian = runge_kutta_jacobian(model.rates, model.tangent, model.count)
    source = f"move(x, {tuple_of(forces_of(states, torque_is_input, attitude != 'level'))}, c)"
    return (
        written_out("transition", "x, u, c", source, move=step),
        written_out("transition_jacobian", "x, u, c", source, move=jacobian),
    )


def forces_of(states: str, torque_is_input: bool, attitude_is_input: bool) -> list[str]:
    """The inputs of the equations of motion as sources, of the model's own inputs u and constants c."""
    if torque_is_input:
        inputs = ["u[0]", "u[1]", "u[2]", "u[3]"]
    else:
        inputs = ["u[0]", "c.propeller_torque * u[0]", "u[1]", "u[2]"]
    if states == "velocities":
        first = 4 if torque_is_input else 3
        inputs += [f"u[{first}]", f"u[{first + 1}]"] if attitude_is_input else ["0.0", "0.0"]
    return inputs


def no_outputs(x, c):
    """Nothing: the measurements of a vehicle are its states."""
    return ()


@makes_functions
def observation_of(channels: tuple[str, ...], count: int) -> tuple[Callable, Callable]:
    """`observe` and its Jacobian for some measured quantities of the first `count` states."""
    return functions_of(channels_of(channels, count), no_outputs, no_outputs, count)


@makes_functions
def rotating_functions(channels: tuple[str, ...], torque_is_input: bool) -> tuple[Callable, Callable]:
    """One step and `observe` of a model with a quaternion; their Jacobians follow by tracing."""
    source = f"move(x, {tuple_of(forces_of('motion', torque_is_input, False))}, c)"
    reads: dict[str, Callable] = {f"read_{i}": ROTATING_CHANNELS[name].read for i, name in enumerate(channels)}
    return (
        written_out("transition", "x, u, c", source, move=dynamics.rotating_substep),
        written_out("observe", "x, c", tuple_of(f"{name}(x, (), (), c)" for name in reads), **reads),
    )


def rotating_sinking_of(x, c):
    """Rate of depth [m/s] of a state with a quaternion."""
    return rotations.to_world(x[6:10], x[:3])[2]


def speed_of(x, c):
    """Speed [m/s] over ground at components x of the state, floats or arrays."""
    return (x[0] * x[0] + x[1] * x[1] + x[2] * x[2]) ** 0.5


def sinking_of(x, c):
    """Rate of depth [m/s]."""
    return in_earth_axes(attitude_of(x[6], x[7]), 0.0, x[0], x[1], x[2])[2]


def turning_of(x, c):
    """Rate of yaw [rad/s]."""
    return angle_rates(attitude_of(x[6], x[7]), x[3], x[4], x[5])[2]


OUTPUTS = {
    "U": (Quantity("speed", "U", "m/s"), speed_of),
    "z_dot": (Quantity("sinking speed", "z_dot", "m/s"), sinking_of),
    "psi_dot": (Quantity("rate of yaw", "psi_dot", "rad/s"), turning_of),
}
"""What follows from a state; but the speed, from one with roll and pitch."""


def auv_model(
    *,
    states: str | None = None,
    sensors=None,
    integration: str = "runge-kutta",
    attitude: str = "input",
    parameter_factors: Mapping[str, float] | None = None,
    operating_speed: float = CRUISE_SPEED,
    current_std: float = CURRENT_STD,
    current_time: float = CURRENT_TIME,
    process_noise_cov=None,
    measurement_noise_cov=None,
    prior_cov_factor: float = 1.0,
    **plant_arguments,
) -> StateSpaceModel:
    """The model of a vehicle that a filter assumes, from plain arguments that JSON can hold.

        x_{k+1} = F(x_k, u_k) + w,  w ~ N(0, Q);   z_k = h(x_k) + v,  v ~ N(0, R)

    F integrates the equations of `thruster_env.auv.dynamics` over one sample time. Covariances are per step and do
    not scale with dt: another dt needs another Q.

    Args:
        states: "velocities" for (u, v, w, p, q, r), "motion" for these with (phi, theta), "navigation" for those
            with (psi, x, y, z), "current" for those with the current (c_x, c_y) to the north and east; None for
            "motion", or "navigation" if a sensor asks for it.
        sensors: as `thruster_env.auv.plant.make_plant` takes them; None for those of the suite "default" that the
            states predict.
        integration: "runge-kutta", or "euler" as in the papers.
        attitude: of "velocities": "input" for phi and theta as two further inputs, "measured" for these as the
            sensors measure them, see `thruster_env.auv.model`, "level" for zeros. "quaternion", of "motion" and
            "navigation", is the plant's, too: a `Rotation` for roll, pitch and yaw, whose errors P and Q have.
        parameter_factors: factors on fields of `VehicleParameters`, by which the assumed vehicle differs.
        operating_speed: speed straight ahead about which a Kalman filter linearises the model [m/s].
        current_std: of "current" alone: standard deviation of each component of the current at the start [m/s].
        current_time: of "current" alone: time constant of the current [s]. It is a random walk whose variance
            grows by 2 current_std^2 t/current_time in a time t, as that of a Gauss-Markov process does at first.
        process_noise_cov: Q of the model's n states, (n, n) or n variances; the plant's if None.
        measurement_noise_cov: R, (m, m) or m variances; the plant's if None.
        prior_cov_factor: P_0, the covariance of the filter's prior, divided by that of the plant's initial state.
        **plant_arguments: others of `thruster_env.auv.plant.make_plant`.

    Raises:
        ValueError: if an argument is wrong; the message states the rule and the value.
    """
    if sensors is None:
        states = "motion" if states is None else one_of("states", states, tuple(MODELS))
        known = SYMBOLS[: max(MODELS[states].count, 8 if attitude == "measured" else 0)]
        if attitude == QUATERNION and states == "motion":
            known = SYMBOLS[:9]
        sensors = [channel for channel in suite("default") if MEASURED[channel] in known]
    if attitude == QUATERNION:
        attitude, plant_arguments = "input", {**plant_arguments, "attitude": QUATERNION}
    return model_of_plant(
        make_plant(sensors=sensors, **plant_arguments),
        states=states,
        integration=integration,
        attitude=attitude,
        parameter_factors=parameter_factors,
        operating_speed=operating_speed,
        current_std=current_std,
        current_time=current_time,
        process_noise_cov=process_noise_cov,
        measurement_noise_cov=measurement_noise_cov,
        prior_cov_factor=prior_cov_factor,
    )


def model_of_plant(
    plant: Plant,
    *,
    states: str | None = None,
    integration: str = "runge-kutta",
    attitude: str = "input",
    parameter_factors: Mapping[str, float] | None = None,
    operating_speed: float = CRUISE_SPEED,
    current_std: float = CURRENT_STD,
    current_time: float = CURRENT_TIME,
    process_noise_cov=None,
    measurement_noise_cov=None,
    prior_cov_factor: float = 1.0,
) -> StateSpaceModel:
    """The model of a plant, exact unless changed; see `auv_model` for the arguments."""
    states = _smallest(plant.channels) if states is None else one_of("states", states, tuple(MODELS))
    rotates = plant.attitude == QUATERNION
    if rotates:
        states = one_of("states of an attitude 'quaternion'", states, ("motion", "navigation"))
        one_of("integration of an attitude 'quaternion'", integration, METHODS[:1])
    elif attitude == QUATERNION:
        raise ValueError(
            "attitude must be the plant's, make_plant(attitude='quaternion'), but the plant's is 'euler'"
        )
    method = one_of("integration", integration, METHODS)
    attitude = one_of("attitude", attitude, ATTITUDES)
    n, torque_is_input = MODELS[states].count, plant.propeller_torque is None
    as_inputs, observed = split_channels(plant.channels, states, attitude)
    channels = tuple(plant.channels[i] for i in observed)
    if parameter_factors is not None:
        changed = scaled(plant.parameters, parameter_factors, VehicleParameters._fields)
        plant = plant._replace(parameters=checked(changed))
    if rotates:
        n = 9 if states == "motion" else 12  # errors
        move, observe = rotating_functions(channels, torque_is_input)
        move_jacobian = observe_jacobian = None
    else:
        move, move_jacobian = transition_of(states, method, torque_is_input, attitude)
        observe, observe_jacobian = observation_of(channels, n)
    inputs = plant.inputs + (ATTITUDE_INPUTS if states == "velocities" and attitude != "level" else ())
    speed = positive("operating_speed", operating_speed)
    thrust = cruise_thrust(plant.parameters, speed)
    torque = plant.propeller_torque or 0.0
    at_cruise = {"X_prop": thrust, "K_prop": torque * thrust}
    std, wandering = positive("current_std", current_std), positive("current_time", current_time)
    high = state_range(plant, n, std)
    prior_factor = positive("prior_cov_factor", prior_cov_factor)
    cruise, operating_input = speed * np.eye(n)[0], [at_cruise.get(quantity.symbol, 0.0) for quantity in inputs]
    q = _block(plant.process_noise_cov, n, 2.0 * std**2 * plant.dt / wandering)
    r = plant.measurement_noise_cov[np.ix_(observed, observed)]
    if as_inputs:
        slopes = derivative_by_attitude(move, cruise, operating_input, plant)
        q = q + slopes @ plant.measurement_noise_cov[np.ix_(as_inputs, as_inputs)] @ slopes.T
    if process_noise_cov is not None:
        q = covariance("process_noise_cov", process_noise_cov, n)
    if measurement_noise_cov is not None:
        r = covariance("measurement_noise_cov", measurement_noise_cov, len(observed))
    if rotates:
        all_states = ROTATING_STATES[: n - 2]
        outputs = {"U": OUTPUTS["U"], "z_dot": (OUTPUTS["z_dot"][0], rotating_sinking_of)}
        prior_mean = plant.initial_mean[: n + 1]
        cruise, low = (np.insert(part, 6, start) for part, start in ((cruise, 1.0), (-high, -1.0)))
        cruise[7:10], low[7:10], high = 0.0, -1.0, np.insert(high, 6, 1.0)
        high[7:10] = 1.0
    else:
        all_states, prior_mean, low = (
            (*STATES, *CURRENT_STATES)[:n],
            np.append(plant.initial_mean, np.zeros(2))[:n],
            -high,
        )
        outputs = {symbol: output for symbol, output in OUTPUTS.items() if n > 6 or symbol == "U"}
    low[0] = 0.0
    return StateSpaceModel(
        transition=move,
        observe=observe,
        transition_jacobian=move_jacobian,
        observe_jacobian=observe_jacobian,
        process_noise_cov=q,
        measurement_noise_cov=r,
        prior_mean=prior_mean,
        prior_cov=prior_factor * _block(plant.initial_cov, n, std**2),
        inputs=len(inputs),
        constants=plant.constants,
        substeps=plant.substeps,
        operating_state=cruise,
        operating_input=operating_input,
        state_low=low,
        state_high=high,
        states=all_states,
        input_quantities=inputs,
        measurements=[CHANNELS_BY_ATTITUDE[plant.attitude][name].quantity for name in channels],
        outputs=outputs,
    )


def state_range(plant: Plant, n: int, current_std: float = CURRENT_STD) -> np.ndarray:
    """Largest state (n,) of normal operation of n states; a current's is three standard deviations."""
    vehicle_range = operating_range(plant.parameters, plant.max_thrust)
    return np.append(vehicle_range, [3.0 * current_std] * len(CURRENT_STATES))[:n]


MODEL_ARGUMENTS = tuple(inspect.signature(model_of_plant).parameters)[1:]


def _smallest(channels: tuple[str, ...]) -> str:
    """The smaller of the two closed models that predicts all channels."""
    within = (*SYMBOLS[: MODELS["motion"].count], *VECTORS)
    return "motion" if all(MEASURED.get(channel, channel) in within for channel in channels) else "navigation"


def _block(cov: np.ndarray, n: int, of_current: float) -> np.ndarray:
    """The covariance of the first n states, those of the vehicle and then those of the current."""
    extended = np.diag(np.append(np.zeros(len(cov)), [of_current] * len(CURRENT_STATES)))
    extended[: len(cov), : len(cov)] = cov
    return extended[:n, :n]


# The vehicle in continuous time: its rates and spectral densities, from which follows a model for any dt.


@makes_functions
def rates_of(states: str, torque_is_input: bool, attitude_is_input: bool) -> Callable:
    """The rates of a model, as a function of its own inputs."""
    inputs = tuple_of(forces_of(states, torque_is_input, attitude_is_input))
    return written_out("rates", "x, u, c", f"move(x, {inputs}, c)", move=MODELS[states].rates)


def continuous_auv(**arguments) -> ContinuousModel:
    """The vehicle in continuous time, from plain arguments that JSON can hold.

    The spectral densities of its noise are those whose Q of a step `dt` is `process_noise_cov`: `at(dt)` is
    `thruster_env.auv.model.auv_model(**arguments)`, and `at` of another sample time is its model, with Q by
    `thruster_env.model.continuous.noise_for_dt`.

    Args:
        **arguments: those of `auv_model`; `integration` must be "runge-kutta".

    Raises:
        ValueError: if an argument is wrong, and for a Q that no white noise has.
    """
    model = auv_model(**arguments)
    if model.turns:
        inputs = tuple_of(forces_of("motion", "K_prop" in [part.symbol for part in model.input_quantities], False))
        rates = written_out("rates", "x, u, c", f"move(x, {inputs}, c)", move=dynamics.rotating_rates)
        return ContinuousModel.of(model, rates)
    states = next(name for name, steps in MODELS.items() if steps.count == model.n)
    symbols = [quantity.symbol for quantity in model.input_quantities]
    return ContinuousModel.of(model, rates_of(states, "K_prop" in symbols, "phi" in symbols))
