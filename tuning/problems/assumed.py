"""What problems of any plant share: the model that filters assume, the rule of thumb, and the parameters.

Filters of an `AugmentedProblem` also estimate constants of the model, which its name lists:
"mismatch+voltage_gain".
"""

from __future__ import annotations

import re
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache
from inspect import signature
from math import isfinite
from pathlib import Path
from types import MappingProxyType
from typing import Any

import gymnasium as gym
import numpy as np

from filters.augmented import Unknown, augmented_model
from filters.consistency.report import estimable
from filters.consistency.time_constants import Run
from filters.tuned_file import AUGMENTED, NOISE, PRIOR
from thruster_env.core.checks import at_least, one_of, positive, short_repr
from thruster_env.core.modules import error_line
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.turns import about_mean, leading
from tuning.problems.check import DIGEST_RUNS, check_data, digest_of, numbers_of
from tuning.problems.data import FIRST_SCORED_STEP, Data, checked_first_scored_step
from tuning.problems.problem import GIVEN, SPREAD, Parameter, Problem

RANGE_SEEDS = range(8)  # seeds whose runs determine each state's range, unless the model has it
RANGE_FRACTION = 0.01  # standard deviation of the rule of thumb's Q, as a fraction of each state's range
MOST_STEPS = 1_000_000

# Constants to estimate, in the name of a problem.
NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
CONSTANT = re.compile(rf"\+([A-Za-z_]\w*(?::{NUMBER}){{0,3}})$")  # at the end of a name: NAME:STD:WALK:MEAN
RULE = "a constant to estimate (--augment) must be NAME, NAME:STD, NAME:STD:WALK or NAME:STD:WALK:MEAN"
# Default belief of a constant: standard deviation of a flow [m/s], of others as a fraction of their value ...
FLOW_STD, RELATIVE_STD, WALK_PART = 0.5, 0.2, 0.02  # ... and of a step's change, as a fraction of the prior's
Unknowns = Mapping[str, Unknown | None]


