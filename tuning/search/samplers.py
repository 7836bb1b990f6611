"""Optuna's samplers by name, for ranges so wide that they contain any truth and mostly implausible values.

They draw Q and R within a box about the best trial, and every second trial of the default sampler is near that
trial. The state of CMA-ES, a pickle in the study, is read safely.
"""

from __future__ import annotations

import importlib.util
import io
import pickle
from collections.abc import Callable, Mapping
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np
import optuna
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.trial import FrozenTrial, TrialState

from thruster_env.core.checks import one_of
from thruster_env.core.modules import to_install
from thruster_env.core.streams import LOCAL_TRIALS, derived_generator
from tuning.search.plan import Plan
from tuning.search.space import FILTER_TYPE
from tuning.search.trials import best_trial

MARGIN = 10.0  # factor by which the box reaches beyond the best trial
SAMPLERS = {
    "tpe": "tree-structured Parzen estimator, all parameters together; good from some ten trials on",
    "gp": "Gaussian process; the fewest trials, but 0.1 to 0.4 s for each proposal (needs torch)",
    "cma-es": "covariance matrix adaptation; good for many trials of a smooth error (needs cmaes)",
    "nsga-ii": "genetic, made for two objectives",
    "random": "independent draws, which every other sampler should beat",
    "grid": "every combination of some values of each parameter, in random order",
}
WITHOUT_FILTER_TYPES = ("cma-es", "grid")  # cannot choose among filter types with parameters of their own
GRID_VALUES = 5  # of each parameter
NOTHING: Mapping = MappingProxyType({})
NEEDS = {"gp": ("torch", "rl"), "cma-es": ("cmaes", "samplers")}

# Of a trial near the best one.
LARGEST = 0.1  # step over the width of a linear range; over a decade of a logarithmic one it is ten times this ...
DECADES = 1.5  # ... and the smallest step is so many powers of ten below
MOVED = 0.5  # probability that a number is moved
_OPTIMIZERS = ("CMA", "SepCMA", "CMAwM")


# Samplers that draw Q and R within a box in their ranges, which grows as the best trial nears a side of it.


def box(
    space: Mapping[str, BaseDistribution], first: Mapping[str, tuple[float, float]], best: Mapping[str, Any]
) -> dict[str, BaseDistribution]:
    """The distributions of a space, those of Q and R within their box.

    A side is the initial one or ten times beyond the best trial, whichever is farther, within the range.

    Args:
        space: distributions by name.
        first: the part of a range in which the search begins, by name, for those that have one.
        best: parameters of the best trial; empty before there is one.
    """
    limited = dict(space)
    for name, (low, high) in first.items():
        distribution = space.get(name)
        if isinstance(distribution, FloatDistribution):
            if name in best:
                low, high = min(low, best[name] / MARGIN), max(high, best[name] * MARGIN)
            limited[name] = FloatDistribution(
                max(low, distribution.low), min(high, distribution.high), log=distribution.log
            )
    return limited


class InBox:
    """A sampler that draws within the box, which does not limit enqueued trials and those near the best one."""

    def __init__(self, first: Mapping[str, tuple[float, float]], **options):
        """Remember where the search begins."""
        super().__init__(**options)
        self._first = first

    def infer_relative_search_space(self, study: optuna.Study, trial: FrozenTrial) -> dict[str, BaseDistribution]:
        """The parameters sampled together, within the box."""
        space = super().infer_relative_search_space(study, trial)  # type: ignore[misc]  # of the sampler
        return self._box(study, space)

    def sample_independent(
        self, study: optuna.Study, trial: FrozenTrial, param_name: str, param_distribution: BaseDistribution
    ) -> Any:
        """A value of one parameter, within the box."""
        within = self._box(study, {param_name: param_distribution})[param_name]
        return super().sample_independent(study, trial, param_name, within)  # type: ignore[misc]

    def _box(self, study: optuna.Study, space: Mapping[str, BaseDistribution]) -> dict[str, BaseDistribution]:
        best = best_trial(study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)))
        return box(space, self._first, {} if best is None else best.params)


