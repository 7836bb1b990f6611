"""`ContinuousModel`: rates of a plant in continuous time, which give a model for any sample time."""

from __future__ import annotations

import dataclasses
import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from thruster_env.core.checks import (
    ROUNDING,
    as_floats,
    at_least,
    correlations,
    covariance,
    positive,
    short_repr,
    vector,
)
from thruster_env.core.derivatives import jacobian, runge_kutta
from thruster_env.core.equal_functions import makes_functions
from thruster_env.core.sources import tuple_of, written_out
from thruster_env.model.functions import takes_input
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.turns import Turn, move, runge_kutta_munthe_kaas, slope_of_rates, with_rotations

SAME_DT = 1e-6  # relative: sample times of logs that are read off stamps


def same_dt(first: float, second: float) -> bool:
    """Whether two sample times [s] agree except for the rounding of stamps."""
    return abs(first - second) <= SAME_DT * max(abs(first), abs(second))


def noise_for_dt(
    process_noise_cov: ArrayLike, dt_from: float, dt_to: float, slope: ArrayLike | None = None
) -> np.ndarray:
    """Q of a step of another sample time: Q dt_to/dt_from, as for Gaussian diffusion.

    It is exact if the states change little within a step; otherwise a first guess. With the slope A it is exact
    for linear rates: it is the Q of white noise whose densities give the old Q at `dt_from`.

    Args:
        process_noise_cov: Q per step of `dt_from`, a matrix, variances or one.
        dt_from: its sample time [s].
        dt_to: the new sample time [s].
        slope: A, the derivative of the rates by the state, (n, n); zero if None.

    Raises:
        ValueError: with a slope, if no white noise gives such a Q.
    """
    if slope is None:
        return np.asarray(process_noise_cov, dtype=np.float64) * (dt_to / dt_from)
    return noise_of_densities(densities_of(process_noise_cov, slope, dt_from), slope, dt_to)


def noise_of_densities(densities: ArrayLike, slope: ArrayLike, dt: float) -> np.ndarray:
    """Q per step of white noise with spectral densities S (n, n) on linear rates with slope A.

        Q = int_0^dt e^{A t} S e^{A' t} dt,   exp([-A, S; 0, A'] dt) = [., G; 0, F'],   Q = F G

    Source: van Loan (1978), "Computing integrals involving the matrix exponential", IEEE Transactions on Automatic
    Control 23(3).
    """
    from scipy.linalg import expm

    a, s = as_floats(slope), as_floats(densities)
    n = len(a)
    exponential = expm(np.block([[-a, s], [np.zeros((n, n)), a.T]]) * positive("dt", dt))
    q = exponential[n:, n:].T @ exponential[:n, n:]
    return 0.5 * (q + q.T)


def densities_of(process_noise_cov: ArrayLike, slope: ArrayLike, dt: float) -> np.ndarray:
    """S (n, n) that gives this Q per step dt: `noise_of_densities`, linear in S, solved for S.

    Raises:
        ValueError: if S is no covariance: no white noise on such rates gives this Q.
    """
    slope = as_floats(slope)
    n = len(slope)
    q, units = correlations(covariance("process_noise_cov", process_noise_cov, n))
    slope, (rows, columns) = slope / units[:, None] * units, np.triu_indices(n)
    of_units = np.empty((len(rows), len(rows)))
    for column, (i, j) in enumerate(zip(rows, columns, strict=True)):
        unit = np.zeros((n, n))
        unit[i, j] = unit[j, i] = 1.0
        of_units[:, column] = noise_of_densities(unit, slope, dt)[rows, columns]
    s = np.zeros((n, n))
    s[rows, columns] = s[columns, rows] = np.linalg.solve(of_units, q[rows, columns])
    q_text = short_repr(as_floats(process_noise_cov).tolist())
    try:
        s = covariance("densities", s, n, variances=np.diag(q) / dt)
        without = np.diag(s) <= ROUNDING * np.diag(q) / dt  # these states have no noise of their own, to rounding
        s[without], s[:, without] = 0.0, 0.0
        return s * units[:, None] * units
    except ValueError:
        raise ValueError(
            "process_noise_cov must be that of white noise in continuous time (a state driven by others has part "
            f"of their noise within a step), but got {q_text} for a step of {dt:g} s"
        ) from None


RATE_ROUNDING = 1e-9  # of a step that is divided