class AssumedProblem(Problem):
    """A problem whose filters assume a `StateSpaceModel`, or a function of parameters that returns one.

    Args:
        assumed: the model, or a function that makes it; its keyword arguments are the names of `parameters`.
        steps: length K of a run.
        first_scored_step: the first step whose error is scored; below 50 the start-up is scored, too, and a study
            then tunes the scale of P_0.
        scale: by which the score divides the error of each state; computed from the truth if None.
        parameters: parameters of the model that a study tunes, in place of the variances of Q and R.
        untuned: arguments of the model before any tuning; by rule of thumb if None.
        true: arguments of the oracle's model, with the plant's own Q and R, if they are known.
        dt: sample time [s], if there is one; covariances are per step and do not scale with it.
        name: its name in messages; replaced by the name under which it is found.
        about: one line for tables.

    Raises:
        ValueError: states the rule and the value.
    """

    def __init__(
        self,
        assumed: StateSpaceModel | Callable[..., StateSpaceModel],
        *,
        steps: int,
        first_scored_step: int,
        scale: Sequence[float] | None,
        parameters: Sequence[Parameter] | None,
        untuned: Mapping | None,
        true: Mapping | None,
        dt: float | None,
        name: str,
        about: str,
    ):
        """Check the arguments; see the class."""
        self.name, self.about = name, about
        self.steps = at_least("steps", steps, 2, MOST_STEPS)
        self.first_scored_step = checked_first_scored_step(first_scored_step, self.steps)
        self._assumed, self._scale = assumed, None if scale is None else tuple(map(float, scale))
        self._untuned, self._true = _mapping("untuned", untuned), _mapping("true", true)
        self._parameters = with_defaults(_checked_parameters(parameters), assumed, self._untuned or {})
        self._dt = None if dt is None else positive("dt", dt)
        if self._parameters is not None and isinstance(assumed, StateSpaceModel):
            raise ValueError(f"a model with parameters must be a function of them, but got {short_repr(assumed)}")

    @abstractmethod
    def make(self, seeds: tuple[int, ...]) -> Data:
        """The data of some seeds, before they are checked."""

    @abstractmethod
    def found_scale(self) -> np.ndarray:
        """The scale where none is given."""

    @property
    def found_scale_about(self) -> str:
        """A description of that scale."""
        return SPREAD

    @property
    def scale_about(self) -> str:
        """A description of the scale."""
        return GIVEN if self._scale is not None else self.found_scale_about

    def model(self, **changes) -> StateSpaceModel:
        """The assumed model with some changes; see `Problem.model`."""
        noise: dict[str, Any] = {key: changes.pop(key) for key in (*NOISE, PRIOR) if key in changes}
        arguments = {parameter.name: parameter.start for parameter in self._parameters or ()} | changes
        if not isinstance(self._assumed, StateSpaceModel):
            model = self._made(self._assumed, arguments)
        elif not arguments:
            model = self._assumed
        else:
            raise ValueError(
                f"arguments of the model of problem {self.name} must be among {', '.join((*NOISE, PRIOR))}, "
                f"but got {', '.join(arguments)}"
            )
        factor = noise.pop(PRIOR, None)
        if factor is not None:
            noise["prior_cov"] = positive(PRIOR, factor) * model.prior_cov
        return model.replace(**noise) if noise else model

    def data(self, seeds: Sequence[int]) -> Data:
        """Inputs, measurements and, where it is known, truth for seeds."""
        return _data(self, tuple(int(seed) for seed in seeds))

    @cached_property  # computed at first use, for it may take many runs
    def scale(self) -> tuple[float, ...] | None:  # type: ignore[override]  # an attribute, as in other problems
        """By which the score divides the error of each state, as given or computed; None without truth."""
        if self._scale is not None:
            return self._scale
        return None if self.data(self.range_seeds).states is None else tuple(self.found_scale().tolist())

    @property
    def parameters(self) -> tuple[Parameter, ...] | None:
        """Parameters of the model that a study tunes; None for the variances of Q and R."""
        return self._parameters

    @property
    def untuned(self) -> dict:
        """Arguments of the model before any tuning: as given, the parameters' defaults, or by rule of thumb."""
        if self._parameters is not None:
            return {parameter.name: parameter.start for parameter in self._parameters} | (self._untuned or {})
        return self._thumb | (self._untuned or {})

    @cached_property
    def given(self) -> dict | None:
        """The given values of the model: its own Q and R, or the defaults of its parameters, and `untuned`.

        None for parameters without a default.
        """
        if self._parameters is not None:
            defaults = {
                parameter.name: parameter.default
                for parameter in self._parameters
                if parameter.default is not None
            }
            values = defaults | (self._untuned or {})
            return values if len(defaults) == len(self._parameters) else None
        model = self.model()
        q, r = rows_argument(model.process_noise_cov), as_argument(model.measurement_noise_cov)
        return {"process_noise_cov": q, "measurement_noise_cov": r} | (self._untuned or {})

    @property
    def lacks_ranges(self) -> bool:
        """Whether the Q of `untuned` is the model's own, because nothing gives a range of states."""
        if self._parameters is not None or "process_noise_cov" in (self._untuned or {}):
            return False
        model = self.model()
        has_limits = model.state_low is not None and model.state_high is not None
        return not has_limits and self.data(self.range_seeds).states is None

    @property
    def true(self) -> dict | None:
        """Arguments of the oracle's model, with the plant's own Q and R; None if they are unknown."""
        return self._true

    @property
    def range_seeds(self) -> range:
        """Seeds whose runs determine each state's range."""
        return RANGE_SEEDS

    @property
    def counts_start_up(self) -> bool:
        """Whether the first steps are scored, on which P_0 has an effect."""
        return self.first_scored_step < FIRST_SCORED_STEP and bool(self.model().prior_cov.any())

    @property
    def dt(self) -> float | None:
        """Sample time [s]."""
        return self._dt

    @cached_property  # computed at first use, for it takes some runs
    def digest(self) -> str:
        """A hash of the problem's numbers; see `tuning.problems.check`."""
        ends = ({p.name: end} for p in self._parameters or () for end in (p.low, p.high))
        models = [self.model(), *map(self._model_or_none, ends)]
        numbers = numbers_of(models, self.data(tuple(self.range_seeds)[:DIGEST_RUNS]))
        of_runs = self.steps, self.first_scored_step, self._scale, self._dt
        return digest_of(self.origin, numbers, self._parameters, self._untuned, self._true, *of_runs)

    @property
    def origin(self) -> tuple:
        """What the data come from, where that is plain data, for the digest."""
        return ()

    def _model_or_none(self, changes: Mapping[str, float]) -> StateSpaceModel | None:
        """The model for some parameters; None where the user's function has none."""
        try:
            return self.model(**changes)
        except ValueError:
            return None

    @cached_property
    def _thumb(self) -> dict:
        """R of the assumed model (from the data sheet), and Q = diag((1 % of each state's range)^2)."""
        model = self.model()
        deviations = np.sqrt(np.diag(model.process_noise_cov))
        if model.state_low is not None and model.state_high is not None:
            ranges = np.delete(model.state_high - model.state_low, [turn.stored for turn in model.turns])
            deviations = RANGE_FRACTION * ranges
        elif (data := self.data(self.range_seeds)).states is not None:
            states = data.counted_rows(data.states)
            ranges = np.ptp(rows_of(states, model), axis=0)
            deviations[: len(ranges)] = RANGE_FRACTION * ranges
        variances = tuple(float(v) for v in deviations**2)
        return {"process_noise_cov": variances, "measurement_noise_cov": as_argument(model.measurement_noise_cov)}

    def _made(self, make: Callable[..., StateSpaceModel], arguments: Mapping) -> StateSpaceModel:
        try:
            model = make(**arguments)
        except Exception as error:
            wanted = ", ".join(arguments) or "no arguments"
            raise ValueError(
                f"the model of problem {self.name} must be made of {wanted}, but raised {error_line(error)}"
            ) from error
        if not isinstance(model, StateSpaceModel):
            raise ValueError(
                f"the model of problem {self.name} must be a StateSpaceModel, but it is {short_repr(model)}"
            )
        return model


