"""`StateSpaceModel`: the model of a plant that a filter assumes, with checks of its functions and a digest."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Self

import numpy as np

from thruster_env.core.checks import as_floats, at_least, covariance, covariance_root, one_of, short_repr, vector
from thruster_env.core.compiled import as_function, as_made, functions_in
from thruster_env.core.derivatives import by_complex_step, complex_step
from thruster_env.core.equal_functions import first_equal
from thruster_env.core.sources import as_value, is_array
from thruster_env.graphs.python_floats import with_floats
from thruster_env.model.euler import euler_outputs
from thruster_env.model.functions import check_functions, check_values, takes_input
from thruster_env.model.quantities import (
    Positions,
    Quantities,
    checked_bounds,
    count_of,
    outputs,
    quantities,
    scales_of,
)
from thruster_env.model.shape import Functions, Shape, constants_are_array, constants_form
from thruster_env.model.traced import called_function
from thruster_env.model.turns import Turn, refuse_rotations, unit_mean, with_rotations


@dataclass(frozen=True, kw_only=True, eq=False)
class StateSpaceModel:
    """A discrete-time model with additive Gaussian noise, for n states, p inputs and m measurements.

        x_{k+1} = f(x_k, u_k) + w,  w ~ N(0, Q);   z_k = h(x_k) + v,  v ~ N(0, R);   x_0 ~ N(mean, cov)

    Covariances are per step and do not scale with dt: a model of another sample time needs its own Q (and R).

    A measurement that also depends on the input of its instant, as a cell's voltage does on its current, has
    h(x, u, c) in place of h(x, c). An input acts until the end of its step, and so on the measurement there:

        z_{k+1} = h(x_{k+1}, u_k) + v;   z_0 = h(x_0, 0) + v,  because no input acts before the first step

    The functions are `transition(x, u, c)`, `observe(x, c)` or `observe(x, u, c)` and, if known, their Jacobians,
    which take the same. They take and return tuples of components, Jacobians as tuples of rows (n rows of n, m
    rows of n), and may use the parameters of the model, `constants` c. They are plain Python: loops, arrays,
    dataclasses and a few branches become machine code wherever the model is used (`thruster_env.model.traced`).
    What cannot runs as Python, and a warning says why. Globals and closures are read when a run begins.

    Above 36 states or inputs, or 96 constants in a plain tuple, x, u or c is an array of float64 and not a tuple;
    it is complex if a Jacobian is computed by complex steps (`np.empty_like(x)` makes another such array). It is
    indexed in the same way, and functions may return arrays or tuples of any size. A Jacobian of more than a
    thousand entries should be an array, or a tuple of rows of floats.

    Models can be copied and pickled, and so can filters and wrapped envs that hold them. Pickle stores functions
    by name: define yours in a module. Nested functions and lambdas need cloudpickle.

    Attributes:
        transition: f, or one of its `substeps` equal parts: the function is applied `substeps` times in a step.
        observe: h, without noise; with three arguments it takes the input, too.
        process_noise_cov: Q, (n, n) or n variances, per step.
        measurement_noise_cov: R, (m, m) or m variances, of each error of a measurement; positive definite.
        prior_mean: mean of the initial state, (n,).
        prior_cov: covariance of the initial state, (n, n) or n variances; zero allowed.
        inputs: number p of inputs, or their `input_quantities`; if None as many as those, and without these none,
            or one if f does not work without.
        constants: a NamedTuple (or tuple) of floats that is passed to every function.
        transition_jacobian: df/dx(x, u, c) of one application, finite at the prior mean. If None it follows from f
            exactly, where f consists of arithmetic, functions of `math` or numpy and a few branches, or else by
            central differences.
        observe_jacobian: dh/dx(x, c) or dh/dx(x, u, c), in the same way.
        analytic: whether f and h are analytic functions that take complex numbers: Jacobians that are None are
            then found by complex steps, exactly (`derivatives.complex_step`).
        substeps: number of applications of `transition` per step.
        operating_state: x* (n,) about which a Kalman filter approximates the model; None for affine models.
        operating_input: u* (p,), the input that goes with it.
        operating_points: `operating_points(count)` returns that many pairs (x*, u*) over the range of a single
            input, in increasing order of u*, for gain scheduling of a Kalman filter; None if unknown.
        state_low: smallest value of each state in normal operation, (n,); None if unknown.
        state_high: largest value of each state, (n,); None if unknown.
        bounds: (low, high) of states by symbol or index, None for no bound: {"c": (0.0, None)}. Estimates of the
            Kalman filters of one mean and covariance keep them; the belief beneath knows of none. `mhe` keeps
            them in all states of its window.
        bounded_by: how: "truncation", the moments of the Gaussian within the bounds, or "projection", the most
            probable state within (`filters.engine.belief`).
        states: a `Quantity` or a name for each state, or a `Rotation` for four; x_1, x_2, ... if None.
        input_quantities: the same for the inputs; u_1, ... if None.
        measurements: the same for the measurements; z_1, ... if None. Of a `Rotation`, h returns four numbers.
        outputs: outputs of the model by symbol: an `Output` each, a quantity and a function of (x, c).
        turns, measured_turns: rotations; they follow from `states` and `measurements`.
        positions: `Positions` of states and measurements, for ensembles with localisation; None if unknown.

    Raises:
        ValueError: if shapes do not fit, a covariance or constant is not valid, or a function does not work at the
            prior mean; the message states the rule and the value.
    """

    transition: Callable
    observe: Callable
    process_noise_cov: Any
    measurement_noise_cov: Any
    prior_mean: Any
    prior_cov: Any
    inputs: Any = None
    constants: tuple = ()
    transition_jacobian: Callable | None = None
    observe_jacobian: Callable | None = None
    analytic: bool = False
    substeps: int = 1
    operating_state: Any = None
    operating_input: Any = None
    operating_points: Callable | None = None
    state_low: Any = None
    state_high: Any = None
    bounds: Any = ()
    bounded_by: str = "truncation"
    states: Any = None
    input_quantities: Any = None
    measurements: Any = None
    outputs: Mapping[str, Any] = field(default_factory=dict)
    positions: Positions | None = None
    turns: tuple[Turn, ...] = ()
    measured_turns: tuple[Turn, ...] = ()

    def __post_init__(self):
        """Check shapes and signs, and try the functions; raise ValueError that states the rule and the value."""
        mean = vector("prior_mean", self.prior_mean)
        n, r = len(mean), self.measurement_noise_cov
        m = _length(r)
        states, turns = with_rotations(self.states, self.turns)
        measurements, measured_turns = with_rotations(self.measurements, self.measured_turns)
        t, channels = n - len(turns), m + len(measured_turns)
        checked: dict[str, Any] = {
            "turns": turns,
            "measured_turns": measured_turns,
            "prior_mean": unit_mean(mean, turns),
            "prior_cov": covariance("prior_cov", self.prior_cov, t),
            "process_noise_cov": covariance("process_noise_cov", self.process_noise_cov, t),
            "measurement_noise_cov": covariance("measurement_noise_cov", r, m, positive_definite=True),
            "substeps": at_least("substeps", self.substeps, 1, 10_000),
            "constants": checked_constants(self.constants),
        }
        inputs, u = self.inputs, self.input_quantities
        if u is None and isinstance(inputs, list | tuple):
            inputs, u = None, inputs
        if inputs is None:
            inputs = _needed_inputs(self, checked) if u is None else count_of(u)
        checked["inputs"] = at_least("inputs", inputs, 0)
        sizes = {"operating_state": n, "operating_input": checked["inputs"], "state_low": n, "state_high": n}
        for name, size in sizes.items():
            if getattr(self, name) is not None:
                checked[name] = vector(name, getattr(self, name), size)
        if self.analytic:
            checked["transition_jacobian"] = self._exact("transition", n, n, "u, c")
            checked["observe_jacobian"] = self._exact("observe", channels, n, "u, c" if self.feeds else "c")
        checked["states"] = quantities("states", states, n, "x", "prior_mean")
        checked["input_quantities"] = quantities("input_quantities", u, checked["inputs"], "u", "inputs, or b,")
        checked["measurements"] = quantities("measurements", measurements, channels, "z", "measurement_noise_cov")
        checked["outputs"] = euler_outputs(turns, checked["states"]) | outputs(self.outputs)
        if self.positions is not None:
            checked["positions"] = Positions(*self.positions).checked(n, channels)
        checked["bounds"] = checked_bounds(self.bounds, checked["states"], turns)
        one_of("bounded_by", self.bounded_by, ("truncation", "projection"))
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        check_functions(self)

    def __getstate__(self) -> dict:
        """The fields, with recipes in place of functions that this package generated."""
        return {name: as_made(value) for name, value in vars(self).items() if name != "_packed"}

    def __setstate__(self, state: dict) -> None:
        """The fields, with functions generated again."""
        vars(self).update({name: as_function(value) for name, value in state.items()})

    def _exact(self, name: str, rows: int, columns: int, arguments: str) -> Callable:
        """The user's Jacobian, or one by complex steps, which `replace` makes anew."""
        jacobian, function = getattr(self, f"{name}_jacobian"), getattr(self, name)
        if jacobian is not None and not by_complex_step(jacobian):
            return jacobian
        return complex_step(function, rows, columns, arguments)

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.prior_mean)

    @property
    def t(self) -> int:
        """Number of components of an error of the state: n, less one for each rotation."""
        return self.n - len(self.turns)

    @property
    def m(self) -> int:
        """Number of components of an innovation: of measurements, without one for each rotation among them."""
        return len(self.measurement_noise_cov)

    @property
    def channels(self) -> int:
        """Number of numbers of a measurement."""
        return self.m + len(self.measured_turns)

    @cached_property
    def feeds(self) -> bool:
        """Whether h takes the input: measurements have feed-through."""
        return takes_input(self.observe)

    @cached_property
    def reads_from_outside(self) -> bool:
        """Whether functions are a user's: their globals and closures may have other values than before."""
        functions = self.transition, self.transition_jacobian, self.observe, self.observe_jacobian
        return next(functions_in(*functions), None) is not None

    @property
    def shape(self) -> Shape:
        """Sizes of the model, and other data needed to compile its code; ValueError if it has rotations."""
        refuse_rotations(self)
        return self.any_shape

    @property
    def any_shape(self) -> Shape:
        """`shape`, for what takes rotations, too."""
        states, channels = (tuple(part.angle for part in parts) for parts in (self.states, self.measurements))
        sizes = self.n, self.m, self.inputs, constants_form(self.constants)
        return Shape(*sizes, states, channels, False, self.feeds, self.turns, self.measured_turns)

    @property
    def functions(self) -> Functions:
        """The model's functions, ready for compiled code: large results are always arrays."""
        n, m, slopes = self.n, self.channels, first_equal((self.transition_jacobian, self.observe_jacobian))
        shape = self.any_shape
        form, arguments_of_h = shape.form, f"x, {shape.observe_arguments}"
        sizes = n, self.inputs, len(self.constants)

        def ready(function: Callable | None, arguments: str, *shape: int) -> Any:
            if function is None or by_complex_step(function):
                return function
            return called_function(function, arguments, sizes if "u" in arguments else (n, sizes[2]), form, shape)

        return Functions(
            ready(first_equal(self.transition), "x, u, c", n),
            ready(slopes[0], "x, u, c", n, n),
            ready(first_equal(self.observe), arguments_of_h, m),
            ready(slopes[1], arguments_of_h, m, n),
        )

    @property
    def given_constants(self) -> tuple | np.ndarray:
        """The constants as functions get them: an array if there are too many for a tuple."""
        return np.array(self.constants) if constants_are_array(self.any_shape.form) else self.constants

    def replace(self, **changes) -> Self:
        """A copy of the model with some fields changed; ValueError as for a new model."""
        changes |= {"constants": checked_constants(changes["constants"])} if "constants" in changes else {}
        constants = changes.get("constants", self.constants)
        if (
            changes.keys() <= NUMBERS
            and not self._has_more
            and _length(changes.get("measurement_noise_cov", self.measurement_noise_cov)) == self.m
            and _length(changes.get("prior_mean", self.prior_mean)) == self.n
            and (type(constants), len(constants)) == (type(self.constants), len(self.constants))
            and not ("constants" in changes and self.turns)
        ):
            return self._with_numbers(changes)
        return dataclasses.replace(self, **changes)

    @property
    def _has_more(self) -> bool:
        """Whether a subclass checks or keeps more than the fields: it may depend on covariances, too."""
        names = {attribute.name for attribute in dataclasses.fields(self)} | {*OF_FUNCTIONS, "digest", "_packed"}
        return type(self).__post_init__ is not StateSpaceModel.__post_init__ or not vars(self).keys() <= names

    def _with_numbers(self, changes: dict[str, Any]) -> Self:
        """`replace` of numbers; functions are tried with new constants and prior means, none needs covariances."""
        model = object.__new__(type(self))
        vars(model).update({name: vars(self)[name] for name in OF_FUNCTIONS & vars(self).keys()})
        for attribute in dataclasses.fields(self):
            value = getattr(self, attribute.name)  # arrays and outputs could be changed: each model has its own
            copied = value.copy() if isinstance(value, np.ndarray | dict) else value
            object.__setattr__(model, attribute.name, copied)
        for name in changes.keys() & NOISE:
            measured, size = (True, self.m) if name == "measurement_noise_cov" else (False, self.t)
            object.__setattr__(model, name, covariance(name, changes[name], size, positive_definite=measured))
        if "prior_mean" in changes:
            mean = unit_mean(vector("prior_mean", changes["prior_mean"], self.n), self.turns)
            object.__setattr__(model, "prior_mean", mean)
        if "constants" in changes:
            object.__setattr__(model, "constants", changes["constants"])
        if not changes.keys() <= NOISE:
            check_values(model)
        return model

    @property
    def quantities(self) -> Quantities:
        """Names, symbols and units of states, inputs and measurements."""
        return Quantities(self.states, self.input_quantities, self.measurements)

    @cached_property
    def digest(self) -> str:
        """A short hash of names, units, sizes and values of f and h; Q, R and the prior do not enter."""
        return digest_of(self)

    def output(self, symbol: str, states: np.ndarray) -> np.ndarray:
        """The output `symbol`, shape (...), at states (..., n); ValueError if the model has no such output."""
        one_of("output", symbol, tuple(self.outputs))
        components = np.moveaxis(states, -1, 0)
        x = components if is_array(self.n) else tuple(components)
        return self.outputs[symbol].function(x, self.given_constants)

    @property
    def numbers(self) -> np.ndarray:
        """Constants, noise, prior and substeps as one float64 row, the form that compiled functions take."""
        packed, source = vars(self).get("_packed"), self.numbers_from
        if packed is None or packed[0] != source:  # roots of covariances take long
            packed = source, self._pack()
            object.__setattr__(self, "_packed", packed)
        return packed[1].copy()

    @property
    def numbers_from(self) -> tuple:
        """The inputs of `numbers` as a comparable value, because arrays may have been written to."""
        q, r, mean, cov = self.process_noise_cov, self.measurement_noise_cov, self.prior_mean, self.prior_cov
        return q.tobytes(), r.tobytes(), mean.tobytes(), cov.tobytes(), self.substeps, self.constants

    def _pack(self) -> np.ndarray:
        q, r, p = self.process_noise_cov, self.measurement_noise_cov, self.prior_cov
        noise = q, covariance_root(q), r, covariance_root(r)
        parts = *noise, self.prior_mean, p, covariance_root(p), self.scales, [self.substeps], list(self.constants)
        return np.concatenate([np.ravel(np.asarray(part, dtype=np.float64)) for part in parts])

    @property
    def scales(self) -> np.ndarray:
        """Scale of each state for the steps of central differences, (n,): see `state_scales`."""
        return scales_of(self)