class TpeInBox(InBox, optuna.samplers.TPESampler):
    """The tree-structured Parzen estimator, within the box."""


class GpInBox(InBox, optuna.samplers.GPSampler):
    """The Gaussian process, within the box."""


class RandomInBox(InBox, optuna.samplers.RandomSampler):
    """Independent draws, within the box."""


# Optuna's CMA-ES, which stores its state in the study, made safe for studies of unknown origin.


# The classes in the state of an optimizer of `cmaes`. Any pickle may name any function of any module, and call it.
_ARRAYS = {("numpy", "ndarray"), ("numpy", "dtype")} | {
    (f"numpy.{core}.{module}", name)
    for core in ("_core", "core")  # of NumPy 2 and 1
    for module, name in (("multiarray", "_reconstruct"), ("multiarray", "scalar"), ("numeric", "_frombuffer"))
}


class CmaEsSampler(optuna.samplers.CmaEsSampler):
    """`optuna.samplers.CmaEsSampler` that reads only its own state from a journal or database.

    Optuna unpickles the state in a study's trials, so another person's study could run code.
    """

    def _restore_optimizer(self, completed_trials: list[FrozenTrial]):
        key = self._attr_key_optimizer
        for trial in reversed(completed_trials):
            parts = {name: value for name, value in trial.system_attrs.items() if name.startswith(key)}
            if parts:
                return read_state(self._concat_optimizer_attrs(parts))
        return None


def read_state(text: str):
    """The optimizer stored in a study, a pickle as hexadecimal digits.

    Raises:
        ValueError: if it is not such a state, or names anything but an optimizer of `cmaes` and arrays of NumPy.
    """
    try:
        return _Unpickler(io.BytesIO(bytes.fromhex(text))).load()
    except ValueError:
        raise
    except Exception as error:  # a damaged pickle raises nearly anything
        raise ValueError(f"the state of CMA-ES must be whole, but a trial's is not: {error}") from None


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str):
        if (module, name) in _ARRAYS or (module.partition(".")[0] == "cmaes" and name in _OPTIMIZERS):
            return super().find_class(module, name)
        raise ValueError(f"the state of CMA-ES must be that of an optimizer, but a trial's names {module}.{name}")


def make_sampler(
    name: str, seed: int, present: int, distributions: Mapping, worker: int = 0, first: Mapping = NOTHING
) -> optuna.samplers.BaseSampler:
    """A sampler.

    Args:
        name: one of SAMPLERS.
        seed: seed of the study; the same seed gives the same study in one process.
        present: number of trials in the study, so that a resumed study does not propose its first trials again.
        distributions: of all parameters by name, from which a grid is made.
        worker: index of this process among those that share the study; each has its own random numbers.
        first: the parts of ranges in which a search begins, by name, for samplers that draw within a box.

    Raises:
        ValueError: for an unknown name, a missing package, or one that cannot choose among filter types.
    """
    one_of("sampler", name, tuple(SAMPLERS))
    package, extra = NEEDS.get(name, ("", ""))
    if package and importlib.util.find_spec(package) is None:
        raise ValueError(f"the sampler {name!r} needs {package}, which is not installed: {to_install(extra)}")
    if name in WITHOUT_FILTER_TYPES and FILTER_TYPE in distributions:
        able = ", ".join(sampler for sampler in SAMPLERS if sampler not in WITHOUT_FILTER_TYPES)
        raise ValueError(f"a method (--method) that chooses among filters must be one of {able}, but got {name!r}")
    if name == "grid":  # its order, and so its seed, has to be the same in every process
        values = {key: _grid(distribution) for key, distribution in distributions.items()}
        return optuna.samplers.GridSampler(values, seed=seed)
    seed = int(np.random.SeedSequence([seed, present, worker]).generate_state(1)[0])
    makers: dict[str, Callable[..., optuna.samplers.BaseSampler]] = {
        "tpe": partial(TpeInBox, first),
        "gp": partial(GpInBox, first),
        "cma-es": CmaEsSampler,
        "nsga-ii": optuna.samplers.NSGAIISampler,
        "random": partial(RandomInBox, first),
    }
    return makers[name](seed=seed)