@lru_cache(maxsize=8)
def _data(problem: AssumedProblem, seeds: tuple[int, ...]) -> Data:
    data = problem.make(seeds)
    check_data(data, problem.model(), problem.name)
    return data.read_only()


def rows_of(states: np.ndarray, model: StateSpaceModel) -> np.ndarray:
    """True states of all runs and steps, one a row, angles on the branch of their circular mean.

    Of a model with rotations these are differences (N, t) from the mean state.
    """
    rows = states.reshape(-1, states.shape[-1])
    turns, angles = leading(model.turns, rows.shape[1]), model.any_shape.state_angles[: rows.shape[1]]
    return about_mean(rows, turns, angles)


def as_argument(cov: np.ndarray):
    """A covariance as a choice stores it: one variance, several, or the rows of a matrix."""
    if np.count_nonzero(cov - np.diag(np.diag(cov))):
        return tuple(map(tuple, cov.tolist()))
    variances = tuple(np.diag(cov).tolist())
    return variances[0] if len(variances) == 1 else variances


def rows_argument(cov: np.ndarray):
    """As `as_argument`, but a tuple for a single state, too, as a choice stores Q."""
    argument = as_argument(cov)
    return argument if isinstance(argument, tuple) else (argument,)


def _checked_parameters(parameters) -> tuple[Parameter, ...] | None:
    if parameters is None:
        return None
    checked = (
        tuple(parameters)
        if isinstance(parameters, Sequence) and not isinstance(parameters, str)
        else (parameters,)
    )
    if not checked or not all(isinstance(parameter, Parameter) for parameter in checked):
        raise ValueError(
            f"parameters must be some of tuning.problems.problem.Parameter, but got {short_repr(parameters)}"
        )
    names = [parameter.name for parameter in checked]
    if len(set(names)) < len(names):
        raise ValueError(f"names of parameters must differ from one another, but got {', '.join(names)}")
    return checked


