"""The thruster as a `StateSpaceModel`: the model that a filter assumes.

The thruster of recorded logs: with a dead band, and with sensors that have a bias and a lag.

    V = V_s behind the dead band (low, high),  low <= 0 <= high
    z_i = h_i(x) + bias_i + v_i,  or, for a sensor with lag tau,  z_i = y + bias_i + v_i with y' = (h_i(x) - y)/tau

A lagging reading is y = (1 - w) r + w h(x), with the state x as process noise left it. The sensor's memory, r, is
a state; as tau goes to 0 so does 1 - w, and the model tends to that without a lag.

A thrust that differs ahead and astern is the parameter `thrust_asymmetry`. Without all of these the model is that
of `thruster_env.thruster.model`.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from thruster_env.core.checks import covariance, finite, positive, short_repr
from thruster_env.core.equal_functions import makes_functions
from thruster_env.core.matrices import scaled, zero_order_hold
from thruster_env.core.sources import matrix_of, tuple_of, written_out
from thruster_env.env.copies import functions_of
from thruster_env.model.affine import affine_model
from thruster_env.model.continuous import ContinuousModel, noise_for_dt, same_dt
from thruster_env.model.quantities import Quantity
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.thruster.analysis import LinearModel, steady_state
from thruster_env.thruster.dynamics import (
    Constants,
    rates,
    substep,
    substep_jacobian,
    thrust_and_torque,
    thrust_and_torque_tangent,
)
from thruster_env.thruster.effects import outside
from thruster_env.thruster.parameters import (
    BY_CHANNEL,
    CHANNELS,
    INPUTS,
    MAX_CHANNELS,
    STATES,
    THRUST,
    ThrusterParameters,
    checked,
    checked_band,
    is_file,
    read_preset,
)
from thruster_env.thruster.plant import Plant, make_plant


def transition(x, u, c):
    """One Runge-Kutta step of the thruster under voltage u = (V_s,)."""
    return substep(x, (u[0], c.ambient_velocity), c)


def transition_jacobian(x, u, c):
    """Jacobian of `transition` by rows."""
    return substep_jacobian(x, (u[0], c.ambient_velocity), c)


def observe(x, c):
    """The quantity that is measured by default: thrust [N]."""
    return (thrust_and_torque(x, c)[0],)


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

    return with_recorder(model, plant, Recorder(*plant.dead_band))


def thrust_of(x, c):
    """Thrust [N] at components x of the state, floats or arrays."""
    return thrust_and_torque(x, c)[0]


MODEL_ARGUMENTS = tuple(inspect.signature(model_of_plant).parameters)[1:]


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


_FURTHER = (
    "dead_band_low",  # [V], not positive
    "dead_band_high",  # [V], not negative
    *(f"bias_{index}" for index in range(MAX_CHANNELS)),  # by the channel's place, in its unit
    *(f"kept_{index}" for index in range(MAX_CHANNELS)),  # a: the reading's share in what a lagging sensor holds,
    *(f"after_{index}" for index in range(MAX_CHANNELS)),  # w: the share of the present value in the reading
)
_named_tuple: Any = NamedTuple  # type checkers know fields only where they are written out
LoggedConstants = _named_tuple("LoggedConstants", [(name, float) for name in (*Constants._fields, *_FURTHER)])
"""`dynamics.Constants`, and what logs show beside."""
LaggingConstants = _named_tuple(
    "LaggingConstants", [*LoggedConstants.__annotations__.items(), ("of_one_dt", float)]
)
"""The same of sensors with a lag, whose shares follow from the step: `Session.set_dt` refuses them."""

NO_BAND = 0.0, 0.0
LONGEST_LAGS = 700.0  # time constants in a step, beyond which nothing is left of the last reading


class Recorder(NamedTuple):
    """What logs contain beside the equations of motion: dead band, bias and lag."""

    dead_band_low: float = 0.0  # [V]
    dead_band_high: float = 0.0  # [V]
    bias: tuple[tuple[str, float], ...] = ()  # by channel, in its unit
    lag: tuple[tuple[str, float], ...] = ()  # time constants [s] by channel


def recorder_of(plant: Plant, dead_band=None, bias: Mapping | None = None, lag: Mapping | None = None) -> Recorder:
    """Check dead band, bias and lag of a plant's logs; ValueError states the rule and the value.

    Args:
        plant: whose channels these are.
        dead_band: (low, high) [V], or its half width; the plant's own if None.
        bias: by channel, in its unit.
        lag: time constants by channel [s]; zero for none.
    """
    if dead_band is None:
        dead_band = plant.dead_band
    if not isinstance(dead_band, (tuple, list)):
        half = positive("dead_band", dead_band, zero_allowed=True)
        dead_band = -half, half
    low, high = checked_band(dead_band)
    unknown = [name for name in (*(bias or {}), *(lag or {})) if name not in plant.channels]
    if unknown:
        known = ", ".join(plant.channels)
        raise ValueError(f"bias and lag must be of measured channels, {known}, but got {short_repr(unknown[0])}")
    biases = tuple((name, finite(f"bias of {name}", value)) for name, value in (bias or {}).items() if value)
    lags = ((n, positive(f"lag of {n}", value, zero_allowed=True)) for n, value in (lag or {}).items())
    return Recorder(low, high, biases, tuple((name, value) for name, value in lags if value > 0))


def logged_model(
    *,
    dead_band=None,
    bias: Mapping[str, float] | None = None,
    lag: Mapping[str, float] | None = None,
    operating_voltage: float | None = None,
    prior_cov_factor: float = 1.0,
    **plant_arguments,
) -> StateSpaceModel:
    """`thruster_model` with a dead band, biases and lags.

    Each sensor with a lag adds a state after the two of the thruster: its memory (above). From a preset file the
    recorder is taken, too: bias, lag, ambient flow, Q and R, unless arguments say otherwise. Covariances are per
    step and do not scale with dt; but Q of a preset file, which has the sample time that it belongs to, is that of
    another one by `thruster_env.model.continuous.noise_for_dt`.

    Args:
        dead_band: ends (low, high) of the dead band [V], or half the width of a symmetric one.
        bias: of channels, in their units.
        lag: time constants of channels [s].
        operating_voltage: as for `thruster_model`.
        prior_cov_factor: as for `thruster_model`.
        **plant_arguments: those of `thruster_env.thruster.plant.make_plant`.

    Raises:
        ValueError: if an argument is wrong; the message states the rule and the value.
    """
    plant, recorder = logged_plant(dead_band=dead_band, bias=bias, lag=lag, **plant_arguments)
    base = model_of_plant(
        plant._replace(dead_band=NO_BAND), operating_voltage=operating_voltage, prior_cov_factor=prior_cov_factor
    )
    return with_recorder(base, plant, recorder)


def logged_plant(*, dead_band=None, bias=None, lag=None, **plant_arguments) -> tuple[Plant, Recorder]:
    """A plant and the properties of its recorder, arguments of `logged_model`."""
    preset = plant_arguments.get("preset")
    recorder = read_preset(preset).recorder if preset is not None and is_file(preset) else {}
    defaults = {name: value for name, value in recorder.items() if name not in BY_CHANNEL}
    of, dt = defaults.get("dt"), plant_arguments.get("dt")
    if of is not None and dt is not None and "process_noise_cov" in defaults and not same_dt(of, dt):
        defaults["process_noise_cov"] = noise_for_dt(
            defaults["process_noise_cov"], of, positive("dt", dt)
        ).tolist()
    plant = make_plant(**{**defaults, **plant_arguments})
    variances = [recorder.get("measurement_noise_cov", {}).get(channel) for channel in plant.channels]
    if None not in variances and plant_arguments.get("measurement_noise_cov") is None:
        cov = covariance("measurement_noise_cov", variances, len(variances), positive_definite=True)
        plant = plant._replace(measurement_noise_cov=cov)
    known = [
        {channel: value for channel, value in recorder.get(name, {}).items() if channel in plant.channels}
        for name in ("bias", "lag")
    ]
    bias, lag = (
        of_file if argument is None else argument for of_file, argument in zip(known, (bias, lag), strict=True)
    )
    return plant, recorder_of(plant, dead_band, bias, lag)


def with_recorder(
    base: StateSpaceModel, plant: Plant, recorder: Recorder, *, always: bool = False
) -> StateSpaceModel:
    """A plant's model with its recorder's properties; without any the model itself, unless `always`."""
    if recorder == Recorder() and not always:
        return base
    channels, lags, biases = plant.channels, dict(recorder.lag), dict(recorder.bias)
    lagging = tuple(channel in lags for channel in channels)
    of_plant = Constants(*base.constants)
    step = of_plant.substep
    values = (
        *of_plant,
        recorder.dead_band_low,
        recorder.dead_band_high,
        *_padded(biases.get(channel, 0.0) for channel in channels),
        *_padded(lag_weights(lags.get(channel, 0.0), step)[0] for channel in channels),
        *_padded(lag_weights(lags.get(channel, 0.0), step)[1] for channel in channels),
    )
    constants = LaggingConstants(*values, 1.0) if any(lagging) else LoggedConstants(*values)
    f, f_slopes, h, h_slopes = _functions(channels, lagging)
    read = channel_functions(channels)[0]

    def extended(state) -> np.ndarray:
        """A state with the measurements of the sensors."""
        shows = read(tuple(state), base.constants)
        return np.array([*state, *(shows[i] for i, lags_behind in enumerate(lagging) if lags_behind)])

    voltage = float(base.operating_input[0])
    driving = float(outside(voltage, recorder.dead_band_low, recorder.dead_band_high))
    operating = steady_state(plant.parameters, driving, plant.ambient_velocity)[:2]
    added = [quantity for quantity, lags_behind in zip(base.measurements, lagging, strict=True) if lags_behind]
    slopes = np.vstack([np.eye(2), _slopes_at(base, plant.channels, lagging)])
    q = np.zeros((2 + len(added),) * 2)
    q[:2, :2] = base.process_noise_cov
    ends = [extended(end) for end in (base.state_low, base.state_high)]
    lagging_states = (
        Quantity(f"lagging {quantity.symbol}", f"{quantity.symbol}_lag", quantity.unit) for quantity in added
    )
    return base.replace(
        transition=f,
        observe=h,
        transition_jacobian=f_slopes,
        observe_jacobian=h_slopes,
        constants=constants,
        process_noise_cov=q,
        prior_mean=extended(base.prior_mean),
        prior_cov=slopes @ base.prior_cov @ slopes.T,
        operating_state=extended(operating),
        operating_points=None if recorder != Recorder() else base.operating_points,
        state_low=np.minimum(*ends),
        state_high=np.maximum(*ends),
        states=(*base.states, *lagging_states),
        outputs={"T": (THRUST, _thrust)},
    )


def _thrust(x, c):
    return thrust_of(x[:2], c)


def lag_weights(lag: float, step: float) -> tuple[float, float]:
    """The share a of the last reading in what a first-order lag holds, and the share w of the present value.

    With tau y' = h - y and h linear over the step, q = step/tau,

        y_1 = (1 - w) r_1 + w h_1,  r_1 = a y_0 + (1 - a) h_0,
        a = q/(exp(q) - 1),  w = 1 - (1 - exp(-q))/q.

    Both are continuous at tau = 0, where a = 0, w = 1 and so y_1 = h_1.

    Args:
        lag: time constant tau [s]; zero for none.
        step: [s].
    """
    if lag == 0 or step / lag > LONGEST_LAGS:
        return 0.0, 1.0 - lag / step
    ratio = step / lag
    return ratio / math.expm1(ratio), 1.0 + math.expm1(-ratio) / ratio


def _padded(values) -> tuple[float, ...]:
    entries = [float(value) for value in values]
    return (*entries, *(0.0,) * (MAX_CHANNELS - len(entries)))


def _slopes_at(base: StateSpaceModel, channels, lagging) -> np.ndarray:
    """Slopes of what lagging sensors show at the prior mean, (lags, 2)."""
    rows = channel_functions(channels)[1](tuple(base.prior_mean), base.constants)
    lagging_rows = [row for row, lags_behind in zip(rows, lagging, strict=True) if lags_behind]
    return np.array(lagging_rows, dtype=np.float64).reshape(len(lagging_rows), 2)


@makes_functions
def _functions(channels: tuple[str, ...], lagging: tuple[bool, ...]) -> tuple[Callable, ...]:
    """Transition, its Jacobian, observation and its Jacobian, for some channels of which some lag."""
    read, read_slopes = channel_functions(channels)
    lagging_channels = [i for i, lags_behind in enumerate(lagging) if lags_behind]
    n = 2 + len(lagging_channels)
    state_of = {channel: 2 + number for number, channel in enumerate(lagging_channels)}
    names: dict[str, Any] = {
        "substep": substep,
        "substep_jacobian": substep_jacobian,
        "outside": outside,
        "read": read,
        "read_slopes": read_slopes,
    }
    drive = "v = outside(u[0], c.dead_band_low, c.dead_band_high), c.ambient_velocity"
    move = drive, "s = substep((x[0], x[1]), v, c)"
    reads = ("y = read((x[0], x[1]), c)",) if lagging_channels else ()
    lagged = {i: f"((1.0 - c.after_{i}) * x[{state_of[i]}] + c.after_{i} * y[{i}])" for i in lagging_channels}
    lags = [f"c.kept_{i} * {lagged[i]} + (1.0 - c.kept_{i}) * y[{i}]" for i in lagging_channels]
    transition = written_out("transition", "x, u, c", *move, *reads, tuple_of(["s[0]", "s[1]", *lags]), **names)
    lines = [*move, "a = substep_jacobian((x[0], x[1]), v, c)"]
    lines += ["b = read_slopes((x[0], x[1]), c)"] if lagging_channels else []

    def slope(i, j):
        if i < 2:
            return f"a[{i}][{j}]" if j < 2 else "0.0"
        channel = lagging_channels[i - 2]
        if j < 2:
            return f"(1.0 - c.kept_{channel} * (1.0 - c.after_{channel})) * b[{channel}][{j}]"
        return f"c.kept_{channel} * (1.0 - c.after_{channel})" if i == j else "0.0"

    transition_jacobian = written_out("transition_jacobian", "x, u, c", *lines, matrix_of(n, n, slope), **names)
    reading = tuple_of(f"{lagged.get(i, f'y[{i}]')} + c.bias_{i}" for i in range(len(channels)))

    def row(i, j):
        share = f"c.after_{i} * " if i in state_of else ""
        if j < 2:
            return f"{share}b[{i}][{j}]"
        return f"1.0 - c.after_{i}" if state_of.get(i) == j else "0.0"

    return (
        transition,
        transition_jacobian,
        written_out("observe", "x, c", "y = read((x[0], x[1]), c)", reading, **names),
        written_out(
            "observe_jacobian",
            "x, c",
            "b = read_slopes((x[0], x[1]), c)",
            matrix_of(len(channels), n, row),
            **names,
        ),
    )


def voltage_rates(x, u, c):
    """Time derivatives [rad/s^2, m/s^2] under voltage u = (V_s,), in the ambient flow of the constants."""
    return rates(x, (u[0], c.ambient_velocity), c)


def driven_rates(x, u, c):
    """The same behind a dead band."""
    return rates(x, (outside(u[0], c.dead_band_low, c.dead_band_high), c.ambient_velocity), c)


def continuous_thruster(**arguments) -> ContinuousModel:
    """The thruster in continuous time, from plain arguments that JSON can hold.

        d(omega_m, U_a)/dt = rates + w(t),   z = h(x) + v

    The spectral densities of w are those whose Q of a step `dt` is `process_noise_cov`: `at(dt)` is
    `thruster_env.thruster.model.logged_model(**arguments)`, and `at` of another sample time is its model, with Q
    by `thruster_env.model.continuous.noise_for_dt`.

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
