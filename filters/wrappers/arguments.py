"""A filter and the model that it assumes, from a wrapper's plain arguments.

    x_{k+1} = f(x_k, (u_k, a_k)) + w,   z_k

The method `measured_inputs(model)` of an env splits its channels into such inputs a and the model's measurements
z. A filter predicts with the last measured a, and updates with z.
"""

from __future__ import annotations

import importlib
import inspect
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from itertools import takewhile
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from filters.augmented import Unknown, augmented_model
from filters.estimators.foreign import is_foreign
from filters.filter import Filter
from filters.named import NamedMaker, model_named
from filters.registry import filter_type, make_filter
from filters.tuned_file import AUGMENTED, FACTORS, NOISE, PRIOR, check_same_quantities, compared, read_tuned_file
from thruster_env.core.checks import short_repr
from thruster_env.env.model_env import Split
from thruster_env.logs.log import of_one_step
from thruster_env.model.continuous import AtDt
from thruster_env.model.state_space import StateSpaceModel

OBSERVATIONS = ("estimate", "measurement+estimate", "belief")
FAR = 5.0  # standard deviations, of a first measurement from where a model begins
APPENDED = "appended_entries"  # attribute of an env: entries of its observation after the measurement
HOOK = "measured_inputs"  # method of an env; what it returns is a `Split`, or None for an ordinary model

# Where a wrapper's model comes from: the env, a factory that the caller names, or the caller.


def model_for_step(text: Any, dt: float | None) -> Callable[..., StateSpaceModel] | None:
    """The function of numbers that makes the model of a name for a sample time [s]; None for another text.

    Raises:
        ValueError: for a wrong setting, or a model without a sample time.
    """
    maker = model_named(text)
    if maker is None:
        return None
    dt = maker.dt if isinstance(maker, NamedMaker) and maker.dt is not None else dt
    if dt is None:
        way_out = f"{maker.name}:dt=..." if isinstance(maker, NamedMaker) else "give it by a function"
        raise ValueError(f"a model by name must have a sample time, but {text} has no dt here: {way_out}")
    make: Any = maker
    has_dt = isinstance(maker, NamedMaker) or "dt" in inspect.signature(maker).parameters
    return partial(make if has_dt else AtDt(make), dt=dt)


def maker_of(env, model: str | StateSpaceModel | None) -> tuple[str, Callable | StateSpaceModel]:
    """A model's name in messages, and its source: the env, a name or "module:factory", or itself.

    Raises ValueError if there is none.
    """
    if model is None:
        make = offered(env, "state_space_model")
        if make is None:
            rule = "an env that offers no state_space_model must come with a model"
            raise ValueError(f"{rule}, but got {env} alone: pass model=...")
        refuse_other_actions(env)
        return f"the model of {env.unwrapped}", make
    if isinstance(model, StateSpaceModel):
        return "the model", model
    plant_dt = getattr(getattr(env.unwrapped, "plant", None), "dt", None)
    named = model_for_step(model, sample_time(env) or plant_dt)
    if named is not None:
        return f"model {model!r}", named
    module, _, name = str(model).partition(":")
    try:
        factory = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError):
        rule = "model must be 'module:factory' that can be imported, a model's name, or a StateSpaceModel"
        raise ValueError(f"{rule}, but got {model!r}") from None
    return f"model {model!r}", factory


def warn_if_far(model: str, innovation: np.ndarray, innovation_cov: np.ndarray) -> None:
    """Warn the caller's caller of a model by name, which begins at its mean, if a first measurement is far away.

    Args:
        model: its name.
        innovation: of the first measurements, (..., m).
        innovation_cov: S, (..., m, m).
    """
    apart = np.abs(innovation) / np.sqrt(np.diagonal(innovation_cov, axis1=-2, axis2=-1))
    if np.size(apart) and (furthest := float(np.nanmax(apart))) > FAR:
        warnings.warn(
            f"the first measurement is {furthest:.3g} standard deviations from where {model!r} begins: "
            "give the mean of the data, mean=..., as thruster fit does",
            stacklevel=3,
        )


def offered(env, name: str) -> Any:
    """The attribute of an env, or of a wrapper around it; None if none has it."""
    if isinstance(env, gym.Env) and env.has_wrapper_attr(name):
        return env.get_wrapper_attr(name)
    return getattr(env.unwrapped, name, None)


def made_model(what: str, make: Callable, arguments: Mapping) -> StateSpaceModel:
    """The model made with some arguments; ValueError if there is none."""
    try:
        model = make(**arguments)
    except TypeError as error:
        raise ValueError(f"{what} must take the given arguments: {error}") from None
    if not isinstance(model, StateSpaceModel):
        raise ValueError(f"{what} must be a StateSpaceModel, but it is {short_repr(model)}")
    return model