def _needed_inputs(model, checked: Mapping[str, Any]) -> int:
    """The number of inputs of a model that does not say: none if f works without, else one."""
    constants = checked["constants"]
    c = np.array(constants) if constants_are_array(constants_form(constants)) else constants
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model.transition(*with_floats(float, [as_value(checked["prior_mean"].tolist()), (), c]))
    except (IndexError, TypeError, ValueError) as error:
        return 0 if str(error).startswith("math ") else 1  # "math domain error" is one of the state
    except Exception:  # which is said later
        return 0
    return 0


def checked_constants(constants) -> tuple:
    """Return constants as a NamedTuple, as it is given, or a tuple of floats; raise ValueError for others."""
    try:
        if isinstance(constants, (dict, set, str)):
            raise ValueError
        values = as_floats(tuple(constants))
        if values.ndim != 1 or not np.isfinite(values).all():
            raise ValueError
    except (TypeError, ValueError):
        rule = "constants must be a NamedTuple or a tuple of finite numbers"
        raise ValueError(f"{rule}, but got {short_repr(constants)}") from None
    return constants if hasattr(constants, "_fields") else tuple(values.tolist())


def refuse_feed(model: StateSpaceModel, what: str) -> None:
    """Raise ValueError for a model whose h takes the input."""
    if model.feeds:
        raise ValueError(
            f"{what} must have measurements of the state alone, h(x, c), but the model has h(x, u, c): "
            "use a filter such as 'ekf', 'ukf', 'enkf' or 'mhe'"
        )


