"""A filter over many trajectories in one compiled call that uses all cores."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from filters.engine.belief import Kernels, restart_if_lost, vector_like
from filters.engine.compile import (
    PREDICT,
    START,
    UPDATE,
    batch,
    batch_memory,
    build_operation,
    new_memory,
    row_length,
)
from filters.estimators.foreign import ForeignFilter
from filters.filter import Filter
from thruster_env.core.checks import as_floats, covariance, short_repr
from thruster_env.core.compiled import is_interpreting
from thruster_env.core.parallel import spread
from thruster_env.core.streams import filter_keys
from thruster_env.logs.grid import count_steps, resolution_of, resolution_of_digits
from thruster_env.logs.log import in_any_steps
from thruster_env.logs.table import refuse_holes, refuse_swapped, times_of_index
from thruster_env.model.continuous import SAME_DT, same_dt
from thruster_env.model.shape import LANES, with_root
from thruster_env.model.state_space import StateSpaceModel

if TYPE_CHECKING:
    from thruster_env.graphs.workers import InParts


BY_NAME = "run(filter_, z) alone, run(filter_, inputs=u, measurements=z) with inputs"


class Estimates(NamedTuple):
    """A filter's output over a batch of B trajectories of K steps; index 0 is after the first measurement.

    Attributes:
        means: of the states, (B, K + 1, n), in the units of the model.
        covs: covariances of the errors, (B, K + 1, n, n); (B, K + 1, t, t) if the state has rotations.
        innovations: measurements minus their predictions, (B, K + 1, m); zero in missing channels.
        innovation_covs: S, (B, K + 1, m, m).
        log_likelihoods: of the innovations, (B, K + 1).
        divergences: restarts from the prior after an estimate that was not finite, (B,).
    """

    means: np.ndarray
    covs: np.ndarray
    innovations: np.ndarray
    innovation_covs: np.ndarray
    log_likelihoods: np.ndarray
    divergences: np.ndarray

    @property
    def stds(self) -> np.ndarray:
        """Standard deviations of the errors, (B, K + 1, n)."""
        return np.sqrt(np.diagonal(self.covs, axis1=-2, axis2=-1))


def estimates_of(rows: Sequence[tuple], divergences: int) -> Estimates:
    """`Estimates` of one trajectory, from the results of `Session.latest` at each row."""
    parts = [np.array(part)[None] for part in zip(*rows, strict=True)]
    return Estimates._make([*parts, np.array([divergences])])


def run(
    filter_: Filter,
    keys: np.ndarray | None = None,
    inputs: np.ndarray | None = None,
    measurements: np.ndarray | None = None,
    *,
    process_noise_covs: np.ndarray | None = None,
    measurement_noise_covs: np.ndarray | None = None,
    step_filters: Sequence[Filter] | None = None,
) -> Estimates:
    """Filter many trajectories, or one, in one compiled call that uses all cores: `filters.run` on steps of dt.

    `step_filters` are those of each step, (K,), of `Filter.of_length`, in place of the filter.

    Raises:
        ValueError: if shapes do not fit or an input is not finite; errors of `ForeignFilter.fill` for estimators.
    """
    single = is_single(keys, inputs, measurements)
    keys, inputs, z = trajectories(filter_, keys, inputs, measurements)
    (n, t, m), (count, times, _) = (getattr(filter_.kernel_model, name) for name in "ntm"), z.shape
    out = Estimates(
        np.empty((count, times, n)),
        np.empty((count, times, t, t)),
        np.empty((count, times, m)),
        np.empty((count, times, m, m)),
        np.empty((count, times)),
        np.empty(count),
    )
    noise = noise_rows(filter_, times, process_noise_covs, measurement_noise_covs, step_filters)
    if isinstance(filter_, ForeignFilter):
        filter_.fill(keys, inputs, z, tuple(out))
    else:
        _run_compiled(filter_, (keys, inputs, z), noise, out)
    return Estimates(*(part[0] for part in out)) if single else out


def _run_compiled(filter_: Filter, data: tuple, noise: tuple, out: Estimates) -> None:
    kernels, numbers, size = filter_.kernels(), filter_.numbers, filter_.size
    run_part, count, width = batch(kernels), len(out.means), LANES if kernels.vectors else 1

    def part(first: int, last: int) -> None:
        memory = batch_memory(
            kernels, size, data[1].shape[2]
        )  # serves the part's trajectories one after the other
        run_part(*data, numbers.copy(), noise, tuple(out), memory, first * width, min(last * width, count))

    spread(part, -(-count // width))


def trajectories(
    filter_: Filter, keys: np.ndarray | None, inputs: np.ndarray | None, measurements: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The arguments of `run` as the arrays that compiled code takes; ValueError if something is wrong."""
    model = filter_.kernel_model
    if measurements is None and inputs is None:
        keys, measurements = None, keys
    if is_single(None, inputs, measurements):
        measurements, inputs = _as_batch(model, measurements, inputs)
    if measurements is None:
        raise ValueError("measurements must be an array (B, K + 1, m), but got None")
    if inputs is None or keys is None:
        shape = np.shape(measurements)
        count, steps = shape[:2] if len(shape) == 3 else (0, 1)
        inputs = np.zeros((count, steps - 1, 0)) if inputs is None else inputs
        if keys is None:
            draws = filter_.size > 0 or isinstance(filter_, ForeignFilter)
            keys = filter_keys(range(count)).reshape(count, 2) if draws else np.zeros((count, 2))
    arguments = {"keys": keys, "inputs": inputs, "measurements": measurements}
    keys, inputs, z = (
        np.ascontiguousarray(_floats(name, value), dtype=np.float64) for name, value in arguments.items()
    )
    if z.ndim != 3 or inputs.ndim != 3 or keys.shape != (len(z), 2):
        rule = "keys, inputs, measurements must have shapes (B, 2), (B, K, p), (B, K + 1, m)"
        raise ValueError(f"{rule}, but got {keys.shape}, {inputs.shape}, {z.shape}")
    count, times, m = z.shape
    if inputs.shape != (count, times - 1, model.inputs) or m != model.channels:
        shapes = f"{(count, times - 1, model.inputs)} and {(count, times, model.channels)}"
        without = ", because the model has no inputs" if not model.inputs else ""
        rule = f"inputs and measurements must have shapes {shapes}{without}"
        raise ValueError(f"{rule}, but got {inputs.shape} and {z.shape}")
    _check_finite(inputs, z)
    if not ((keys >= 0) & (keys < 2**32) & (keys == np.floor(keys))).all():
        raise ValueError("keys must be whole numbers from 0 to 2^32 - 1, but some are not")
    return keys, inputs, z


