"""Envs of any model: `ModelEnv`, whose plant it is, with its vector form, and `ReplayEnv` of a log."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import gymnasium as gym
import numpy as np

from thruster_env.core.checks import one_of, positive, short_repr
from thruster_env.core.checks import seed as checked_seed
from thruster_env.core.modules import error_line, object_named
from thruster_env.core.sources import is_array, tuple_of, written_out
from thruster_env.core.streams import INITIAL, MEASUREMENT, PROCESS
from thruster_env.effects.effects import (
    SPACING,
    ConstantSignal,
    Context,
    Effect,
    GaussMarkov,
    Gusts,
    Moment,
    RecordedSignal,
    Registry,
    Sinusoid,
    WithoutStep,
    chain_of,
    chain_runner,
)
from thruster_env.effects.effects import dropping_channels as losing
from thruster_env.effects.sensors import SENSOR_EFFECTS, Reading
from thruster_env.env.copies import Page, clipped, correlated, root_of
from thruster_env.env.env import PlantEnv, PlantVectorEnv
from thruster_env.env.plant_data import some_numbers
from thruster_env.graphs.tracing import traced
from thruster_env.graphs.values import traceable
from thruster_env.logs.log import Log, sample_time_of, seen_by
from thruster_env.logs.read import read_log
from thruster_env.model.continuous import ContinuousModel, continuous_of, in_discrete_time
from thruster_env.model.quantities import Quantity
from thruster_env.model.shape import Functions, Shape, constants_are_array
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.traced import TracedFunction, traced_function
from thruster_env.model.turns import move

DISTURBANCES = Registry(
    "disturbances",
    {
        "constant": ConstantSignal,
        "sinusoid": Sinusoid,
        "gauss-markov": GaussMarkov,
        "gusts": Gusts,
        "recorded": RecordedSignal,
    },
)
Part = tuple[Callable, tuple[int, ...], Any, int]  # a function, sizes of arguments, form of constants, results


class ModelPlant(NamedTuple):
    """A state-space model as the plant of an env; `ModelEnv` has the words for its parts."""

    truth: StateSpaceModel
    dt: float  # 1 if it is unknown
    low: np.ndarray
    high: np.ndarray
    sensors: dict[str, tuple[Effect, ...]]
    disturbances: dict[str, tuple[Effect, ...]]


class ModelTask(NamedTuple):
    """The reward and the end of an episode; None for 0 and never."""

    reward: Callable | None
    ends: Callable | None


class Parameters(NamedTuple):
    """The numbers that a step reads."""

    dt: float
    constants: Any
    table: Any  # the same where f or h is called, else None
    low: Any
    high: Any
    prior_mean: Any
    prior_root: Any
    q_root: Any
    r_root: Any
    effects: Any  # parameters of the effects by chain


@lru_cache(maxsize=64)
def _traced(function: Callable, sizes: tuple[int, ...], form: type | int, count: int) -> TracedFunction | None:
    """The graph of a function of vectors and constants with `count` results; None if it can only be called."""
    try:
        return traced_function(function, sizes, form, (count,))
    except Exception:  # whatever a user's function raises if it gets Numbers
        return None


@lru_cache(maxsize=64)
def _called(function: Callable, sizes: tuple[int, ...], form: type | int, count: int) -> Callable:
    """The function of a table of constants and vectors, called for each copy: work(given, found, numbers)."""
    lines, at = ["first = int(given[0])"], 1
    for i, size in enumerate(sizes[:-1]):
        entries = tuple_of(f"given[{at + k}]" for k in range(size))
        lines.append(f"v{i} = given[{at}:{at + size}]" if is_array(size) else f"v{i} = {entries}")
        at += size
    values = [f"numbers[first + {k}]" for k in range(sizes[-1])]
    if constants_are_array(form):
        lines.append(f"c = numbers[first : first + {sizes[-1]}]")
    else:
        lines.append(f"c = {tuple_of(values)}" if isinstance(form, int) else f"c = Constants({', '.join(values)})")
    lines.append(f"y = function({', '.join(f'v{i}' for i in range(len(sizes) - 1))}, c)")
    lines += [f"found[{k}] = y[{k}]" for k in range(count)]
    return written_out("call", "given, found, numbers", *lines, "None", function=function, Constants=form)


@lru_cache(maxsize=64)
def model_page(functions: Functions, shape: Shape, substeps: int, kinds: tuple, task: ModelTask) -> Page:
    """The page of a model: its f and h, traced or called, its noise, disturbances and task."""
    n, channels = shape.n, shape.channels
    of_f, of_h = _parts(functions, shape)
    f, h, call_f, call_h = _traced(*of_f), _traced(*of_h), _called(*of_f), _called(*of_h)
    act, advance = chain_runner(dict(kinds)), traced(move) if shape.turns or shape.measured_turns else move

    def evaluated(function: TracedFunction | None, call: Callable, count: int, p: Any, *vectors) -> tuple:
        if function is None:
            return tuple(p.table.call(call, count, *(entry for vector in vectors for entry in vector)))
        return tuple(function(*(np.array(vector, dtype=object) for vector in (*vectors, p.constants))).tolist())

    def disturbed(p: Parameters, u: Sequence, effects: dict | None, t: Moment) -> tuple[tuple, dict]:
        """The inputs with their disturbances."""
        parts = [act(f"input {i}", p, value, effects, t) for i, value in enumerate(u)]
        return tuple(value for value, _ in parts), {k: v for _, memory in parts for k, v in memory.items()}

    def observed(p: Parameters, x: tuple, u: tuple, v: tuple, effects: dict | None, memories: dict, t: Moment):
        exact = evaluated(h, call_h, channels, p, *((x, v) if shape.feeds else (x,)))
        noise, readings = correlated(p.r_root, t.draws.normals(MEASUREMENT, shape.m)), list[Reading]()
        for i, z in enumerate(advance(exact, noise, shape.measured_turns)):
            reading, memory = act(f"sensor {i}", p, Reading(z, 1.0), effects, t._replace(state=x))
            readings, memories = [*readings, reading], memories | memory
        ends = traceable(task.ends)(x) if task.ends and not t.begin else 0.0
        report = {
            "reward": traceable(task.reward)(x, u) if task.reward and not t.begin else 0.0,
            "terminated": ends,
            "time": t.step * p.dt,
            "state": x,
            "measurement": tuple(reading.z for reading in readings),
            "valid": tuple(reading.valid for reading in readings),
        }
        return (x, memories), report

    def begin(p: Parameters, t: Moment) -> tuple[Any, dict]:
        x = tuple(advance(p.prior_mean, correlated(p.prior_root, t.draws.normals(INITIAL, shape.t)), shape.turns))
        u, memories = disturbed(p, (0.0,) * shape.inputs, None, t)
        return observed(p, x, u, u, None, memories, t)

    def step(p: Parameters, memory: Any, action: tuple, t: Moment) -> tuple[Any, dict]:
        x, effects = memory
        bounds = zip(action, p.low, p.high, strict=True)
        u = tuple(clipped(value, low, high) for value, low, high in bounds)
        v, memories = disturbed(p, u, effects, t._replace(state=x))

        def body(x: tuple, inputs: tuple) -> tuple:
            return evaluated(f, call_f, n, p, x, inputs)

        noise = correlated(p.q_root, t.draws.normals(PROCESS, shape.t))
        x = tuple(advance(t.repeat(substeps, body, x, v), noise, shape.turns))
        return observed(p, x, u, v, effects, memories, t)

    return Page(begin, step, shape.inputs)


def _parts(functions: Functions, shape: Shape) -> tuple[Part, Part]:
    """The functions f and h, with the sizes of their arguments, form of constants and number of results."""
    n, p, m, c = shape.n, shape.inputs, shape.channels, shape.constants
    sizes = (n, p, c) if shape.feeds else (n, c)
    return (functions.transition, (n, p, c), shape.form, n), (functions.observe, sizes, shape.form, m)


def page_of(plant: ModelPlant, task: ModelTask) -> tuple[Page, Parameters]:
    """The page of a model with a task, and its parameters."""
    truth, context = plant.truth, Context(plant.dt)
    signals = [plant.disturbances.get(quantity.symbol, ()) for quantity in truth.input_quantities]
    effects = [plant.sensors.get(quantity.symbol, ()) for quantity in truth.measurements]
    chains = {f"input {i}": chain_of(chain, context, i * SPACING) for i, chain in enumerate(signals)}
    first = len(signals)
    chains |= {f"sensor {i}": chain_of(chain, context, (first + i) * SPACING) for i, chain in enumerate(effects)}
    is_traced = all(_traced(*part) for part in _parts(truth.functions, truth.any_shape))
    parameters = Parameters(
        plant.dt,
        tuple(truth.constants),
        None if is_traced else np.array([*truth.constants, 0.0], dtype=np.float64),  # never without numbers
        tuple(plant.low),
        tuple(plant.high),
        tuple(truth.prior_mean),
        root_of(truth.prior_cov),
        root_of(truth.process_noise_cov),
        root_of(truth.measurement_noise_cov),
        {name: parameters for name, (_, parameters) in chains.items()},
    )
    kinds = tuple((name, kinds) for name, (kinds, _) in chains.items())
    return model_page(truth.functions, truth.any_shape, truth.substeps, kinds, task), parameters


class ModelEnv(PlantEnv):
    """A state-space model as an env: the action is its input, the observation its measurement.

        x_{k+1} = f(x_k, u_k + d_k) + w,  w ~ N(0, Q);   z_k = sensors(h(x_k) + v),  v ~ N(0, R)

    If h takes the input, z_{k+1} = sensors(h(x_{k+1}, u_k + d_k) + v): the action acts until the end of its step.
    The first episode after `reset(seed=s)` is, to rounding, the trajectory that
    `thruster_env.model.simulate.simulate` draws for the key of seed s under the same inputs, and the data of that
    seed in a tuning problem of the same model.
    `info` holds "state" (n,) and "measurement" (m,) in float64, "time" [s] if dt is known, and "measurement_valid"
    (m,) if a measurement may be missing. `ModelVectorEnv` is the same for many copies at once.

    Args:
        truth: the model that generates states and measurements.
        assumed: the model that filters assume, returned by `state_space_model`: a model, or a function that makes
            one from changes by name; the truth if None.
        low: smallest input, one number or p, in the units of the inputs.
        high: largest input, one number or p.
        dt: sample time [s], compared with that of tuned files, and that of signals; None if unknown. Covariances
            are per step and do not scale with dt.
        sensors: lists of sensor effects by the symbol of a measurement, such as
            {"p": [{"name": "outliers", "std": 1.0}]}; see `thruster_env.effects.sensors`.
        disturbances: lists of signals by the symbol of an input, to which they add; see DISTURBANCES.
        reward: `reward(x, u)` after a step, of tuples; 0 if None. It is a function of numbers, as f is.
        ends: `ends(x)`, a condition for the end of an episode; never if None.

    Raises:
        ValueError: if the truth is not a model, or another argument is wrong.
    """

    metadata: dict[str, Any] = {"render_modes": []}
    observation_type = np.float64
    page_of = staticmethod(page_of)

    def __init__(
        self,
        truth: StateSpaceModel,
        assumed: StateSpaceModel | Callable[..., StateSpaceModel] | None = None,
        *,
        low=-np.inf,
        high=np.inf,
        dt: float | None = None,
        sensors: Mapping | None = None,
        disturbances: Mapping | None = None,
        reward: Callable | None = None,
        ends: Callable | None = None,
    ):
        """Make spaces and memory; see the class for the arguments."""
        if not isinstance(truth, StateSpaceModel):
            raise ValueError(f"the truth of an env must be a StateSpaceModel, but it is {short_repr(truth)}")
        self.truth, self.dt = truth, None if dt is None else positive("dt", dt)
        assumed = truth if assumed is None else assumed
        self.state_space_model = partial(with_noise, assumed) if isinstance(assumed, StateSpaceModel) else assumed
        low, high = _bounds(low, high, truth.inputs)
        self.inputs, self.task = truth.input_quantities, ModelTask(reward, ends)
        effects = _chains("sensors", sensors, truth.measurements, SENSOR_EFFECTS)
        signals = _chains("disturbances", disturbances, truth.input_quantities, DISTURBANCES)
        if self.dt is None:
            for effect in (effect for part in (*effects.values(), *signals.values()) for effect in part):
                effect.parameters(WithoutStep(1.0))  # ValueError if they depend on the sample time
        self.plant = ModelPlant(truth, self.dt or 1.0, low, high, effects, signals)
        info = ("state", "measurement") + ("time",) * (self.dt is not None)
        chains = {quantity.symbol: effects.get(quantity.symbol, ()) for quantity in truth.measurements}
        self._set_up(gym.spaces.Box(low, high, dtype=np.float64), info, (), losing(chains))


def _chains(
    name: str, effects: Mapping | None, quantities: Sequence[Quantity], registry: Registry
) -> dict[str, tuple[Effect, ...]]:
    """Effects by the symbol of a quantity."""
    symbols = tuple(quantity.symbol for quantity in quantities)
    return {
        one_of(f"a name in {name}", symbol, symbols): registry.make(chain)
        for symbol, chain in (effects or {}).items()
    }


class ModelVectorEnv(PlantVectorEnv):
    """Many copies of a model in one compiled step; arguments are those of `PlantVectorEnv` and of `ModelEnv`.

    A problem's or an env's model becomes one by `ModelVectorEnv(8192, truth=model, low=-5.0, high=5.0)`.
    """

    single_env: ClassVar[type[ModelEnv]] = ModelEnv
    offers = ("state_space_model",)
    state_space_model: Callable[..., StateSpaceModel]


def with_noise(
    model: StateSpaceModel,
    *,
    process_noise_cov=None,
    measurement_noise_cov=None,
    prior_cov_factor: float | None = None,
) -> StateSpaceModel:
    """A model with another Q or R, and with P_0 multiplied by a factor, if given."""
    changes = {"process_noise_cov": process_noise_cov, "measurement_noise_cov": measurement_noise_cov}
    if prior_cov_factor is not None:
        changes["prior_cov"] = positive("prior_cov_factor", prior_cov_factor) * model.prior_cov
    return model.replace(**{name: value for name, value in changes.items() if value is not None})


def _bounds(low, high, count: int) -> tuple[np.ndarray, np.ndarray]:
    try:
        low, high = (
            np.array(np.broadcast_to(np.asarray(bound, dtype=np.float64), count)) for bound in (low, high)
        )
    except (TypeError, ValueError):
        low, high = np.full(1, np.nan), np.zeros(1)
    if not (low <= high).all():
        raise ValueError(f"low and high must be one number or {count}, low at most high, but they are not")
    return low, high


class ModelledEnv:
    """An env with a `plant`, which offers the plant's model to filters.

    Attributes:
        plant_name: the plant's name in messages.
    """

    plant_name: ClassVar[str] = "a plant"
    plant: Any

    def model_maker(self) -> Callable[..., StateSpaceModel]:
        """The function that makes a model of the plant and of changes by name."""
        raise NotImplementedError

    def tuned_differences(self, tuned_for: Mapping, file: str) -> list[str]:
        """Minor differences between a tuned file's plant and the env's; ValueError for essential ones.

        None by default: states, inputs, sensors and dt are compared for every model.
        """
        return []

    def state_space_model(self, **changes) -> StateSpaceModel:
        """The model of the env's plant, exact unless changed; changes are arguments of its `model_maker`.

        Raises ValueError if an argument is wrong; the message states the rule and the value.
        """
        make = self.model_maker()
        known = list(inspect.signature(make).parameters)[1:]
        unknown = sorted(set(changes) - set(known))
        if unknown:
            rule = f"arguments of {self.plant_name}'s model must be among {', '.join(known)}"
            raise ValueError(f"{rule}, but got {', '.join(map(repr, unknown))}")
        return make(self.plant, **changes)

    def check_tuned_for(self, tuned_for: Mapping | None, file: str) -> None:
        """Raise ValueError if a tuned file is for another plant than the env's; warn if it is for other noise.

        A file without this entry (None) is not compared.
        """
        if tuned_for is not None:
            differences = self.tuned_differences(tuned_for, file)
            if differences:
                warnings.warn(f"{file} was tuned for {', '.join(differences)}", stacklevel=5)


def remembered(state, episode_start, at_start: np.ndarray) -> np.ndarray:
    """The state (..., k) of the last call, or its initial value at the start of an episode."""
    if state is None:
        return at_start
    if episode_start is None:
        return np.asarray(state)
    starts = np.reshape(episode_start, at_start.shape[:-1]).astype(bool)
    return np.where(starts[..., None], at_start, state)


class Split(NamedTuple):
    """Indices of an env's channels that are inputs of a model, and of those that are measurements.

    Attributes:
        inputs: channels of the model's last inputs, in their order.
        measurements: channels of its measurements.
        channels: number of the env's channels.
    """

    inputs: tuple[int, ...]
    measurements: tuple[int, ...]
    channels: int


def split(model: StateSpaceModel, actions: int, channels: Sequence[str]) -> Split | None:
    """Find a model's inputs beyond the first `actions`, and its measurements, among channels by their symbols.

    None if there are no such inputs, or if one of them is no channel.
    """
    inputs = [quantity.symbol for quantity in model.input_quantities[actions:]]
    measurements = [quantity.symbol for quantity in model.measurements]
    if not inputs or not set(inputs + measurements) <= set(channels):
        return None
    return Split(tuple(map(channels.index, inputs)), tuple(map(channels.index, measurements)), len(channels))


ANY_DT = 0.01  # [s], of a model that is asked for its quantities before the sample time of the log is known
OTHER_DT = 0.01  # of a log's sample time, by which that of its model may differ


class ReplayEnv(gym.Env):
    """A log as an env: step k returns the measurement of row k for any action; an episode is the whole log.

    The inputs come from the log, too: `info["recorded_input"]` (p,) is the input of the step, and filter wrappers
    predict with it instead of the action. For a missing measurement, the observation repeats the last value
    (0 at first), and `info["measurement_valid"]` is false. `info["references"]` holds the values of the
    reference channels in the row. The reward is 0.

    Args:
        log: a `Log`, or the path of a file that `thruster_env.logs.read.read_log` reads.
        model: defines the log's columns and is the `state_space_model` offered to filters: a `StateSpaceModel`; a
            function that makes one, for the log's sample time if it has an argument `dt`; a `ContinuousModel`, or
            a function that makes one, at that sample time; an object that offers `state_space_model`, such as an
            env; or "module:object" for any of these.
        columns: headers by quantity, as `read_log` takes them.
        clock_offset: clock offsets [s] by quantity, as `read_log` takes them.
        dt: sample time [s], as `read_log` takes it.
        grid: as `read_log` takes it; a log on its own stamps cannot be replayed.
        stamps: as `read_log` takes it.

    Raises:
        ValueError: if the file cannot be used, or the model is not one or does not fit the log.
    """

    metadata = {"render_modes": []}

    def __init__(
        self,
        log: Log | str | Path,
        model,
        *,
        columns: Mapping[str, str] | None = None,
        clock_offset: Mapping[str, float] | None = None,
        dt: float | None = None,
        grid: bool = True,
        stamps: str | None = None,
    ):
        """Read the log and make spaces; see the class for the arguments."""
        options = {"columns": columns, "clock_offset": clock_offset, "dt": dt, "grid": grid, "stamps": stamps}
        self.log, maker = read_for(log, model, any_dt=False, **options)
        offer = object_named(model, "model") if isinstance(model, str) else model
        self.continuous = None if self.log.stamps is None else continuous_of(offer)
        self.dt, self.state_space_model = self.log.dt, maker
        if hasattr(model, "check_tuned_for"):
            self.check_tuned_for = model.check_tuned_for
        m, p = self.log.measurements.shape[1], self.log.inputs.shape[1]
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (m,), np.float64)
        self.action_space = gym.spaces.Box(-np.inf, np.inf, (p,), np.float64)
        self._row, self._last = 0, np.zeros(m)

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Go back to the first row; ValueError for a log on its own stamps, whose steps differ in length."""
        if self.log.stamps is not None:
            raise ValueError(f"a log must lie on a grid to be replayed, but {self.log.name} has its own stamps")
        super().reset(seed=checked_seed(seed))
        self._row, self._last = 0, np.zeros_like(self._last)
        return self._observed()

    def step(self, action):
        """Go to the next row; ValueError for an action that is not p numbers, or after the last row."""
        some_numbers(action, self.log.input_quantities)
        if self._row == self.log.steps:
            raise ValueError(f"a log must be reset after its last row, but {self.log.name} was stepped beyond it")
        self._row += 1
        observation, info = self._observed()
        info["recorded_input"] = self.log.inputs[self._row - 1].copy()
        return observation, 0.0, False, self._row == self.log.steps, info

    def _observed(self) -> tuple[np.ndarray, dict]:
        z = self.log.measurements[self._row]
        valid = ~np.isnan(z)
        self._last = np.where(valid, z, self._last)
        info = {"measurement": self._last.copy(), "measurement_valid": valid}
        references = {key: float(values[self._row]) for key, values in self.log.references.items()}
        info["references"] = {key: value for key, value in references.items() if value == value}
        return self._last.copy(), info