def with_defaults(
    parameters: tuple[Parameter, ...] | None, make: Any, untuned: Mapping
) -> tuple[Parameter, ...] | None:
    """Parameters with the given values as defaults: those in `untuned`, else those of the user's function.

    A parameter's own default is kept. A range is widened to hold the default.
    """
    if parameters is None:
        return None
    try:
        known = signature(make).parameters
    except (TypeError, ValueError):  # of a callable without one
        known = MappingProxyType({})
    completed = []
    for parameter in parameters:
        of_function = getattr(known.get(parameter.name), "default", None)
        value = untuned.get(parameter.name, parameter.default if parameter.default is not None else of_function)
        is_number = isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)
        if not is_number or (parameter.log and value <= 0):
            completed.append(parameter)
            continue
        value = round(value) if parameter.integer else value
        ends = {"low": min(parameter.low, value), "high": max(parameter.high, value)}
        completed.append(replace(parameter, default=value, **ends))
    return tuple(completed)


def _mapping(name: str, mapping) -> dict | None:
    if mapping is not None and not isinstance(mapping, Mapping):
        raise ValueError(f"{name} must map arguments of the model to values, but got {short_repr(mapping)}")
    return None if mapping is None else dict(mapping)


def default_belief(name: str, value: float) -> Unknown:
    """The default belief of a constant of the model.

    Its prior has a standard deviation of 0.5 m/s for the ambient flow, and of a fifth of its value otherwise; a
    step changes it by 2 % of that.

    Raises:
        ValueError: if the constant is zero, because its spread is a fraction of its value.
    """
    std = FLOW_STD if name == "ambient_velocity" else RELATIVE_STD * abs(value)
    positive(f"the assumed {name}, of which a part is its spread,", std)
    return Unknown(std=std, walk_std=WALK_PART * std)


def beliefs_of(constants: Any, unknown: Unknowns) -> dict[str | int, Unknown]:
    """The priors of a model's constants, with defaults and means filled in.

    Raises:
        ValueError: for a name that is not a constant, or a constant without a default.
    """
    beliefs: dict[str | int, Unknown] = {}
    names = getattr(constants, "_fields", ())
    for name, belief in unknown.items():
        if not names:
            raise ValueError(
                f"a constant to estimate must be one of the model's, but it has none, and got {short_repr(name)}: "
                "give the StateSpaceModel a NamedTuple as constants, which transition and observe read"
            )
        one_of("a constant to estimate", name, names)
        value = getattr(constants, name)
        prior = default_belief(name, value) if belief is None else Unknown(*belief)
        beliefs[name] = prior if prior.mean is not None else prior._replace(mean=value)
    return beliefs


def unknown_in(text: str) -> tuple[str, Unknown | None]:
    """A constant and its prior from NAME, NAME:STD, NAME:STD:WALK or NAME:STD:WALK:MEAN; None for the default."""
    name, *numbers = text.split(":")
    try:
        return name, Unknown.of_numbers(*map(float, numbers)) if numbers else None
    except (TypeError, ValueError):
        raise ValueError(f"{RULE}, but got {short_repr(text)}") from None


def unknowns_of(augment: str | Sequence[str] | Mapping[str, Any]) -> dict[str, Unknown | None]:
    """The priors of constants, None for the default, from texts NAME[:STD[:WALK[:MEAN]]] or from a mapping.

    Args:
        augment: of a mapping each value is None, an `Unknown`, a standard deviation, or (std, walk, mean).
    """
    if not isinstance(augment, Mapping):
        return dict(map(unknown_in, [augment] if isinstance(augment, str) else augment))
    priors: dict[str, Unknown | None] = {}
    for name, prior in augment.items():
        if prior is None or isinstance(prior, Unknown):
            priors[name] = prior
        else:
            priors[name] = Unknown.of_numbers(*map(float, prior if isinstance(prior, list | tuple) else (prior,)))
    return priors