# The filter of a tuned file, with the model of the env or of the caller.


def check_same_model(tuned_for: Mapping, model: StateSpaceModel, dt: float | None, file: str | Path) -> None:
    """Raise ValueError, with what differs, unless a model is the very one that a tuned file is for.

    Arguments are those of `check_same_quantities`; the model has the file's Q and R.
    """
    check_same_quantities(tuned_for, model, dt, file)
    model = of_one_step(model)
    if model.digest != tuned_for["digest"]:
        raise ValueError(
            f"a tuned file must be for the model it is used with, but {file} was tuned for a model of digest "
            f"{tuned_for['digest']} (here {model.digest})"
        )


def tuned_filter(env, model: str | StateSpaceModel | None, file: str) -> Filter:
    """Make the filter of a tuned file, for a model that takes the tuned Q, R and parameters.

    Names in the file are never imported: the model is the env's or the caller's, and must equal the file's. If the
    file contains its plant as data, it must match the env's plant (unless the caller passes a model) and the
    model's states, inputs and sensors; otherwise also dt and the model's digest. For files older than version 4
    only the plant is compared.

    Args:
        env: the wrapped env.
        model: as `EstimateState` takes it.
        file: the path.

    Raises:
        ValueError: with the differences, if the model is another one; or if the file is invalid.
    """
    content = read_tuned_file(file)
    plant, check = content.get("plant"), getattr(env.unwrapped, "check_tuned_for", None)
    if model is None and check is not None:
        with compared(content, file):
            check(plant, file)
    entry, tuned_for = content["filter"], content.get("model")
    dt = None if plant is not None else sample_time(env)
    factors = [f"{name} {value:g}" for name, value in entry["model"].get(FACTORS, {}).items() if value != 1.0]
    if factors:
        message = f"{file} was tuned on a model that is wrong on purpose: here, too, its filter assumes"
        warnings.warn(f"{message} {', '.join(factors)} times the plant's own", stacklevel=4)

    def fits(candidate: StateSpaceModel) -> None:
        if tuned_for is not None:
            with compared(content, file):
                check_same_quantities(tuned_for, candidate, dt, file)

    by_digest = tuned_for is not None and plant is None
    tuned = _with_numbers(*maker_of(env, model), entry["model"], fits, by_digest)
    if tuned_for is not None and by_digest:
        with compared(content, file):
            check_same_model(tuned_for, tuned, dt, file)
    return make_filter(entry["name"], tuned, **entry["numbers"])


def sample_time(env) -> float | None:
    """An env's `dt` [s], None if it has none."""
    dt = getattr(env.unwrapped, "dt", None)
    return float(dt) if isinstance(dt, float | int) and not isinstance(dt, bool) and dt > 0 else None


def _with_numbers(
    what: str,
    make: Callable | StateSpaceModel,
    numbers: Mapping,
    fits: Callable[[StateSpaceModel], None],
    by_digest: bool,
) -> StateSpaceModel:
    """A model with the numbers of a tuned file: Q and R, the factor on P_0, and further arguments of its maker.

    Constants that the file has as states become states. Parameters that the maker does not take are left out only
    if a comparison of digests follows, which would detect another model.
    """
    unknown = {name: Unknown.of_numbers(*prior) for name, prior in numbers.get(AUGMENTED, {}).items()}

    def augmented(plain: StateSpaceModel) -> StateSpaceModel:
        return augmented_model(plain, unknown) if unknown else plain

    if isinstance(make, StateSpaceModel):
        model = augmented(make)
        fits(model)
        return _with_noise(model, numbers)
    arguments = {name: value for name, value in numbers.items() if name not in (*NOISE, PRIOR, AUGMENTED)}
    if by_digest:
        arguments = {name: value for name, value in arguments.items() if name in _arguments_of(make)}
    plain = augmented(made_model(what, make, arguments))
    fits(plain)  # before Q and R, whose sizes may differ
    return _with_noise(plain, numbers) if by_digest or unknown else made_model(what, make, numbers)


def _with_noise(model: StateSpaceModel, numbers: Mapping) -> StateSpaceModel:
    changes = {name: numbers[name] for name in NOISE}
    if PRIOR in numbers:
        changes["prior_cov"] = numbers[PRIOR] * model.prior_cov
    return model.replace(**changes)


def _arguments_of(make: Callable) -> set[str]:
    try:
        return set(inspect.signature(make).parameters)
    except (TypeError, ValueError):  # some are written in C
        return set()