def read_for(log: Any, model, *, any_dt: bool = False, **options) -> tuple[Log, Callable[..., StateSpaceModel]]:
    """A log, read if it is a path or a table, and the function of changes that makes the model at its sample time.

    Arguments and errors are those of `ReplayEnv`; with `any_dt` the model's sample time may be another one.
    """
    offer = object_named(model, "model") if isinstance(model, str) else model
    if not isinstance(log, Log):
        known = {name: value for name, value in options.items() if value is not None}
        log = read_log(log, _model_of(_maker(offer, options.get("dt") or ANY_DT), model), **known)
    maker = _maker(offer, log.dt)
    made_model = _model_of(maker, model)
    for logged, modelled, what in (
        (log.input_quantities, made_model.input_quantities, "inputs"),
        (log.measured, made_model.measurements, "measurements"),
    ):
        if [(quantity.symbol, quantity.unit) for quantity in logged] != [
            (quantity.symbol, quantity.unit) for quantity in modelled
        ]:
            listed = [
                ", ".join(quantity.short_label for quantity in quantities) or "none"
                for quantities in (logged, modelled)
            ]
            raise ValueError(f"{what} of log {log.name} must be the model's, {listed[1]}, but it has {listed[0]}")
    if log.stamps is None and not any_dt:
        _check_sample_time(made_model, log)
    return replace(log, measurements=seen_by(made_model, log.measurements)), maker