@dataclass(frozen=True, kw_only=True, eq=False)
class ContinuousModel:
    """A plant in continuous time with white noise, measured at any times.

        dx/dt = rates(x, u, c) + w(t),  E[w(t) w(s)'] = S delta(t - s);   z = h(x, c) + v,  v ~ N(0, R)

    or z = h(x, u, c) + v, with the input until then.

    `rates(x, u, c)` takes and returns tuples, as the functions of a `StateSpaceModel`; the constants c are a
    NamedTuple with a field `substep`, the length of a Runge-Kutta step [s], which `at` sets. If there is a
    `Rotation` among the states, rates have its angular rate [rad/s], three numbers in the axes of its side, in the
    place of its quaternion, and steps are Munthe-Kaas's (`thruster_env.model.turns`).

    Attributes:
        rates: dx/dt without noise.
        observe: h, without noise, which returns a tuple; or a function h_i(x, c), or h_i(x, u, c), of each channel
            by its symbol, which returns a number: {"position": ..., "depth": ...}.
        densities: S, (n, n) or n numbers, in the square of each state's unit per second; (t, t) of errors if there
            are rotations, [rad^2/s] of these.
        constants: of rates and h.
        arguments: the other fields of `StateSpaceModel`: R, prior, quantities, operating point and the like; also
            `transition` and Jacobians, of a step of `substep`, if they are known.
        longest: longest Runge-Kutta step that is accurate enough [s].

    Raises:
        ValueError: for constants without `substep`, or a density that is no covariance.

    Source: van Loan (1978), "Computing integrals involving the matrix exponential", for Q; Sarkka, Solin (2019),
    Applied Stochastic Differential Equations, section 6.3.
    """

    rates: Callable
    observe: Callable | Mapping[str, Callable]
    densities: Any
    constants: Any
    arguments: Mapping[str, Any] = field(default_factory=dict)
    longest: float = math.inf

    def __post_init__(self):
        """Check what is given; raise ValueError that states the rule and the value."""
        _check_constants(self.constants)
        mean = vector("prior_mean", self.arguments.get("prior_mean", ()))
        count = len(mean) - len(self.turns)
        object.__setattr__(self, "densities", covariance("densities", self.densities, count))
        if isinstance(self.observe, Mapping):
            channels = self.observe
            object.__setattr__(self, "observe", _joint_observation(tuple(channels.values())))
            object.__setattr__(self, "arguments", {"measurements": list(channels), **self.arguments})

    @classmethod
    def of(cls, model: StateSpaceModel, rates: Callable) -> Self:
        """The continuous plant of a discrete model: its `at(dt)` is the model itself.

        Its densities give the model's Q, and no Runge-Kutta step is longer than the model's.

        Args:
            model: whose transition is a Runge-Kutta step of `rates`, of the constant `substep`.
            rates: dx/dt, as the class takes it.

        Raises:
            ValueError: for a model of other rates, or a Q that no white noise gives.
        """
        _check_constants(model.constants)
        names = {field.name for field in dataclasses.fields(model)}
        retained = names - {"observe", "constants", "substeps", "process_noise_cov"}
        arguments: dict[str, Any] = {
            "rates": rates,
            "observe": model.observe,
            "constants": model.constants,
            "arguments": {name: getattr(model, name) for name in retained},
        }
        constants: Any = model.constants  # a NamedTuple
        step, t = constants.substep, model.t
        plain = cls(**arguments, densities=np.zeros((t, t)), longest=step)
        x, u = plain.point
        propagated, expected = (f(x, u, model.constants) for f in (plain.transition, model.transition))
        if not np.allclose(propagated, expected, rtol=1e-9, atol=1e-12):
            raise ValueError(
                f"rates must be those of the model, whose step from {short_repr(x)} leads to "
                f"{short_repr(expected)}, but theirs leads to {short_repr(propagated)}"
            )
        densities = densities_of(model.process_noise_cov, plain.slope, step * model.substeps)
        return dataclasses.replace(plain, densities=densities)

    def at(self, dt: float, substeps: int | None = None) -> StateSpaceModel:
        """The model for a sample time [s]: Runge-Kutta in some equal parts, and Q by van Loan.

        The parts are as few as `longest` allows, unless their number is given. A filter on it can be `live`, with
        `noise=continuous.noise`.
        """
        dt = positive("dt", dt)
        if substeps is None:
            substeps = max(1, math.ceil(dt / self.longest - RATE_ROUNDING))
        substeps = at_least("substeps", substeps, 1, 10_000)
        arguments: dict[str, Any] = {"transition": self.transition, **self.arguments}
        arguments["observe"] = self.observe
        return StateSpaceModel(
            **arguments,
            constants=self.constants._replace(substep=dt / substeps),
            substeps=substeps,
            process_noise_cov=self.noise(dt),
        )

    def noise(self, dt: float) -> np.ndarray:
        """Q of a step of length dt [s], of the rates linearised at the operating point, or at the prior mean.

        It is that of `thruster_env.model.continuous.noise_for_dt` with their slope.
        """
        return noise_of_densities(self.densities, self.slope, dt)

    @property
    def turns(self) -> tuple[Turn, ...]:
        """The rotations and poses of the state; ValueError if there are directions."""
        turns = with_rotations(self.arguments.get("states"), self.arguments.get("turns", ()))[1]
        for turn in turns:
            if turn.kind == "direction":
                rule = "states in continuous time must be numbers, rotations and poses"
                raise ValueError(f"{rule}, but {turn.name!r} is a direction: give the transition of a step")
        return turns

    @property
    def transition(self) -> Callable:
        """One step of the rates, of length c.substep [s]."""
        if self.turns:
            return runge_kutta_munthe_kaas(self.rates, self.turns)
        return runge_kutta(self.rates, len(self.densities))

    @property
    def point(self) -> tuple[tuple, tuple]:
        """State and input about which the rates are linearised."""
        arguments = self.arguments
        x, u = arguments.get("operating_state"), arguments.get("operating_input")
        x = np.asarray(arguments["prior_mean"] if x is None else x, dtype=np.float64)
        count = arguments.get("inputs") or len(arguments.get("input_quantities") or ())
        u = np.zeros(count) if u is None else np.asarray(u, dtype=np.float64)
        return tuple(x.tolist()), tuple(u.tolist())

    @property
    def slope(self) -> np.ndarray:
        """A, the derivative of the rates by the state, (n, n); of errors, (t, t), if there are rotations."""
        (x, u), turns, t = self.point, self.turns, len(self.densities)
        if not turns:
            return np.array(jacobian(self.rates, None, t, t, "u, c")(x, (1.0,) * t, u, self.constants))
        by_error = jacobian(lambda d, u, c: self.rates(tuple(move(x, d, turns)), u, c), None, t, t, "u, c")
        slopes = np.array(by_error((0.0,) * t, (1.0,) * t, u, self.constants))
        return slope_of_rates(slopes, self.rates(x, u, self.constants), turns)