def name_and_unknown(name: str) -> tuple[str, dict[str, Unknown | None]]:
    """The name of the problem within an augmented one's name, and the constants; none for another name."""
    constants: list[str] = []
    while match := CONSTANT.search(name):
        name, constants = name[: match.start()], [match[1], *constants]
    return name, dict(map(unknown_in, constants))


def augmented(problem: Problem, unknown: Unknowns) -> Problem:
    """The problem whose filters also estimate some constants; the problem itself for none."""
    return AugmentedProblem(problem, unknown) if unknown else problem


def suited(problem: Problem, constants: Mapping[str, Sequence[float]]) -> Problem:
    """A problem as the filter of a tuned file assumes it: with the constants as states that the file keeps.

    Args:
        problem: on which the filter is to run.
        constants: [std, walk, mean] of each constant, `filters.tuned_file.AUGMENTED`; empty for none.
    """
    if constants_in(problem) == constants:
        return problem
    return augmented(within(problem), {name: Unknown.of_numbers(*numbers) for name, numbers in constants.items()})


def constants_in(problem: Problem) -> dict[str, list[float]]:
    """[std, walk, mean] of each constant that is a state of a problem's model."""
    return dict(problem.held.get(AUGMENTED, {}))


def may_estimate_constants(problem: Problem) -> bool:
    """Whether a problem's model has constants that `--augment` can make states."""
    plain = within(problem)
    return plain.parameters is None and bool(estimable(getattr(plain.model().constants, "_fields", ())))


def within(problem: Problem) -> Problem:
    """The problem without the constants that are states."""
    return problem.problem if isinstance(problem, AugmentedProblem) else problem


