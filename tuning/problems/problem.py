"""`Problem`: the interface between a plant and studies, evaluations and reports."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np

from filters.consistency.time_constants import Run
from thruster_env.model.quantities import Quantities
from thruster_env.model.state_space import StateSpaceModel
from tuning.problems import data as seeds
from tuning.problems.data import Data, runs_of
from tuning.problems.parameter import Parameter

BOUND = "the posterior Cramér-Rao bound"  # what a scale is, in words
PATH_BOUND = "the bound along noise-free paths"
OPEN_LOOP = "the RMSE of the open loop"
SPREAD = "the standard deviation of the true states"
GIVEN = "the scale given with the problem"


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