def continuous_of(offer: Any) -> ContinuousModel | None:
    """An object that is a model in continuous time, or the one it makes without arguments; otherwise None."""
    if isinstance(offer, ContinuousModel) or not callable(offer) or hasattr(offer, "state_space_model"):
        return offer if isinstance(offer, ContinuousModel) else None
    try:
        model = offer()
    except Exception:  # whoever needs the model says what is wrong
        return None
    return model if isinstance(model, ContinuousModel) else None


def in_discrete_time(offer: Any) -> Any:
    """A function that makes models for a sample time `dt` from a continuous one or its maker; others unchanged."""
    if continuous_of(offer) is None:
        return offer
    return offer.at if isinstance(offer, ContinuousModel) else AtDt(offer)


@dataclass(frozen=True)
class AtDt:
    """A function that makes models in continuous time, turned into one for a sample time.

    Attributes:
        make: the function, whose arguments this has, and `dt` [s].
    """

    make: Callable[..., ContinuousModel]

    @property
    def __signature__(self) -> inspect.Signature:
        """That of the function, with dt."""
        parameters = [
            parameter
            for parameter in inspect.signature(self.make).parameters.values()
            if parameter.kind is not parameter.VAR_KEYWORD
        ]
        return inspect.Signature([*parameters, inspect.Parameter("dt", inspect.Parameter.KEYWORD_ONLY)])

    def __call__(self, *, dt: float, **arguments: Any) -> StateSpaceModel:
        """The model of a sample time."""
        return self.make(**arguments).at(dt)


def _check_constants(constants: Any) -> None:
    if "substep" not in getattr(constants, "_fields", ()):
        raise ValueError(f"constants must be a NamedTuple with a field substep, but got {short_repr(constants)}")


@makes_functions
def _joint_observation(functions: tuple[Callable, ...]) -> Callable:
    """`observe(x, c)` of a function h_i(x, c) a channel; `observe(x, u, c)` if one of them takes the input."""
    names: dict[str, Any] = {f"h_{i}": function for i, function in enumerate(functions)}
    arguments = ["x, u, c" if takes_input(function) else "x, c" for function in functions]
    calls = (f"{name}({of_channel})" for name, of_channel in zip(names, arguments, strict=True))
    return written_out("observe", max(arguments, key=len), tuple_of(calls), **names)
