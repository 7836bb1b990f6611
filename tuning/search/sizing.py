"""The ensemble size of a study's choice, from a table stored in the study."""

from __future__ import annotations

from collections.abc import Sequence

import optuna

from filters.registry import filter_type
from tuning.evaluation.sizes import SizeRow, close_size, ensemble_sizes, sufficient_size
from tuning.evaluation.stored import sizes_as_data, stored_sizes
from tuning.problems.data import Data
from tuning.search.plan import Plan
from tuning.search.space import Choice

SIZES = "ensemble sizes"  # attribute of a study: their table, with its digest


def sizes_of(
    study: optuna.Study, choice: Choice, plan: Plan, data: Sequence[Data], consistent: bool
) -> list[SizeRow]:
    """The table of ensemble sizes of a choice, stored with the study; empty if there is none."""
    if not filter_type(choice.name).has_ensemble or len(plan.objectives) > 1:
        return []
    kept = stored_sizes(study.user_attrs.get(SIZES), choice, plan)
    if kept is None:
        kept = ensemble_sizes(choice, plan, data, consistent)
        study.set_user_attr(SIZES, sizes_as_data(kept, choice, plan))
    return kept


def sized(choice: Choice, plan: Plan, data: Sequence[Data], sizes: Sequence[SizeRow], consistent: bool) -> Choice:
    """A choice with the smallest sufficient ensemble; unchanged without an ensemble."""
    if sizes:
        return choice.with_size(sufficient_size(sizes, consistent))
    recorded = all(scenario.leads_in for scenario in plan.scenarios)
    if filter_type(choice.name).has_ensemble and len(plan.objectives) == 1 and recorded:
        return choice.with_size(close_size(choice, plan, data))
    return choice