def give_sampler(study: optuna.Study, make: Callable[[int], optuna.samplers.BaseSampler], present: int) -> None:
    """Give a study the sampler of index 0 or, if another process also runs trials of it, one with its own index.

    Processes that open a study at the same number of trials would propose the same trials. But trials have
    different
    numbers: only the process with the first sampled trial finds no earlier trial of another process. Every other
    process takes the number of its own trial as its index.

    Args:
        study: the study whose trials this process runs.
        make: makes the sampler of an index.
        present: number of trials in the study before this process added any.
    """
    first, own_numbers = make(0), set()
    proceed = first.before_trial

    def look(_: optuna.Study, trial: FrozenTrial) -> None:
        own_numbers.add(trial.number)
        if "fixed_params" not in trial.system_attrs:  # nothing is sampled in an enqueued trial
            first.before_trial = proceed  # type: ignore[method-assign]  # of this sampler alone
            begun = (t.number for t in study.get_trials(deepcopy=False)[present:] if t.state != TrialState.WAITING)
            if any(number < trial.number and number not in own_numbers for number in begun):
                study.sampler = make(trial.number)
        (proceed if study.sampler is first else study.sampler.before_trial)(study, trial)

    first.before_trial = look  # type: ignore[method-assign, assignment]  # of this sampler alone
    study.sampler = first


def _grid(distribution: BaseDistribution) -> list:
    """Values over the range of a parameter, evenly spaced on its own scale."""
    if isinstance(distribution, CategoricalDistribution):
        return list(distribution.choices)
    if not isinstance(distribution, FloatDistribution | IntDistribution):
        raise TypeError(f"a grid needs numbers or names, but got {distribution}")
    spaced = np.geomspace if distribution.log else np.linspace
    values = spaced(distribution.low, distribution.high, GRID_VALUES)
    if isinstance(distribution, IntDistribution):
        return sorted({int(round(value)) for value in values})
    return [float(np.clip(value, distribution.low, distribution.high)) for value in values]


# Every second trial of the default sampler is near the best one, so that wide ranges do not slow the search.


def is_local(plan: Plan, number: int) -> bool:
    """Whether the trial after this number is to be near the best: every second one of "tpe" with one objective."""
    return plan.sampler == "tpe" and len(plan.objectives) == 1 and number % 2 == 1


def near(best: Mapping, space: Mapping[str, BaseDistribution], plan: Plan, number: int) -> dict:
    """The parameters of the best trial, some of them changed by normal steps of a common random size.

        log10 x' = log10 x + s n,  n ~ N(0, 1),  log10 s ~ U(-1.5, 0); of a linear range s times a tenth of it

    The same trial number in a study with the same seed gives the same trial.

    Source: Beyer, Schwefel (2002), "Evolution strategies, a comprehensive introduction", Natural Computing 1.
    """
    generator = derived_generator(plan.seed, LOCAL_TRIALS, number)
    size, neighbour = 10.0 ** generator.uniform(-DECADES, 0.0), dict(best)
    names = [name for name in best if isinstance(space.get(name), FloatDistribution | IntDistribution)]
    is_changed = generator.random(len(names)) < MOVED
    if names and not is_changed.any():
        is_changed[generator.integers(len(names))] = True
    for name, step in zip(
        names, np.where(is_changed, size * generator.standard_normal(len(names)), 0.0), strict=True
    ):
        distribution, value = space[name], best[name]
        assert isinstance(distribution, FloatDistribution | IntDistribution)
        if step == 0.0:
            continue
        value = (
            value * 10.0**step
            if distribution.log
            else value + LARGEST * step * (distribution.high - distribution.low)
        )
        value = float(np.clip(value, distribution.low, distribution.high))
        neighbour[name] = round(value) if isinstance(distribution, IntDistribution) else value
    return neighbour