def _check_finite(inputs: np.ndarray, z: np.ndarray) -> None:
    """Raise ValueError that names the first input (B, K, p) or measurement (B, K + 1, m) that is not."""
    rule = "inputs must be finite, and measurements finite or NaN"
    for name, values, wrong in (("inputs", inputs, ~np.isfinite(inputs)), ("measurements", z, np.isinf(z))):
        for run, row, channel in np.argwhere(wrong)[:1].tolist():
            where = f"row {row} of {name}" + f", run {run}" * (len(values) > 1)
            raise ValueError(f"{rule}, but {where} has {values[run, row, channel]:g}")


def is_single(keys: Any, inputs: Any, measurements: Any) -> bool:
    """Whether the arguments of `run` are one trajectory without the axis of a batch."""
    values = keys if measurements is None and inputs is None else measurements
    try:
        return np.ndim(values) in (1, 2)
    except ValueError:  # lists of different lengths, which `trajectories` refuses
        return False


def _as_batch(model: StateSpaceModel, measurements: Any, inputs: Any) -> tuple[np.ndarray, np.ndarray | None]:
    """A single trajectory as a batch of one: z (1, K + 1, m), and u (1, K, p) if there are inputs."""
    z = _floats("measurements", measurements)
    z = z[:, None] if z.ndim == 1 else z
    if inputs is None:
        if model.inputs:
            count = f"{model.inputs} input{'s' * (model.inputs > 1)}"
            rule = f"a model with {count} must get {'it' if model.inputs == 1 else 'them'} (inputs=)"
            raise ValueError(f"{rule}, but got measurements alone")
        return z[None], None
    u = _floats("inputs", inputs)
    u = u[:, None] if u.ndim == 1 else u
    if model.feeds and len(u) == len(z):
        raise ValueError(
            "inputs of a model with h(x, u, c) must be one fewer than measurements, as u_k acts until z_{k+1}, "
            f"but got {len(u)} of each: inputs=u[1:] and no first z if u_k was sampled together with z_k"
        )
    return z[None], (u[:-1] if len(u) == len(z) else u)[None]