LENGTH = 12  # hexadecimal digits
MAGNITUDES = (0.0, 0.1, 1.0, 1.0, 10.0, 100.0)  # of states and inputs at the points
DIGITS = 10  # of a value: further ones differ from one machine to another
SMALL = 1e-2  # relative to the largest number at a point: smaller values may be differences, with fewer digits


def digest_of(model: StateSpaceModel) -> str:
    """A hash of names, units, sizes and substeps, and of the values of f and h at fixed points.

    The hash omits noise and prior, which tuning changes, Jacobians, which follow from the functions, and
    operating points and ranges, which only help a filter. The points are the same for all models of a size: points
    about the prior would change with it. Values are rounded to ten digits, so that other machines and versions of
    Python compute the same hash.
    """
    constants = getattr(model.constants, "_fields", len(model.constants))
    parts = {
        "quantities": model.quantities,
        "outputs": {symbol: output.quantity for symbol, output in model.outputs.items()},
        "sizes": (model.n, model.inputs, model.m, model.substeps),
        "constants": constants,
        "transition": _values(model.transition, model, (model.n, model.inputs)),
        "observe": _values(model.observe, model, (model.n, model.inputs) if model.feeds else (model.n,)),
    }
    parts |= {name: getattr(model, name) for name in ("turns", "measured_turns") if getattr(model, name)}
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:LENGTH]


