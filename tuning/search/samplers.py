"""Optuna's samplers by name."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping
from functools import partial
from types import MappingProxyType

import numpy as np
import optuna
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.trial import FrozenTrial, TrialState

from thruster_env.core.checks import one_of
from thruster_env.core.modules import to_install
from tuning.search.box import GpInBox, RandomInBox, TpeInBox
from tuning.search.cma_es import CmaEsSampler
from tuning.search.space import FILTER_TYPE

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
        able = ", ".join(one for one in SAMPLERS if one not in WITHOUT_FILTER_TYPES)
        raise ValueError(f"a sampler that chooses among filters must be one of {able}, but got {name!r}")
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
    first, own = make(0), set()
    proceed = first.before_trial

    def look(_: optuna.Study, trial: FrozenTrial) -> None:
        own.add(trial.number)
        if "fixed_params" not in trial.system_attrs:  # nothing is sampled in an enqueued trial
            first.before_trial = proceed  # type: ignore[method-assign]  # of this sampler alone
            begun = (t.number for t in study.get_trials(deepcopy=False)[present:] if t.state != TrialState.WAITING)
            if any(number < trial.number and number not in own for number in begun):
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