def _floats(name: str, value) -> np.ndarray:
    try:
        return as_floats(value)
    except ValueError:
        raise ValueError(f"{name} must be an array of numbers, but got {short_repr(value)}") from None


def noise_rows(
    filter_: Filter,
    times: int,
    process_noise_covs: Any,
    measurement_noise_covs: Any,
    step_filters: Sequence[Filter] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Rows (Q, its root) of each step and (R, its root) of each measurement; no rows for the model's Q or R.

    With `step_filters` the rows of steps have all numbers of these. Raises ValueError for matrices that are no
    covariances, for wrong shapes, and if the filter cannot take them.
    """
    filter_.check_noise(process_noise_covs, measurement_noise_covs)
    model = filter_.kernel_model
    qs = _noise_rows("process_noise_covs", process_noise_covs, times - 1, model.t)
    rs = _noise_rows("measurement_noise_covs", measurement_noise_covs, times, model.m)
    if step_filters is None:
        return qs, rs
    each = {id(step_filter): step_filter.numbers for step_filter in step_filters}
    numbers, first = np.array([each[id(step_filter)] for step_filter in step_filters]), model.any_shape.offsets.q
    if len(qs):
        numbers[:, first : first + qs.shape[1]] = qs
    return numbers, rs


def _noise_rows(name: str, covs, count: int, size: int) -> np.ndarray:
    if covs is None:
        return np.empty((0, 2 * size * size))
    covs = _covs_of_rows(name, covs, count, size)
    definite = name.startswith("measurement")
    return np.array([with_root(covariance(name, cov, size, positive_definite=definite)) for cov in covs])


def _covs_of_rows(name: str, covs: Any, count: int, size: int) -> Any:
    """Covariances of so many rows as an array, (count, size, size); None if there are none."""
    covs = None if covs is None else _floats(name, covs)
    if covs is not None and covs.shape != (count, size, size):
        raise ValueError(f"{name} must have shape {(count, size, size)}, but got {covs.shape}")
    return covs


# Steps of any length, as the arguments of a batch.

COARSE = 0.4  # of a sample time: less than half of it, by which a missing row moves stamps


class Prepared(NamedTuple):
    """The arguments of a batch: long steps are divided into rows without a measurement."""

    filter: Filter
    keys: np.ndarray
    inputs: np.ndarray
    measurements: np.ndarray
    process_noise_covs: np.ndarray | None
    measurement_noise_covs: np.ndarray | None
    rows: np.ndarray  # those of the user's measurements
    times: np.ndarray  # of these rows [s]
    is_single: bool = False  # whether the user's trajectory has no axis of a batch
    step_filters: Sequence[Filter] | None = None  # of each step, where they differ in more than a ratio

    @property
    def noise(self) -> dict[str, Any]:
        """Q and filters of the steps and R of the measurements, by the names of `run`."""
        names = "process_noise_covs", "measurement_noise_covs", "step_filters"
        return {name: getattr(self, name) for name in names}


def prepared(
    filter_: Filter,
    keys: Any,
    inputs: Any,
    measurements: Any,
    process_noise_covs: Any = None,
    measurement_noise_covs: Any = None,
    *,
    dt: Any = None,
    noise: Callable[[float], Any] | None = None,
    update_first: bool = True,
) -> Prepared:
    """The arguments of `run` as those of a batch, whose last input is the step ratio where steps differ."""
    _check_filter(filter_)
    if measurements is None and inputs is None:
        keys, measurements = None, keys
    if measurements is None:
        raise ValueError(f"measurements must be an array (B, K + 1, m), but got None: {BY_NAME}")
    refuse_swapped("measurements", measurements, filter_.kernel_model.measurements)
    refuse_swapped("inputs", inputs, filter_.kernel_model.input_quantities)
    by_index = dt is None and hasattr(measurements, "iloc")
    stamps = times_of_index(measurements.index) if by_index else None
    if by_index and stamps is None:
        refuse_holes(measurements.index)
    measurements, inputs = _in_rows(filter_.kernel_model, keys, inputs, measurements)
    if is_single(None, inputs, measurements):
        filter_, inputs = filter_.from_first_input(inputs, len(measurements), update_first)
    else:
        filter_.from_first_input(None, 0, update_first)
    model_dt, fixed = _sample_time(filter_), getattr(filter_.model, "dt", None)
    if stamps is not None and len(stamps) > 1:
        dt = _steps_of(stamps, fixed if model_dt is None else model_dt, update_first)
    of_rows = measurements.shape[measurements.ndim == 3] if measurements.ndim else 0
    r = _covs_of_rows("measurement_noise_covs", measurement_noise_covs, of_rows, filter_.kernel_model.m)
    q = process_noise_covs
    q = _covs_of_rows("process_noise_covs", q, of_rows - update_first, filter_.kernel_model.t)
    if not update_first:  # a row without a measurement before the first one
        if inputs is not None and inputs.shape[-2:] != (of_rows, filter_.kernel_model.inputs):
            rule = f"inputs must have shape {(of_rows, filter_.kernel_model.inputs)}, a row for each measurement"
            raise ValueError(f"{rule} where update_first=False, but got {inputs.shape[-2:]}")
        is_batch = measurements.ndim == 3
        _check_finite(np.zeros(0), measurements if is_batch else measurements.reshape(1, of_rows, -1))
        measurements = np.insert(measurements, 0, np.nan, axis=int(is_batch))
        r = None if r is None else np.concatenate([r[:1], r])
    single = is_single(None, inputs, measurements)
    keys, inputs, z = trajectories(filter_, keys, inputs, measurements)
    rows = np.arange(0 if update_first else 1, z.shape[1])
    usual = fixed if model_dt is None else model_dt
    lengths = _lengths(dt, inputs.shape[1], 1.0 if usual is None else usual)
    times = np.append(0.0, np.cumsum(lengths))
    plain = Prepared(filter_, keys, inputs, z, q, r, rows, times[rows], single)
    if noise is not None and not (callable(noise) and q is None):
        got = "process_noise_covs, too" if callable(noise) else short_repr(noise)
        raise ValueError(
            f"noise must be a function of a step's length, in place of process_noise_covs, but got {got}"
        )
    if dt is None and noise is not None:
        raise ValueError("noise must come with dt, the lengths of the steps, but got noise alone")
    unlike = [
        length
        for length in sorted({*lengths.tolist()})
        if not same_dt(length, lengths[0] if usual is None else usual)
    ]
    if not unlike and noise is None:
        return plain
    same_model = filter_.kernel_model is filter_.model and not isinstance(filter_, ForeignFilter)
    if filter_.by_length and model_dt is None and fixed is None:
        _ = filter_.sample_time  # raises ValueError with the reason
    if model_dt is None or not (filter_.by_length or same_model and type(filter_).any_step):
        rule = "steps of different lengths (dt=), or noise=, must be for a model whose sample time is a constant, "
        rule += f"and a filter that evaluates f(x, u) at each step, but got {filter_.name!r}"
        rule += "" if fixed is None else f" for steps of {fixed:g} s"
        rule += f" and a step of {unlike[0]:g} s" if unlike else ""
        way = "make_filter('ekf', plant.at(dt))"
        if fixed is not None:  # as of `tuning.fit`
            way += " with noise=plant.noise, where plant is fit.plant of a fit of tuning.fit and dt fit.column.dt"
        if stamps is not None:
            way += "; z.asfreq(...) puts NaN in missing rows, z.to_numpy() leaves the index out"
        raise ValueError(f"{rule}: {way}")
    exact = resolution_of(float(times[-1]), 0.0)
    counts = np.array([count_steps(length, model_dt, exact) for length in lengths.tolist()], dtype=int)
    parts = np.repeat(lengths / counts, counts)
    user_rows = np.append(0, np.cumsum(counts))
    long_z = np.full((len(z), len(parts) + 1, z.shape[2]), np.nan)
    long_z[:, user_rows] = z
    if noise is not None:
        of_length = {length: as_floats(noise(length)) for length in np.unique(parts).tolist()}
        q = np.array([of_length[length] for length in parts.tolist()])
    elif q is not None:  # of a whole step, of which each part has its share
        q = np.repeat(q / counts[:, None, None], counts, axis=0)
    if r is not None:
        r = r[np.searchsorted(user_rows, np.arange(len(parts) + 1))]
    long_u, of_user = np.repeat(inputs, counts, axis=1), (user_rows[rows], times[rows], single)
    if filter_.by_length:
        known = {text: filter_.of_length(float(text)) for text in {f"{part:.12g}" for part in parts.tolist()}}
        step_filters = [known[f"{part:.12g}"] for part in parts.tolist()]
        return Prepared(filter_, keys, long_u, long_z, q, r, *of_user, step_filters)
    if q is not None:  # which the page multiplies by the ratio
        q *= (model_dt / parts)[:, None, None]
    ratios = np.broadcast_to((parts / model_dt)[None, :, None], (len(z), len(parts), 1))
    any_step = replace(filter_, model=in_any_steps(filter_.model))
    return Prepared(any_step, keys, np.concatenate([long_u, ratios], axis=2), long_z, q, r, *of_user)


def _check_filter(filter_: Any) -> None:
    """Raise ValueError for a model, a name or a result in the place of a filter."""
    if isinstance(filter_, Filter):
        return
    way = "filters.make_filter('ekf', model) makes one"
    if isinstance(getattr(filter_, "filter", None), Filter):
        way = "use its .filter"
    elif isinstance(filter_, StateSpaceModel):
        way = "filters.make_filter('ekf', model) makes one of it"
    raise ValueError(f"filter_ must be a filter, but got {short_repr(filter_)}: {way}")


def _in_rows(model: StateSpaceModel, keys: Any, inputs: Any, measurements: Any) -> tuple[np.ndarray, Any]:
    """Measurements and inputs as arrays, those of one trajectory without further axes, as FilterPy's columns."""
    z, u = _floats("measurements", measurements), None if inputs is None else _floats("inputs", inputs)
    if not z.size and (z.ndim < 3 or not z.shape[1]):  # a batch without runs has rows
        raise ValueError(f"measurements must have at least one row, but got {short_repr(measurements)}")
    no_batch = keys is None and (u is None or u.ndim < 3 or u.shape[1:] == (model.inputs, 1))
    m = model.channels
    if z.ndim == 3 and z.shape[1:] == (m, 1) and len(z) > 1 and (no_batch or m > 1):
        z = z[:, :, 0]  # rows of columns (m, 1)
    if z.ndim == 2 and z.shape[1] != m:
        rule = f"measurements of one trajectory must have shape (K + 1, {m})"
        way = f": z[..., None] for {len(z)} trajectories" if m == 1 and z.shape[0] < z.shape[1] else ""
        way = ": z.T" if len(z) == m else way
        raise ValueError(f"{rule}, but got {z.shape}{way}")
    if u is not None and not u.ndim and z.ndim:
        shape = (*z.shape[:-2], z.shape[-2 if z.ndim == 3 else 0] - 1, model.inputs)
        raise ValueError(f"inputs must have shape {shape}, but got a number: np.full({shape}, {u:g}) is constant")
    if z.ndim < 3 and u is not None:
        if u.ndim == 3 and u.shape[1:] == (model.inputs, 1):
            u = u[:, :, 0]
        u = u[:, None] if u.ndim == 1 else u
    return z, u


def _steps_of(times: np.ndarray, usual: float | None, update_first: bool) -> np.ndarray:
    """Lengths of the steps between times [s]; equal but for the rounding of times they are equal."""
    steps = np.diff(times)
    if not (steps > 0.0).all():
        row = int(np.argmin(steps > 0.0)) + 1
        raise ValueError(f"times of the index must increase, but row {row} comes {steps[row - 1]:g} s later")
    since, count = times - times[0], len(steps)
    mean = float(since[-1]) / count
    rounding = 2.0 * resolution_of_digits(times, mean)  # of a stamp and of the ends
    if rounding > COARSE * mean:  # digits that say nothing
        rounding = 2.0 * (resolution_of(float(np.abs(times).max())) + SAME_DT * mean)
    if (np.abs(since - mean * np.arange(count + 1)) <= rounding).all():
        is_usual = usual is not None and abs(usual - mean) <= SAME_DT * usual + rounding / count
        steps = np.full(count, usual if is_usual else mean)
    return steps if update_first else np.append(float(np.median(steps)), steps)


def _sample_time(filter_: Filter) -> float | None:
    """The sample time of a filter in whose model it is a constant [s], else None."""
    try:
        return filter_.sample_time
    except ValueError:
        return None


def _lengths(dt: Any, steps: int, default: float) -> np.ndarray:
    """The lengths of all steps [s], (steps,)."""
    lengths = as_floats(default if dt is None else dt)
    if lengths.shape not in ((), (steps,)) or not (np.isfinite(lengths) & (lengths > 0.0)).all():
        rule = f"dt must be the length of each step, or of {steps} steps, positive and finite"
        raise ValueError(f"{rule}, but got {short_repr(dt)}")
    return np.broadcast_to(lengths, steps).copy()


# Batch session: one belief for each copy of a vector env, all advanced in place by one compiled call.

THREADED_COPIES = 256  # one thread runs fewer copies before a second one has woken up
IDLE, STEP, BEGIN = 0, PREDICT + UPDATE, START + UPDATE  # the task of a copy in a call


class Beliefs:
    """One filter on N copies, each with its own belief."""

    def __init__(self, filter_: Filter, count: int):
        """Allocate the memory of `count` beliefs; `start` comes next."""
        self._filter = filter_
        self._kernels, self._size, self._numbers = filter_.kernels(), filter_.size, filter_.numbers
        self._places = self._kernels.layout
        row, *of_thread = new_memory(self._kernels, self._size)
        self._rows = np.zeros((count, len(row)))
        self._tables = np.zeros((count, self._kernels.kept_rows, of_thread[0].shape[1]))
        self._u = np.zeros((count, filter_.kernel_model.inputs))
        self._z = np.zeros((count, self._kernels.channels))
        operation = _operation(self._kernels, self._u.shape[1], is_interpreting())
        beliefs = self._rows, self._tables, self._u, self._z, self._numbers
        parts = -(-count // LANES) if self._kernels.vectors else count
        self._operate = operation.on(parts, (*of_thread, self._size, *beliefs), (count,))

    def __getstate__(self) -> tuple:
        """The filter and the beliefs; machine code is looked up again."""
        return self._filter, self._rows, self._tables

    def __setstate__(self, state: tuple) -> None:
        filter_, rows, tables = state
        type(self).__init__(self, filter_, len(rows))
        self._rows[:], self._tables[:] = rows, tables

    def start(self, which: np.ndarray, keys: np.ndarray, z: np.ndarray) -> None:
        """Set the prior in some copies with keys (len(which), 2), and update it with measurements z (N, m)."""
        if len(which) == len(self._rows) and self._filter.kernel_model.reads_from_outside:
            if self._filter.kernels() is not self._kernels:  # which has other functions now
                type(self).__init__(self, self._filter, len(self._rows))
        self._rows[which, self._places.key_0] = keys[:, 0]
        self._rows[which, self._places.key_1] = keys[:, 1]
        tasks = np.full(len(self._rows), float(IDLE))
        tasks[which] = BEGIN
        self._do(tasks, self._u, z)

    def step(self, u: np.ndarray, z: np.ndarray, idle: np.ndarray | None = None) -> None:
        """Predict with inputs u (N, p), then update with measurements z (N, m); NaN marks a missing channel."""
        tasks = np.full(len(self._rows), float(STEP))
        if idle is not None:
            tasks[idle] = IDLE
        self._do(tasks, u, z)

    def _do(self, tasks: np.ndarray, u: np.ndarray, z: np.ndarray) -> None:
        self._u[:], self._z[:] = u, z
        at_work, predicts = tasks != IDLE, tasks == STEP
        wrong = np.isinf(self._z).any(1) & at_work | ~np.isfinite(self._u).all(1) & predicts
        if wrong.any():
            i = int(np.argmax(wrong))
            if predicts[i]:
                vector_like(f"u of copy {i}", self._u[i], self._u[i], missing_allowed=False)
            vector_like(f"z of copy {i}", self._z[i], self._z[i], missing_allowed=True)
        self._operate(tasks)

    def part(self, name: str, *shape: int) -> np.ndarray:
        """A copy of a part of all memories, such as "mean": (N, *shape)."""
        first = getattr(self._places, name)
        values = self._rows[:, first : first + int(np.prod(shape, dtype=int))]
        return values.reshape(len(values), *shape).copy()


@lru_cache(maxsize=128)
def _operation(kernels: Kernels, inputs: int, interpreting: bool) -> InParts:
    from thruster_env.graphs.workers import InParts

    length, kept_rows, m, p = row_length(kernels), kernels.kept_rows, kernels.channels, inputs
    operate = build_operation(kernels)

    def operate_many(first, last, table_like, draws_like, size, rows, tables, us, zs, numbers, tasks):
        table, draws, values = np.zeros(table_like.shape), np.zeros(draws_like.shape), np.zeros(p + m)
        for b in range(first, last):
            task = int(tasks[b])
            if task == IDLE:
                continue
            if task == STEP:
                for i in range(kept_rows):
                    for j in range(tables.shape[2]):
                        table[i, j] = tables[b, i, j]
            for i in range(p):
                values[i] = us[b, i]
            for i in range(m):
                values[p + i] = zs[b, i]
            operate(rows[b], table, draws, size, values, numbers, task)
            for i in range(kept_rows):
                for j in range(tables.shape[2]):
                    tables[b, i, j] = table[i, j]

    shapes = (
        (kernels.table_rows, None),
        (None,),
        None,
        (None, length),
        (None, None, None),
        (None, p),
        (None, m),
        (None,),
        (None,),
    )
    if kernels.vectors:
        return InParts(_groups(kernels, p), shapes, few=THREADED_COPIES // LANES)
    return InParts(operate_many, shapes, few=THREADED_COPIES)


def _groups(kernels: Kernels, p: int) -> Callable:
    """`operate_many` for eight copies side by side, some of them idle, with the numbers of a batch."""
    start, restart, (begin, advance, finish, update) = kernels.start, restart_if_lost(kernels), kernels.vectors
    length, m, substeps = row_length(kernels), kernels.channels, kernels.offsets.substeps
    step, divergences = kernels.layout.step, kernels.layout.divergences

    def operate_groups(first, last, table_like, draws_like, size, rows, tables, us, zs, numbers, tasks):
        row, u, z = np.zeros(length * LANES), np.zeros(p * LANES), np.zeros(m * LANES)
        for g in range(first, last):
            used, steps, begins = min(LANES, rows.shape[0] - g * LANES), 0, 0
            for j in range(LANES):
                b = g * LANES + min(j, used - 1)
                steps += int(tasks[b] == STEP)
                begins += int(tasks[b] == BEGIN)
                for i in range(length):
                    row[i * LANES + j] = rows[b, i]
                for i in range(p):
                    u[i * LANES + j] = us[b, i]
                for i in range(m):
                    z[i * LANES + j] = zs[b, i]
            if steps > 0:
                begin(row, u, numbers)
                for _ in range(int(numbers[substeps])):
                    advance(row, u, numbers)
                finish(row, u, numbers)
            if begins > 0:
                for j in range(used):
                    if tasks[g * LANES + j] == BEGIN:
                        belief = rows[g * LANES + j]
                        belief[step] = belief[divergences] = 0.0
                        start((belief, None, None), numbers, 0)
                        for i in range(length):
                            row[i * LANES + j] = belief[i]
            if steps + begins > 0:
                update(row, z, numbers)
                for j in range(used):
                    if tasks[g * LANES + j] != IDLE:
                        estimate = rows[g * LANES + j]
                        for i in range(length):
                            estimate[i] = row[i * LANES + j]
                        estimate[step] += float(tasks[g * LANES + j] == STEP)
                        restart((estimate, None, None), numbers, 0)

    return operate_groups
