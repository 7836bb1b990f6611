"""`StateSpaceModel`: the model of a plant that a filter assumes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Self

import numpy as np

from thruster_env.core.checks import at_least, covariance, covariance_root, one_of, vector
from thruster_env.core.derivatives import by_complex_step, complex_step
from thruster_env.core.equal_functions import first_equal
from thruster_env.core.results import array_valued
from thruster_env.core.sources import is_array
from thruster_env.core.user_functions import as_function, as_made
from thruster_env.graphs.python_floats import with_python_floats
from thruster_env.model.model_check import check_functions, checked_constants, digest_of
from thruster_env.model.quantities import Positions, Quantities, count_of, outputs, quantities
from thruster_env.model.shape import Functions, Shape, constants_are_array, constants_form
from thruster_env.model.state_bounds import checked_bounds, scales_of

NOISE = {"process_noise_cov", "measurement_noise_cov", "prior_cov"}  # fields that no function depends on


@dataclass(frozen=True, kw_only=True, eq=False)
class StateSpaceModel:
    """A discrete-time model with additive Gaussian noise, for n states, p inputs and m measurements.

        x_{k+1} = f(x_k, u_k) + w,  w ~ N(0, Q);   z_k = h(x_k) + v,  v ~ N(0, R);   x_0 ~ N(mean, cov)

    Covariances are per step and do not scale with dt: a model of another sample time needs its own Q (and R).

    The functions are `transition(x, u, c)`, `observe(x, c)` and, if known, their Jacobians. They take and return
    tuples of components, Jacobians as tuples of rows (n rows of n, m rows of n), and may use the parameters of the
    model, `constants` c. Functions made of arithmetic and `math` or `numpy` scalar functions are compiled; others
    run as Python, slower, with the same results.

    Above 36 states or inputs, or 96 constants in a plain tuple, x, u or c is an array of float64 and not a tuple;
    it is complex if a Jacobian is computed by complex steps (`np.empty_like(x)` makes another such array). It is
    indexed in the same way, and functions may return arrays or tuples of any size. A Jacobian of more than a
    thousand entries should be an array, or a tuple of rows of floats.

    Models can be copied and pickled, and so can filters and wrapped envs that hold them. Pickle stores functions
    by name: define yours in a module. Nested functions and lambdas need cloudpickle.

    Attributes:
        transition: f, or one of its `substeps` equal parts: the function is applied `substeps` times in a step.
        observe: h, without noise.
        process_noise_cov: Q, (n, n) or n variances, per step.
        measurement_noise_cov: R, (m, m) or m variances, of each measurement; positive definite.
        prior_mean: mean of the initial state, (n,).
        prior_cov: covariance of the initial state, (n, n) or n variances; zero allowed.
        inputs: number p of inputs; as many as `input_quantities` if None, or one.
        constants: a NamedTuple (or tuple) of floats that is passed to every function.
        transition_jacobian: df/dx(x, u, c) of one application, finite at the prior mean. If None it follows from f
            exactly, where f consists of arithmetic, functions of `math` or numpy and a few branches, or else by
            central differences.
        observe_jacobian: dh/dx(x, c), in the same way.
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
            probable state within (`filters.engine.bounded`).
        states: a `Quantity` or a name for each state; x_1, x_2, ... if None.
        input_quantities: the same for the inputs; u_1, ... if None.
        measurements: the same for the measurements; z_1, ... if None.
        outputs: outputs of the model by symbol: an `Output` each, a quantity and a function of (x, c).
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

    def __post_init__(self):
        """Check shapes and signs, and try the functions; raise ValueError that states the rule and the value."""
        mean = vector("prior_mean", self.prior_mean)
        n, r = len(mean), self.measurement_noise_cov
        m = _channels(r)
        checked: dict[str, Any] = {
            "prior_mean": mean,
            "prior_cov": covariance("prior_cov", self.prior_cov, n),
            "process_noise_cov": covariance("process_noise_cov", self.process_noise_cov, n),
            "measurement_noise_cov": covariance("measurement_noise_cov", r, m, positive_definite=True),
            "substeps": at_least("substeps", self.substeps, 1, 10_000),
            "inputs": at_least(
                "inputs", count_of(self.input_quantities) if self.inputs is None else self.inputs, 0
            ),
            "constants": checked_constants(self.constants),
        }
        sizes = {"operating_state": n, "operating_input": checked["inputs"], "state_low": n, "state_high": n}
        for name, size in sizes.items():
            if getattr(self, name) is not None:
                checked[name] = vector(name, getattr(self, name), size)
        if self.analytic:
            checked["transition_jacobian"] = self._exact("transition", n, n, "u, c")
            checked["observe_jacobian"] = self._exact("observe", len(checked["measurement_noise_cov"]), n, "c")
        checked["states"] = quantities("states", self.states, n, "x", "prior_mean")
        inputs = quantities("input_quantities", self.input_quantities, checked["inputs"], "u", "inputs, or b,")
        checked["input_quantities"] = inputs
        checked["measurements"] = quantities("measurements", self.measurements, m, "z", "measurement_noise_cov")
        checked["outputs"] = outputs(self.outputs)
        if self.positions is not None:
            checked["positions"] = Positions(*self.positions).checked(n, m)
        checked["bounds"] = checked_bounds(self.bounds, checked["states"])
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
    def m(self) -> int:
        """Number of measurements."""
        return len(self.measurement_noise_cov)

    @property
    def shape(self) -> Shape:
        """Sizes of the model, and other data needed to compile its code."""
        states, channels = (
            tuple(quantity.angle for quantity in part) for part in (self.states, self.measurements)
        )
        return Shape(self.n, self.m, self.inputs, constants_form(self.constants), states, channels)

    @property
    def functions(self) -> Functions:
        """The model's functions, ready for compiled code: large results are always arrays."""
        n, m, slopes = self.n, self.m, first_equal((self.transition_jacobian, self.observe_jacobian))
        form, sizes = self.shape.form, (n, self.inputs, len(self.constants))

        def ready(function: Callable | None, arguments: str, *shape: int) -> Any:
            if function is None or by_complex_step(function):
                return function
            if is_array(max(sizes[:2])) or is_array(*shape) or constants_are_array(form):
                return array_valued(with_python_floats(function), arguments, *shape)
            of = sizes if "u" in arguments else (n, sizes[2])
            return array_valued(with_python_floats(function, arguments, of, form, shape), arguments, *shape)

        return Functions(
            ready(first_equal(self.transition), "x, u, c", n),
            ready(slopes[0], "x, u, c", n, n),
            ready(first_equal(self.observe), "x, c", m),
            ready(slopes[1], "x, c", m, n),
        )

    @property
    def given_constants(self) -> tuple | np.ndarray:
        """The constants as functions get them: an array if there are too many for a tuple."""
        return np.array(self.constants) if constants_are_array(self.shape.form) else self.constants

    def replace(self, **changes) -> Self:
        """A copy of the model with some fields changed; ValueError as for a new model."""
        if (
            changes.keys() <= NOISE
            and not self._has_more
            and _channels(changes.get("measurement_noise_cov", self.measurement_noise_cov)) == self.m
        ):
            return self._with_noise(changes)
        return dataclasses.replace(self, **changes)

    @property
    def _has_more(self) -> bool:
        """Whether a subclass checks or keeps more than the fields: it may depend on covariances, too."""
        names = {attribute.name for attribute in dataclasses.fields(self)} | {"digest"}
        return type(self).__post_init__ is not StateSpaceModel.__post_init__ or not vars(self).keys() <= names

    def _with_noise(self, changes: Mapping[str, Any]) -> Self:
        """`replace` of covariances; no function depends on them, so none is tried again."""
        model = object.__new__(type(self))
        for attribute in dataclasses.fields(self):
            value = getattr(self, attribute.name)  # arrays and outputs could be changed: each model has its own
            copied = value.copy() if isinstance(value, np.ndarray | dict) else value
            object.__setattr__(model, attribute.name, copied)
        for name, value in changes.items():
            measured = name == "measurement_noise_cov"
            size = self.m if measured else self.n
            object.__setattr__(model, name, covariance(name, value, size, positive_definite=measured))
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
        matrices = (
            self.process_noise_cov,
            covariance_root(self.process_noise_cov),
            self.measurement_noise_cov,
            covariance_root(self.measurement_noise_cov),
            self.prior_mean,
            self.prior_cov,
            covariance_root(self.prior_cov),
            self.scales,
            [self.substeps],
            list(self.constants),
        )
        return np.concatenate([np.ravel(np.asarray(a, dtype=np.float64)) for a in matrices])

    @property
    def scales(self) -> np.ndarray:
        """Scale of each state for the steps of central differences, (n,): see `state_scales`."""
        return scales_of(self)


def _channels(r) -> int:
    """Number m of measurements for which a measurement noise covariance is given: of a plain number one."""
    return len(r) if isinstance(r, (list, tuple, np.ndarray)) and np.ndim(r) else 1
