"""Trials that a finished one calls for: what a sampler would find by chance, and late."""

from __future__ import annotations

import numpy as np
import optuna
from optuna.trial import FrozenTrial, TrialState

from tuning.likelihood.gradient import is_large, optimum
from tuning.search.cost import COST
from tuning.search.outcome import best_trial, is_consistent, is_over_budget
from tuning.search.parameters import model_parameters
from tuning.search.plan import Plan
from tuning.search.space import KIND, trial_parameters, untuned_choice
from tuning.search.trials import NIS

UNTUNED = "untuned"  # attribute: the filter whose numbers before any tuning these are
TWIN = "consistent twin"  # attribute: how often a trial's Q and R have been scaled
TWINS = 2  # so often at most: nonlinear filters may need a second time
SMALLER = "smaller ensemble of"  # attribute: number of the trial that was over the budget
HEIR = "noise of"  # attribute: number of the trial of another kind that Q and R are from
FIRST_ROUND = 3  # trials for each kind, after which the noise of the best one is tried with all
ROOM = 0.9  # of the budget, for which a smaller ensemble is meant
LIKELIEST = "likeliest noise"  # attribute of the trial whose Q and R make the innovations likeliest
LIKELIEST_AFTER = 20  # trials
LIKELIEST_RUNS = 8  # of a model of many states: of Q and R a trial needs no more than these tell


def enqueue_what_is_left(study: optuna.Study, plan: Plan) -> None:
    """Ask for what an end of the study left out: the last trial's twin, and the next kind."""
    finished = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    if finished and _asks_for_twins(plan):
        _enqueue_consistent_twin(study, plan, finished[-1])
    _enqueue_untuned(study, plan)


def enqueue_followers(study: optuna.Study, plan: Plan, last: FrozenTrial) -> None:
    """Ask for what the last trial calls for.

    That is a consistent twin, a smaller ensemble, the likeliest noise, its own noise for other kinds; and the next
    kind when that is done.
    """
    if _asks_for_twins(plan):
        _enqueue_consistent_twin(study, plan, last)
    if plan.budget is not None and (last.number == 0 or UNTUNED in last.user_attrs):
        _enqueue_smaller_ensemble(study, plan, last)
    if last.number == LIKELIEST_AFTER - 1 and not plan.hold_r and plan.tunes_noise:
        _enqueue_likeliest(study, plan)
    if len(plan.kinds) > 1 and _ends_a_round(last.number + 1, len(plan.kinds)):
        _enqueue_heirs(study, plan)
    _enqueue_untuned(study, plan)


def _asks_for_twins(plan: Plan) -> bool:
    return plan.is_constrained and not plan.hold_r and plan.tunes_noise


def _enqueue_untuned(study: optuna.Study, plan: Plan) -> None:
    """Ask for the next untuned filter of the plan's kinds, when nothing else that was asked for is left to run.

    So each kind is tried with its Q and R scaled before the next one is begun: untuned filters of different kinds
    can be compared only where their innovations are consistent.
    """
    trials = study.get_trials(deepcopy=False)
    begun = [trial.user_attrs.get(UNTUNED) for trial in trials]
    if begun[:1] == [None] or any(trial.state == TrialState.WAITING for trial in trials):
        return  # a study that begins with something else has asked for all at once
    kind = next((kind for kind in plan.kinds if kind not in begun), None)
    if kind is not None:
        choice = untuned_choice(kind, plan.scenarios[0])
        study.enqueue_trial(trial_parameters(choice, plan.space()), user_attrs={UNTUNED: kind})


def _enqueue_consistent_twin(study: optuna.Study, plan: Plan, last: FrozenTrial) -> None:
    """Ask for the last trial with Q and R scaled by its mean NIS, if it is the better for being inconsistent.

    A common factor on Q and R (and P_0, where it is chosen) leaves the gain of a linear filter as it is, and
    divides the NIS: without this a sampler would have to find by chance, for every good ratio of Q and R, the one
    scale that is consistent.
    """
    if (
        last.state != TrialState.COMPLETE
        or is_consistent(last)
        or NIS not in last.user_attrs
        or last.user_attrs.get(TWIN) == TWINS
    ):
        return
    best = best_trial(study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)))
    if is_consistent(best) and best.values[0] < last.values[0]:
        return
    parameters, factor = plan.parameters(), last.user_attrs[NIS]
    scaled = {
        name: float(np.clip(factor * value, parameters[name].low, parameters[name].high))
        for name, value in last.params.items()
        if name in parameters and parameters[name].place.is_variance
    }
    twin = {TWIN: last.user_attrs.get(TWIN, 0) + 1, f"{TWIN} of": last.number}
    study.enqueue_trial({**last.params, **scaled}, user_attrs=twin, skip_if_exists=True)


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


def _enqueue_likeliest(study: optuna.Study, plan: Plan) -> None:
    """Ask for the best trial with the Q and R under which the innovations are likeliest.

    They are those of the first scenario's model in an extended Kalman filter, or in the Kalman filter where that
    is tuned. Near the best Q and R the score is so flat that a sampler finds the place late; where the model is
    wrong the trial is one among many. On recorded runs they are also tried with all else untuned.
    """
    best = best_trial(study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)))
    if best is None:
        return
    name = "kf" if plan.kinds == ("kf",) else "ekf"
    data = plan.training_data()[0]
    data = data.slice(0, LIKELIEST_RUNS) if is_large(plan.scenarios[0]) else data
    found = optimum(name, plan.scenarios[0], data)
    names = [one.name for one in model_parameters(plan.scenarios[0])]
    space = plan.space()
    likeliest = {
        name: float(np.clip(value, space[name].low, space[name].high))
        for name, value in zip(names, found.variances, strict=True)
    }
    study.enqueue_trial({**best.params, **likeliest}, user_attrs={LIKELIEST: True})
    if any(problem.leads_in for problem in plan.scenarios):  # recorded runs, whose likelihood is all there is
        kind = best.params.get(KIND, plan.filter)
        plain = trial_parameters(untuned_choice(kind, plan.scenarios[0]), space)
        study.enqueue_trial({**plain, **likeliest}, user_attrs={LIKELIEST: True}, skip_if_exists=True)


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
