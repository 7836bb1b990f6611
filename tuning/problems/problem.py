"""`Problem`, the interface between a plant and studies, evaluations and reports.

A `Parameter` is one number that a study may choose, with its range, its unit and its place in a choice.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np

from filters.consistency.time_constants import Run
from thruster_env.core.checks import at_least, finite, short_repr
from thruster_env.model.quantities import Quantities, Quantity
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.turns import innovations_of, tangent_of
from tuning.problems import data as seeds
from tuning.problems.data import Data, runs_of

if TYPE_CHECKING:
    import gymnasium as gym
    from optuna.distributions import FloatDistribution, IntDistribution

STEP = 1e-4  # of differences of a model, in coordinates
PART = 0.1  # fraction of its range that is the unit of a parameter on a linear scale
BOUND = "the posterior Cramér-Rao bound"  # what a scale is, in words
BOUND_OF_ROTATIONS = f"{BOUND} of small errors"  # where states are rotations
PATH_BOUND = "the bound along noise-free paths"
OPEN_LOOP = "the RMSE of the open loop"
SPREAD = "the standard deviation of the true states"
GIVEN = "the scale given with the problem"


class Place(Protocol):
    """Where a number stands in a `Choice`."""

    @property
    def is_variance(self) -> bool:
        """Whether the number is proportional to variances: it doubles where the variance of noise doubles."""

    def get(self, choice) -> float | None:
        """The number, None if the choice does not have it."""

    def set(self, choice, value):
        """The same choice with another number."""


@dataclass(frozen=True)
class Argument:
    """An argument of the problem's model, by name."""

    name: str
    is_variance: bool = False

    def get(self, choice) -> float | None:
        """The argument's value in a choice; None if it has none."""
        return choice.model.get(self.name)

    def set(self, choice, value):
        """The same choice with another value."""
        return choice._replace(model={**choice.model, self.name: value})


@dataclass(frozen=True)
class Parameter:
    """One number that a study may choose.

    Args:
        name: of the trials' parameter; by default the argument of the problem's model, too.
        low: the smallest value.
        high: the largest one.
        unit: the SI unit, for tables.
        log: whether it is chosen on a logarithmic scale.
        integer: whether it is a whole number.
        default: the value before any tuning; the middle of the range on its scale if None.
        first: the part of the range in which a search begins; all of it if None.
        place: where it stands in a choice; the argument of the model of the same name if None.
        tied: places of numbers in proportion to it, and their factors.
        held: places of numbers that have a value whatever this one is.

    Raises:
        ValueError: for an empty range, or a default outside it.
    """

    name: str
    low: float
    high: float
    unit: str = ""
    log: bool = True
    integer: bool = False
    default: float | None = None
    first: tuple[float, float] | None = None
    place: Place = None  # type: ignore[assignment]  # None is replaced as soon as the parameter is made
    tied: tuple[tuple[Place, float], ...] = ()
    held: tuple[tuple[Place, float], ...] = ()

    def __post_init__(self):
        """Check the range and fill in defaults."""
        if not isinstance(self.name, str) or not self.name or " " in self.name:
            raise ValueError(f"a parameter must have a name without spaces, but got {short_repr(self.name)}")
        check = at_least if self.integer else finite
        arguments = (-(10**9),) if self.integer else ()
        for end in ("low", "high"):
            object.__setattr__(self, end, check(f"{end} of {self.name}", getattr(self, end), *arguments))
        if not self.low < self.high or (self.log and self.low <= 0):
            rule = "positive and below high" if self.log else "below high"
            raise ValueError(f"low of {self.name} must be {rule}, but got {self.low:g} and {self.high:g}")
        if self.default is not None:
            default = check(f"default of {self.name}", self.default, *arguments)
            if not self.low <= default <= self.high:
                raise ValueError(
                    f"default of {self.name} must be within {self.low:g} and {self.high:g}, but got {default:g}"
                )
            object.__setattr__(self, "default", default)
        if self.place is None:
            object.__setattr__(self, "place", Argument(self.name))

    @property
    def start(self) -> float | int:
        """The value before any tuning."""
        if self.default is not None:
            return self.default
        middle = math.sqrt(self.low * self.high) if self.log else (self.low + self.high) / 2
        return round(middle) if self.integer else middle

    @property
    def distribution(self) -> FloatDistribution | IntDistribution:
        """The range as Optuna takes it."""
        from optuna import distributions  # which takes half a second, and only studies need

        if self.integer:
            return distributions.IntDistribution(int(self.low), int(self.high), log=self.log)
        return distributions.FloatDistribution(self.low, self.high, log=self.log)

    def get(self, choice) -> float | None:
        """The number in a choice, None if it does not have it."""
        return self.place.get(choice)

    def set(self, choice, value):
        """The same choice with another number, and what is tied to it."""
        for location, number in self.held:
            choice = location.set(choice, number)
        for location, factor in self.tied:
            choice = location.set(choice, factor * value)
        return self.place.set(choice, value)


def squared(unit: str) -> str:
    """The unit of a variance: "(rad/s)^2" of "rad/s"; empty for a pure number."""
    return f"({unit})^2" if set(unit) & set("/ ^*") else f"{unit}^2" if unit else ""