def given_filter(filter, tuned) -> tuple:
    """The arguments `filter` and `tuned` as a wrapper keeps them; a study becomes its filter.

    Raises ValueError if either does not have the type that the wrapper documents, or both are given.
    """
    if isinstance(tuned, PathLike):
        tuned = fspath(tuned)
    if tuned is not None and not isinstance(tuned, str):
        offered = getattr(tuned, "filter", None)
        if not isinstance(offered, Filter):
            rule = "tuned must be the path of a tuned file, or what tuning.tune returns"
            raise ValueError(f"{rule} (pass a filter object as filter=...), but got {short_repr(tuned)}")
        if filter is not None:
            raise ValueError(f"tuned must come without filter: it has its own, but got {short_repr(filter)}")
        filter, tuned = offered, None
    if not (filter is None or isinstance(filter, str | Filter) or is_foreign(filter)):
        rule = "filter must be a name, a filter that is made (as study.filter) or an estimator"
        raise ValueError(f"{rule}; a study is tuned=study; but got {short_repr(filter)}")
    return filter, tuned


def filter_for(env, filter, model, tuned: str | None, model_arguments, numbers: dict) -> Filter:
    """The filter for a wrapper around env; the wrapper's class documents the arguments.

    A tuned file is data: nothing in it becomes a model or another argument of the wrapper.

    Raises ValueError if an argument is unknown or wrong.
    """
    if tuned is not None:
        if filter is not None or numbers or model_arguments is not None:
            raise ValueError("tuned must come without filter, numbers and model_arguments: its file holds them")
        return tuned_filter(env, model, tuned)
    if isinstance(filter, Filter):
        if model is not None or model_arguments is not None or numbers:
            rule = "a filter that is made must come without model, model_arguments and numbers: it has its own"
            raise ValueError(f"{rule}, but got {short_repr(filter)} with some")
        return filter
    filter = "ekf" if filter is None else filter
    kind = filter_type(filter)
    for name in numbers:
        if name not in kind.numbers and not kind.is_foreign:
            rule = f"a number of filter {filter!r} must be one of {', '.join(kind.numbers) or 'none'}"
            raise ValueError(f"{rule} (arguments of the model go into model_arguments), but got {name!r}")
    arguments = {} if model_arguments is None else model_arguments
    if not isinstance(arguments, Mapping):
        raise ValueError(f"model_arguments must be a mapping, but got {short_repr(arguments)}")
    return kind.make(model_for(env, model, arguments), **numbers)


def model_for(env, model: str | StateSpaceModel | None, arguments: Mapping) -> StateSpaceModel:
    """The given model, one made by "module:factory", or the env's own; see `EstimateState`."""
    what, make = maker_of(env, model)
    if not isinstance(make, StateSpaceModel):
        return made_model(what, make, arguments)
    if arguments:
        raise ValueError(f"a StateSpaceModel must come without arguments of its own, but got {arguments!r}")
    return make


class ModelInSpec:
    """A model as an env's spec stores it. JSON's error shows the class's name, which states the remedy."""

    def __init__(self, content):
        self.content = content


class EstimatorInSpec(ModelInSpec):
    """A filter object, or an estimator, as an env's spec stores it, likewise."""


EstimatorInSpec.__name__ = "Filter or Estimator (give its name or 'module:object' instead)"
ModelInSpec.__name__ = "StateSpaceModel (give model='module:factory' instead)"


def check_spaces(
    action_space: gym.Space, observation_space: gym.Space, model: StateSpaceModel, measured_inputs: int = 0
) -> gym.spaces.Box:
    """Return the space of the actions that the filter uses; ValueError unless both are Box, and fit the model.

    These are the model's inputs without the last `measured_inputs`; none for a model without inputs.
    """
    actions, size = _box("action", action_space), model.inputs - measured_inputs
    _box("observation", observation_space)
    if not size:
        return gym.spaces.Box(0.0, 0.0, (0,))
    if int(np.prod(actions.shape)) != size:
        raise ValueError(f"the action space must have the model's {size} entries, but got {actions}")
    return actions


CHANGING = gym.ActionWrapper, gym.vector.VectorActionWrapper
CLIPPING = gym.wrappers.ClipAction, gym.wrappers.vector.ClipAction
REPEATING = "RepeatAction", "MaxAndSkipObservation"
OBSERVING = gym.ObservationWrapper, gym.vector.VectorObservationWrapper, gym.wrappers.FrameStackObservation
NORMALISING = gym.wrappers.NormalizeObservation, gym.wrappers.vector.NormalizeObservation


