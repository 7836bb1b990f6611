"""Optuna's samplers by name: how a study proposes its next choice."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping

import numpy as np
import optuna
from optuna.trial import FrozenTrial, TrialState

from numerics.checks import one_of
from tuning.search.cma_es import CmaEsSampler
from tuning.search.space import KIND

SAMPLERS = {
    "tpe": "tree-structured Parzen estimator, all numbers together; good from some ten trials on",
    "gp": "Gaussian process; the fewest trials, but 0.1 to 0.4 s for each proposal (needs torch)",
    "cma-es": "covariance matrix adaptation; good for many trials of a smooth error (needs cmaes)",
    "nsga-ii": "genetic, made for two objectives",
    "random": "independent draws, what every other sampler should beat",
    "grid": "every combination of some values of each number, in random order",
}
WITHOUT_KINDS = ("cma-es", "grid")  # which cannot choose among filters with numbers of their own
GRID_VALUES = 5  # of each number
NEEDS = {"gp": ("torch", "rl"), "cma-es": ("cmaes", "samplers")}


def make_sampler(
    name: str, seed: int, present: int, distributions: Mapping, worker: int = 0
) -> optuna.samplers.BaseSampler:
    """A sampler.

    Args:
        name: one of SAMPLERS.
        seed: the study's; the same seed gives the same study in one process.
        present: trials that the study has; a sampler with the same seed would repeat its first trials on resume.
        distributions: of all numbers by name, from which a grid is made.
        worker: place among the processes that share the study; each proposes what is its own.

    Raises:
        ValueError: for an unknown name, a missing package, or one that cannot choose among kinds of filters.
    """
    one_of("sampler", name, tuple(SAMPLERS))
    package, extra = NEEDS.get(name, (None, None))
    if package is not None and importlib.util.find_spec(package) is None:
        raise ValueError(f"the sampler {name!r} needs {package}: pip install 'thruster-env[{extra}]'")
    if name in WITHOUT_KINDS and KIND in distributions:
        able = ", ".join(one for one in SAMPLERS if one not in WITHOUT_KINDS)
        raise ValueError(f"a sampler that chooses among filters must be one of {able}, but got {name!r}")
    if name == "grid":  # its order, and so its seed, has to be the same in every process
        values = {key: _grid(distribution) for key, distribution in distributions.items()}
        return optuna.samplers.GridSampler(values, seed=seed)
    seed = int(np.random.SeedSequence([seed, present, worker]).generate_state(1)[0])
    makers = {
        "tpe": optuna.samplers.TPESampler,
        "gp": optuna.samplers.GPSampler,
        "cma-es": CmaEsSampler,
        "nsga-ii": optuna.samplers.NSGAIISampler,
        "random": optuna.samplers.RandomSampler,
    }
    return makers[name](seed=seed)


def give_sampler(study: optuna.Study, make: Callable[[int], optuna.samplers.BaseSampler], present: int) -> None:
    """Give a study the sampler of place 0, or, if another process works on it too, that of a place of its own.

    Processes that open a study at the same number of trials would propose alike. But no two trials have the same
    number: of all that they sample, only the first finds none before it that its process has not run itself. Who
    finds one takes the number of its own trial as its place.

    Args:
        study: which this process runs trials of.
        make: makes the sampler of a place.
        present: trials that the study had before the process added any.
    """
    first, own = make(0), set()
    proceed = first.before_trial

    def look(_, trial: FrozenTrial) -> None:
        own.add(trial.number)
        if "fixed_params" not in trial.system_attrs:  # of what is queued nothing is sampled
            first.before_trial = proceed
            begun = (t.number for t in study.get_trials(deepcopy=False)[present:] if t.state != TrialState.WAITING)
            if any(number < trial.number and number not in own for number in begun):
                study.sampler = make(trial.number)
        (proceed if study.sampler is first else study.sampler.before_trial)(study, trial)

    first.before_trial = look
    study.sampler = first


def _grid(distribution: optuna.distributions.BaseDistribution) -> list:
    """Some values over the range of a number, evenly on its own scale."""
    if isinstance(distribution, optuna.distributions.CategoricalDistribution):
        return list(distribution.choices)
    spaced = np.geomspace if distribution.log else np.linspace
    values = spaced(distribution.low, distribution.high, GRID_VALUES)
    if isinstance(distribution, optuna.distributions.IntDistribution):
        return sorted({int(round(value)) for value in values})
    return [float(np.clip(value, distribution.low, distribution.high)) for value in values]