class AugmentedProblem(Problem):
    """Another problem's data and score, for filters whose model has some of its constants as further states.

        (x, theta)' = (f(x, u, theta), theta) + (w, walk)

    Q has a variance of each constant's walk after those of the states, which a study tunes like these; the prior
    of a constant stays. The score counts the plant's states alone.

    Args:
        problem: tunes Q and R, with constants that have names.
        unknown: the prior of each constant by name; None for `default_belief`.

    Raises:
        ValueError: for a name that is not one of the model's constants, or a problem with parameters of its own.

    Source: Kopp, Orford (1963), "Linear regression applied to system identification for adaptive control systems",
    AIAA Journal 1(10).
    """

    def __init__(self, problem: Problem, unknown: Unknowns):
        """Check that the model has these constants; see the class for the arguments."""
        if problem.parameters is not None:
            raise ValueError(
                f"constants to estimate (--augment) must be asked of a problem that tunes Q and R, but "
                f"{problem.name} tunes {', '.join(parameter.name for parameter in problem.parameters)}"
            )
        plain = problem.model()
        self.problem, self.beliefs = problem, beliefs_of(plain.constants, unknown)
        self.name, self.about = problem.name + "".join(map(_suffix, unknown.items())), problem.about
        self.scale = problem.scale
        self._model = augmented_model(plain, self.beliefs)
        self._walks = tuple(belief.walk_std**2 for belief in self.beliefs.values())

    @cached_property
    def digest(self) -> str:
        """A hash of the problem and the priors."""
        return digest_of(self.problem.digest, self.held[AUGMENTED])

    @property
    def held(self) -> dict:
        """What the problem holds, and [std, walk, mean] of each constant, as a tuned file has them."""
        numbers = {name: [belief.std, belief.walk_std, belief.mean] for name, belief in self.beliefs.items()}
        return {**self.problem.held, AUGMENTED: numbers}

    def model(self, **changes) -> StateSpaceModel:
        """The augmented model, with another Q (n + k), R or factor on the whole P_0."""
        factor = changes.pop(PRIOR, None)
        if factor is not None:
            changes["prior_cov"] = positive(PRIOR, factor) * self._model.prior_cov
        return self._model.replace(**{name: value for name, value in changes.items() if value is not None})

    def data(self, seeds: Sequence[int]) -> Data:
        """Those of the problem."""
        return self.problem.data(seeds)

    def bound(self, data: Data) -> np.ndarray:
        """That of the problem, (n,), of filters that know the constants."""
        return self.problem.bound(data)

    def make_env(self, **arguments: Any) -> gym.Env:
        """The problem's env; a tuned file makes the augmented model of the one that it offers."""
        return self.problem.make_env(**arguments)

    @property
    def untuned(self) -> Mapping:
        """The problem's rule of thumb, and the walks of the priors."""
        return self._with_walks(self.problem.untuned)

    @property
    def given(self) -> Mapping | None:
        """What the problem's model came with, and the walks of the priors."""
        return None if self.problem.given is None else self._with_walks(self.problem.given)

    @property
    def true(self) -> Mapping | None:
        """The plant's own Q and R, and the walks of the priors."""
        return None if self.problem.true is None else self._with_walks(self.problem.true)

    def _with_walks(self, arguments: Mapping) -> dict:
        """Arguments of the problem's model, with Q (n + k)."""
        q = self.problem.model(**arguments).process_noise_cov
        full_q = np.zeros((len(q) + len(self._walks),) * 2)
        full_q[: len(q), : len(q)] = q
        full_q[range(len(q), len(full_q)), range(len(q), len(full_q))] = self._walks
        return {**arguments, "process_noise_cov": rows_argument(full_q)}

    def training_seeds(self, seed: int, count: int) -> range:
        """Those of the problem."""
        return self.problem.training_seeds(seed, count)

    def size_seeds(self, seed: int, count: int) -> range:
        """Those of the problem."""
        return self.problem.size_seeds(seed, count)

    def validation_seeds(self, seed: int, count: int) -> range:
        """Those of the problem."""
        return self.problem.validation_seeds(seed, count)

    def held_out_seeds(self, seed: int, count: int) -> range:
        """Those of the problem."""
        return self.problem.held_out_seeds(seed, count)

    def long_runs(self, seed: int) -> list[Run]:
        """Those of the problem."""
        return self.problem.long_runs(seed)

    def logs_of(self, seeds: Sequence[int]) -> np.ndarray | None:
        """Those of the problem."""
        return self.problem.logs_of(seeds)

    def started_for(self, name: str, model: StateSpaceModel) -> StateSpaceModel:
        """As the problem does."""
        return self.problem.started_for(name, model)

    def run_label(self, seed: int) -> str:
        """That of the problem."""
        return self.problem.run_label(seed)

    def check_tuned_for(self, plant: Mapping | None, file: str | Path) -> None:
        """As the problem does."""
        self.problem.check_tuned_for(plant, file)

    def as_mapping(self) -> dict:
        """The problem within, as a tuned file keeps it."""
        return {"of": {"digest": self.problem.digest, "content": self.problem.as_mapping()}}

    remarks = property(lambda self: self.problem.remarks)
    shortest_log = property(lambda self: self.problem.shortest_log)
    log_names = property(lambda self: self.problem.log_names)
    lacks_ranges = property(lambda self: self.problem.lacks_ranges)
    scale_about = property(lambda self: self.problem.scale_about)
    counts_start_up = property(lambda self: self.problem.counts_start_up)
    leads_in = property(lambda self: self.problem.leads_in)
    dt = property(lambda self: self.problem.dt)
    plant_data = property(lambda self: self.problem.plant_data)
    seed_word = property(lambda self: self.problem.seed_word)


def _suffix(constant: tuple[str, Unknown | None]) -> str:
    """A constant as part of a problem's name, which `name_and_unknown` reads."""
    name, belief = constant
    numbers = [number for number in ((belief or ())[:3]) if number is not None]
    return "".join([f"+{name}", *(f":{float(number)!r}".removesuffix(".0") for number in numbers)])