def layers(env) -> list:
    """An env and all that it wraps, from outside."""
    inside = [env]
    while isinstance(inside[-1], gym.Wrapper | gym.vector.VectorWrapper):
        inside.append(inside[-1].env)
    return inside


def outside(env, name: str) -> list:
    """The layers of an env around that which offers an attribute."""
    return list(takewhile(lambda layer: not (hasattr(type(layer), name) or name in vars(layer)), layers(env)))


def appended_entries(env) -> int:
    """How many entries an env's observation has after the measurement; ValueError if they may be other ones."""
    count = offered(env, APPENDED) or 0
    for layer in outside(env, APPENDED) if count else ():
        if isinstance(layer, OBSERVING):
            rule = f"the last {count} entries of an observation must be the env's own"
            raise ValueError(f"{rule}, but got {layer}: put {type(layer).__name__} around the filter")
    return count


def clipping_space(env) -> gym.Space:
    """The space of an env's actions, or of each copy's, to which the env clips them: within `ClipAction` its own.

    Raises ValueError for an env that begins episodes within a step, which no filter of one env notices.
    """
    for layer in layers(env):
        if isinstance(layer, gym.wrappers.Autoreset):
            raise ValueError(f"an env must begin episodes by reset() alone, but got {layer}: leave Autoreset out")
    changing = next((layer for layer in layers(env) if isinstance(layer, CHANGING)), env)
    clipping = changing.env if isinstance(changing, CLIPPING) else env
    return clipping.single_action_space if isinstance(clipping, gym.vector.VectorEnv) else clipping.action_space


def refuse_other_actions(env) -> None:
    """Raise ValueError if a wrapper of an env that offers a model changes or repeats actions; it may clip them."""
    for layer in outside(env, "state_space_model"):
        name, changes = type(layer).__name__, isinstance(layer, CHANGING) and not isinstance(layer, CLIPPING)
        if changes or name in REPEATING:
            rule = "a filter with the env's own model must get the env's own actions"
            raise ValueError(f"{rule}, but got {layer}: put {name} around the filter, or pass model=...")


def refuse_normalised(env, info: Mapping) -> None:
    """Raise ValueError if the observation, of which the measurement is taken, is normalised by its past."""
    if "measurement" not in info and any(isinstance(layer, NORMALISING) for layer in layers(env)):
        rule = "measurements must be in the model's units"
        raise ValueError(f"{rule}, but got {env}: put NormalizeObservation around the filter")


def _box(name: str, space: gym.Space) -> gym.spaces.Box:
    if not isinstance(space, gym.spaces.Box):
        raise ValueError(f"the {name} space must be a Box, but got {space}")
    return space


# Measured inputs of a model, such as an attitude from an AHRS, appended to the action.


def split_of(env, model: StateSpaceModel) -> Split:
    """The split of an env's channels for a model; without the hook all channels are measurements."""
    declared = getattr(env.unwrapped, HOOK, lambda model: None)(model)
    return Split((), tuple(range(model.channels)), model.channels) if declared is None else declared


class WithMeasuredInputs:
    """A session, or the beliefs of all copies, that takes all measurements and uses some of them as inputs.

    If such a measurement is missing, the last one is used, and zero before the first.

    Attributes:
        used: the inputs of the last step: the action and the measured inputs.
    """

    used: np.ndarray | None = None

    def __init__(self, runs, split: Split):
        """Take a session or beliefs, which run the filter; `start` comes next."""
        self._runs, self._inputs, self._measurements = runs, list(split.inputs), list(split.measurements)
        self._last: np.ndarray | None = None

    def __getattr__(self, name: str):
        """The estimate and everything else are those of the session or the beliefs."""
        if name.startswith("_"):
            raise AttributeError(name)
        return getattr(self._runs, name)

    def start(self, *arguments) -> None:
        """Start with a key and a measurement, or copies (which, keys, measurements)."""
        *which, keys, z = arguments
        first = np.nan_to_num(z[..., self._inputs])
        last = first if not which or self._last is None else self._last
        if which:
            last[which[0]] = first[which[0]]
        self._last = last
        self._runs.start(*which, keys, z[..., self._measurements])

    def step(self, u, z: np.ndarray, **idle) -> None:
        """Predict with the action and the inputs measured at the step's beginning, and update."""
        last = self._last
        assert last is not None  # `start` comes first
        self.used = np.concatenate([u, last], axis=-1)
        self._runs.step(self.used, z[..., self._measurements], **idle)
        now = z[..., self._inputs]
        self._last = np.where(np.isnan(now), last, now)