def _points(sizes: tuple[int, ...]) -> list[list[tuple[float, ...]]]:
    """Vectors of the sizes for each point; every other point has positive components only."""
    points = []
    for k, magnitude in enumerate(MAGNITUDES):
        signs = (1.0, -1.0) if k % 2 else (1.0, 1.0)
        points.append(
            [
                tuple(magnitude * signs[(i + j) % 2] * (1.0 + ((3 * i + 5 * k + j) % 7) / 7) for i in range(size))
                for j, size in enumerate(sizes)
            ]
        )
    return points


def _values(function: Callable, model: StateSpaceModel, sizes: tuple[int, ...]) -> list:
    """The values of a function at the points, rounded, or the type of its exception."""
    results: list = []
    for point in _points(sizes):
        try:
            with np.errstate(all="ignore"):
                values = [float(value) for value in function(*map(as_value, point), model.given_constants)]
        except Exception as error:  # the model is not defined at this point, which identifies it, too
            results.append(type(error).__name__)
            continue
        numbers = [*values, *(x for vector in point for x in vector)]
        largest = max((abs(number) for number in numbers if math.isfinite(number)), default=0.0)
        results.append([_rounded(value, largest) for value in values])
    return results


def _rounded(value: float, largest: float) -> str:
    if not math.isfinite(value):
        return str(value)
    if abs(value) >= SMALL * largest > 0.0:
        return f"{value:.{DIGITS - 1}e}"
    return str(round(value / largest * 10**DIGITS / SMALL)) if largest > 0.0 else "0"


NOISE = {"process_noise_cov", "measurement_noise_cov", "prior_cov"}  # fields that no function depends on
NUMBERS = {*NOISE, "prior_mean", "constants"}  # which change no shape
OF_FUNCTIONS = {"feeds", "reads_from_outside"}  # properties of functions alone


def _length(value) -> int:
    """Rows of a covariance or numbers of a vector as it is given: of a plain number one."""
    return len(value) if isinstance(value, (list, tuple, np.ndarray)) and np.ndim(value) else 1
