"""A problem whose filters also estimate constants of their model: "mismatch+voltage_gain" is one by its name."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from filters.augmented import Unknown, augmented_model
from filters.consistency.time_constants import Run
from filters.consistency.verdicts import estimable
from filters.tuned_file import AUGMENTED, PRIOR
from thruster_env.core.checks import one_of, positive, short_repr
from thruster_env.model.state_space import StateSpaceModel
from tuning.problems.assumed import rows_argument
from tuning.problems.data import Data
from tuning.problems.digest import digest_of
from tuning.problems.problem import Problem

NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
CONSTANT = re.compile(rf"\+([A-Za-z_]\w*(?::{NUMBER}){{0,3}})$")  # at the end of a name: NAME:STD:WALK:MEAN
RULE = "a constant to estimate (--augment) must be NAME, NAME:STD, NAME:STD:WALK or NAME:STD:WALK:MEAN"
# Default belief of a constant: standard deviation of a flow [m/s], of others as a fraction of their value ...
FLOW_STD, RELATIVE_STD, WALK_PART = 0.5, 0.2, 0.02  # ... and of a step's change, as a fraction of the prior's
Unknowns = Mapping[str, Unknown | None]


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