class Coordinates:
    """Map values of p parameters to coordinates (p,) and back; one unit is a sensible change of each parameter.

    That is a factor of e for parameters on a logarithmic scale, a tenth of the range for others.
    """

    def __init__(self, free: Sequence[Parameter]):
        """Raise ValueError unless there are parameters with distinct names."""
        self.free = tuple(free)
        self.names = tuple(parameter.name for parameter in self.free)
        if not self.free or len(set(self.names)) < len(self.names):
            raise ValueError(
                f"free parameters must be some, each named once, but got {short_repr(list(self.names))}"
            )
        if any(parameter.integer for parameter in self.free):
            integers = ", ".join(parameter.name for parameter in self.free if parameter.integer)
            raise ValueError(f"free parameters must not be whole numbers, but got {integers}")
        self.log = np.array([parameter.log for parameter in self.free])
        self.units = np.array(
            [1.0 if parameter.log else PART * (parameter.high - parameter.low) for parameter in self.free]
        )
        self.low, self.high = (
            self.of([parameter.low for parameter in self.free]),
            self.of([parameter.high for parameter in self.free]),
        )

    def of(self, values: Sequence[float] | np.ndarray) -> np.ndarray:
        """Coordinates of values (p,)."""
        array = np.asarray(values, dtype=np.float64)
        return np.where(self.log, np.log(np.where(self.log, array, 1.0)), array) / self.units

    def clip(self, at: np.ndarray) -> np.ndarray:
        """The nearest coordinates within the ranges."""
        return np.clip(at, self.low, self.high)

    def values(self, at: np.ndarray) -> np.ndarray:
        """Values (p,) at coordinates."""
        at = np.asarray(at) * self.units
        return np.where(self.log, np.exp(np.where(self.log, at, 0.0)), at)

    def named(self, at: np.ndarray) -> dict[str, float]:
        """Values by name."""
        return dict(zip(self.names, self.values(at).tolist(), strict=True))

    def slopes(self, at: np.ndarray) -> np.ndarray:
        """Derivative of each value by its coordinate, (p,)."""
        return np.where(self.log, self.values(at), 1.0) * self.units

    def neighbours(self, at: np.ndarray, index: int, step: float = STEP) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates a step above and below in one place; at an end of the range both are within it."""
        middle, steps = np.array(at, dtype=np.float64), step * np.eye(len(at))[index]
        middle[index] = np.clip(middle[index], self.low[index] + step, self.high[index] - step)
        return middle + steps, middle - steps

    def start(self, start_values: dict[str, float] | None = None) -> np.ndarray:
        """Coordinates of given values, of the defaults of parameters without; ValueError outside the range."""
        start_values = start_values or {}
        unknown = sorted(set(start_values) - set(self.names))
        if unknown:
            raise ValueError(f"a start must name free parameters, {', '.join(self.names)}, but got {unknown}")
        values = []
        for parameter in self.free:
            value = finite(f"the start of {parameter.name}", start_values.get(parameter.name, parameter.start))
            if not parameter.low <= value <= parameter.high:
                raise ValueError(
                    f"the start of {parameter.name} must be within {parameter.low:g} and "
                    f"{parameter.high:g}, but got {value:g}"
                )
            values.append(value)
        return self.of(values)


class Problem(ABC):
    """A plant that makes data, and a family of models that filters may assume for it.

    Scenarios of the thruster are problems, and so are a `ModelProblem`, an `EnvProblem` and a `LogProblem`. A
    problem has to define the attributes and the abstract members; the others have a default.

    Attributes:
        name: by which it is found: that of a built-in one, FILE.toml, or "module:object".
        about: one line for tables and help.
        scale: by which the score divides the error of each state, (n,): positive, infinite for states that do not
            count; None where the data have no truth. It depends neither on a filter nor on the assumed model.
    """

    name: str
    about: str
    scale: Sequence[float] | None
    seed_word: ClassVar[str] = "seeds"  # name of its seeds in messages

    def __repr__(self) -> str:
        """The class and the name."""
        return f"{type(self).__name__}({self.name!r})"

    @property
    @abstractmethod
    def digest(self) -> str:
        """A short hash of the whole problem, without `name` and `about`."""

    @abstractmethod
    def model(self, **changes) -> StateSpaceModel:
        """The model that a filter assumes, with some changes.

        Covariances are per step and do not scale with dt. Every problem takes `process_noise_cov`,
        `measurement_noise_cov` and `prior_cov_factor`, a factor on P_0; and the names of its `parameters`.
        """

    @abstractmethod
    def data(self, seeds: Sequence[int]) -> Data:
        """Inputs, measurements and, where it is known, truth for seeds: the same for the same seeds."""

    def training_seeds(self, seed: int, count: int) -> range:
        """Training seeds of a study with a given seed: `count` of them, or all that the problem has."""
        return seeds.training_seeds(seed, count)

    def size_seeds(self, seed: int, count: int) -> range:
        """Seeds on which a study with a given seed chooses the ensemble size, and nothing else."""
        return seeds.size_seeds(seed, count)

    def validation_seeds(self, seed: int, count: int) -> range:
        """Seeds on which the best trials of a study with a given seed meet the baselines, and nothing else."""
        return seeds.validation_seeds(seed, count)

    def held_out_seeds(self, seed: int, count: int) -> range:
        """Seeds that a study with a given seed never sees."""
        return seeds.held_out_seeds(seed, count)

    def long_runs(self, seed: int) -> list[Run]:
        """Two runs of full length that a study with a given seed may see, along which gains settle."""
        return runs_of(self.data(self.training_seeds(seed, 2)[:2]))

    @property
    def shortest_log(self) -> int | None:
        """Number of steps of the shortest of the given logs; None without logs."""
        return None

    def logs_of(self, seeds: Sequence[int]) -> np.ndarray | None:
        """The number of the log of each block, (B,), whose neighbours are dependent; None for independent runs."""
        return None

    @property
    def log_names(self) -> tuple[str, ...]:
        """The names of the logs, by the numbers of `logs_of`; none without logs."""
        return ()

    def started_for(self, name: str, model: StateSpaceModel) -> StateSpaceModel:
        """The model with the prior with which a filter of this name begins its runs: the model's own."""
        return model

    def run_label(self, seed: int) -> str:
        """A run in a sentence: "seed 1007", or the log and the times of a block."""
        return f"seed {seed}"

    @property
    @abstractmethod
    def untuned(self) -> Mapping:
        """Arguments of the model by rule of thumb: R from the data sheet, Q from 1 % of each state's range."""

    @property
    def remarks(self) -> tuple[str, ...]:
        """Remarks on the data, shown before any result: sentences of commands and reports."""
        return ()

    @property
    def given(self) -> Mapping | None:
        """Model arguments given by the user's model, preset or file, before any tuning.

        None if there are none. They may equal `true`, those of the plant.
        """
        return None

    @property
    def lacks_ranges(self) -> bool:
        """Whether the Q of `untuned` is the model's own, because no range of its states is known."""
        return False

    @property
    def true(self) -> Mapping | None:
        """Arguments of the oracle's model, with the plant's own Q and R; None if they are unknown."""
        return None

    def bound(self, data: Data) -> np.ndarray:
        """Bound on the standard error of each state over scored steps, (n,); NaN where there is no bound."""
        return np.full(self.model().n if self.scale is None else len(self.scale), np.nan)

    @property
    def scale_about(self) -> str:
        """A description of `scale` for captions: a bound, a spread, or what the problem gives."""
        return GIVEN

    def make_env(self, **arguments: Any) -> gym.Env:
        """A Gymnasium env of the plant, for wrappers and policies; an episode of a seed is the data of that seed.

        By default filters with this env assume the model that it offers: `EstimateState(problem.make_env(),
        tuned=...)`, or "ekf".

        Args:
            **arguments: of the env, such as `render_mode`.

        Raises:
            ValueError: if the problem has none, or an argument is off.
        """
        raise ValueError(f"make_env must be of a problem that has an env, but {self.name} has none")

    @cached_property  # every trial asks for them, and a model takes half a millisecond
    def quantities(self) -> Quantities:
        """Names, symbols and units of states, inputs and measurements."""
        return self.model().quantities

    @property
    def errors(self) -> tuple[Quantity, ...]:
        """Those of errors of the state, of which Q, P and the scale are: of rotations the components in rad."""
        return tangent_of(self.model())

    @property
    def innovations(self) -> tuple[Quantity, ...]:
        """Those of innovations, of which R is: of measured rotations the components in rad."""
        return innovations_of(self.model())

    @property
    def parameters(self) -> tuple[Parameter, ...] | None:
        """Parameters of the model that a study tunes; None for the variances of Q and R."""
        return None

    @property
    def counts_start_up(self) -> bool:
        """Whether the first steps are scored, on which P_0 has an effect: a study then tunes its scale, too."""
        return False

    @property
    def leads_in(self) -> bool:
        """Whether the steps before the first scored one are a lead-in, which is left out of likelihoods, too."""
        return False

    @property
    def dt(self) -> float | None:
        """Sample time [s]; None if there is none. Covariances are per step and do not scale with dt."""
        return None

    @property
    def held(self) -> Mapping:
        """Arguments by which `model` differs from the plant in every choice, for a model made from an env."""
        return {}

    @property
    def plant_data(self) -> Mapping | None:
        """The plant as data, which tuned files store for `check_tuned_for`, here and of envs; None without."""
        return None

    def check_tuned_for(self, plant: Mapping | None, file: str | Path) -> None:
        """Raise ValueError if the `plant_data` of a tuned file is another plant; None is not compared."""
        return None

    def as_mapping(self) -> Mapping | None:
        """The complete problem as data for JSON; None if it is code, or found by its name."""
        return None


def score_label(problems: Sequence[Problem]) -> str:
    """What axes call the score of some problems: over the bound where that is the scale of them all."""
    bounds = all(problem.scale_about in (BOUND, PATH_BOUND) for problem in problems)
    return f"score: mean RMSE over {'bound' if bounds else 'scale'} [-]"
