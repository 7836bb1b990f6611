"""Samplers that draw Q and R within a box in their ranges, which grows as the best trial nears a side of it.

Ranges are so wide that no truth lies outside, and most of their values are implausible.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import optuna
from optuna.distributions import BaseDistribution, FloatDistribution
from optuna.trial import FrozenTrial, TrialState

from tuning.search.outcome import best_trial

MARGIN = 10.0  # factor by which the box reaches beyond the best trial


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
    found = dict(space)
    for name, (low, high) in first.items():
        one = space.get(name)
        if isinstance(one, FloatDistribution):
            if name in best:
                low, high = min(low, best[name] / MARGIN), max(high, best[name] * MARGIN)
            found[name] = FloatDistribution(max(low, one.low), min(high, one.high), log=one.log)
    return found


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
