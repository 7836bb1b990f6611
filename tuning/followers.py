"""Trials that a finished one calls for: what a sampler would find by chance, and late."""

from __future__ import annotations

import numpy as np
import optuna
from optuna.trial import FrozenTrial, TrialState

from tuning.cost import COST
from tuning.outcome import best_trial, is_over_budget, violation
from tuning.plan import Plan
from tuning.space import KIND
from tuning.trials import NIS

TWIN = "consistent twin"  # attribute: how often a trial's Q and R have been scaled
TWINS = 2  # so often at most: nonlinear filters may need a second time
SMALLER = "smaller ensemble of"  # attribute: number of the trial that was over the budget
HEIR = "noise of"  # attribute: number of the trial of another kind that Q and R are from
FIRST_ROUND = 3  # trials for each kind, after which the noise of the best one is tried with all
ROOM = 0.9  # of the budget, for which a smaller ensemble is meant


def enqueue_followers(study: optuna.Study, plan: Plan, last: FrozenTrial) -> None:
    """Ask for what the last trial calls for: a consistent twin, a smaller ensemble, its noise for other kinds."""
    if plan.is_constrained and not plan.hold_r:
        _enqueue_consistent_twin(study, plan, last)
    if plan.budget is not None and last.number < len(plan.kinds):
        _enqueue_smaller_ensemble(study, plan, last)
    if len(plan.kinds) > 1 and _ends_a_round(last.number + 1, len(plan.kinds)):
        _enqueue_heirs(study, plan)


def _enqueue_consistent_twin(study: optuna.Study, plan: Plan, last: FrozenTrial) -> None:
    """Ask for the last trial with Q and R scaled by its mean NIS, if it is the better for being inconsistent.

    A common factor on Q and R (and P_0, where it is chosen) leaves the gain of a linear filter as it is, and
    divides the NIS: without this a sampler would have to find by chance, for every good ratio of Q and R, the one
    scale that is consistent.
    """
    if (
        last.state != TrialState.COMPLETE
        or violation(last) <= 0
        or NIS not in last.user_attrs
        or last.user_attrs.get(TWIN) == TWINS
    ):
        return
    best = best_trial(study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)))
    if violation(best) <= 0 and best.values[0] < last.values[0]:
        return
    space, factor = plan.space(), last.user_attrs[NIS]
    scaled = {
        name: float(np.clip(factor * value, space[name].low, space[name].high))
        for name, value in last.params.items()
        if name in ("R", "P0") or name.startswith("Q")
    }
    twin = {TWIN: last.user_attrs.get(TWIN, 0) + 1, f"{TWIN} of": last.number}
    study.enqueue_trial({**last.params, **scaled}, user_attrs=twin)


def _enqueue_smaller_ensemble(study: optuna.Study, plan: Plan, last: FrozenTrial) -> None:
    """Ask for an untuned filter that is over the budget with as many members as the budget allows.

    The time of a step grows with the ensemble.
    """
    names = [name for name in last.params if name == "N" or name.endswith(" N")]
    if not is_over_budget(last) or not names:
        return
    size = int(ROOM * last.params[names[0]] * plan.budget / last.user_attrs[COST])
    if size >= plan.space()[names[0]].low:
        study.enqueue_trial({**last.params, names[0]: size}, user_attrs={SMALLER: last.number})


def _ends_a_round(trials: int, kinds: int) -> bool:
    """Whether a study of so many kinds has 3, 6, 12, ... times as many trials."""
    doublings, rest = divmod(trials, FIRST_ROUND * kinds)
    return rest == 0 and doublings > 0 and doublings & (doublings - 1) == 0


def _enqueue_heirs(study: optuna.Study, plan: Plan) -> None:
    """Ask for the Q and R of the best trial with every other kind that has been within the budget.

    Untuned filters do not tell which kind is best, and a sampler soon keeps to the kind that it tuned first.
    """
    finished = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE, TrialState.PRUNED))
    best = best_trial(finished)
    if best is None:
        return
    shared = {name: value for name, value in best.params.items() if name != KIND and " " not in name}
    latest = {trial.params[KIND]: trial for trial in finished if not is_over_budget(trial)}
    for kind, trial in latest.items():
        if kind != best.params[KIND]:
            study.enqueue_trial({**trial.params, **shared}, user_attrs={HEIR: best.number})