def _check_sample_time(model: StateSpaceModel, log: Log) -> None:
    """Raise ValueError for a model of another sample time than the log's, where it tells its own."""
    dt: float | None = getattr(model, "dt", None)
    with suppress(ValueError):  # which it raises if no constant is the sample time
        dt = sample_time_of(model, "")
    if dt is not None and abs(dt - log.dt) > OTHER_DT * log.dt:
        rule = f"the sample time of the model must be that of log {log.name}, {log.dt:.6g} s"
        way = f"give a function of dt, def model(dt): ..., or put the log on its steps (--dt {dt:.6g}, dt=)"
        raise ValueError(f"{rule}, but is {dt:.6g} s: {way}")


def _maker(offer: Any, dt: float) -> Callable[..., StateSpaceModel]:
    """The function of changes that makes a model of what is offered, at a sample time."""
    offer = offer.at(dt) if isinstance(offer, ContinuousModel) else in_discrete_time(offer)
    if isinstance(offer, StateSpaceModel):
        return partial(with_noise, offer)
    if hasattr(offer, "state_space_model"):
        return offer.state_space_model
    if callable(offer):
        try:
            takes_dt = "dt" in inspect.signature(offer).parameters
        except (TypeError, ValueError):  # some are written in C
            takes_dt = False
        return partial(offer, dt=dt) if takes_dt else offer
    raise ValueError(
        "the model of a log must be a StateSpaceModel, a function that makes one, or an object with "
        f"state_space_model, but got {short_repr(offer)}"
    )


def _model_of(maker: Callable[..., StateSpaceModel], named) -> StateSpaceModel:
    try:
        result = maker()
    except ValueError:
        raise
    except Exception as error:
        raise ValueError(
            f"the model of a log must be made without arguments, but {short_repr(named)} raised "
            f"{error_line(error)}"
        ) from error
    if not isinstance(result, StateSpaceModel):
        raise ValueError(
            f"the model of a log must be a StateSpaceModel, but {short_repr(named)} makes {short_repr(result)}"
        )
    return result
