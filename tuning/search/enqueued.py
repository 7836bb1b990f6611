"""Trials that a finished trial calls for: a sampler would find them by chance only, and late.

NIS is the normalised innovation squared.
"""

from __future__ import annotations

import math
from numbers import Real

import numpy as np
import optuna
from optuna.trial import FrozenTrial, TrialState

from tuning.likelihood.gradient import is_large, optimum
from tuning.search.cost import COST
from tuning.search.outcome import best_trial, is_consistent, is_over_budget
from tuning.search.parameters import model_parameters
from tuning.search.plan import Plan
from tuning.search.space import FILTER_TYPE, ends_of, trial_parameters, untuned_choice
from tuning.search.trials import NIS

# Attributes of trials. Their texts are in journals and databases, so they stay as they were first written.
UNTUNED = "untuned"  # the filter whose parameters before any tuning these are
RESCALED = "consistent twin"  # how often the trial's Q and R have been rescaled
SMALLER = "smaller ensemble of"  # number of the trial that was over the budget
TRANSFERRED = "noise of"  # number of the trial of another filter type that Q and R are from
MAXIMUM_LIKELIHOOD = "likeliest noise"  # Q and R have maximum likelihood
NEAR = 2e-5  # relative difference of parameters, above which trials are certainly not equal
MOST_RESCALINGS = 2  # nonlinear filters may need a second one
FIRST_ROUND = 3  # trials for each filter type, after which the noise of the best trial is tried with all types
ROOM = 0.9  # part of the budget that a smaller ensemble shall take
MAXIMUM_LIKELIHOOD_AFTER = 20  # trials
MAXIMUM_LIKELIHOOD_RUNS = 8  # of a model with many states: they determine Q and R well enough for a trial


def enqueue_what_is_left(study: optuna.Study, plan: Plan) -> None:
    """Enqueue what an interrupted study left out: the rescaled last trial, and the next filter type."""
    finished = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    if finished and _rescales(plan):
        _enqueue_rescaled(study, plan, finished[-1])
    _enqueue_untuned(study, plan)


def enqueue_after(study: optuna.Study, plan: Plan, last: FrozenTrial) -> None:
    """Enqueue the trials that the last one calls for.

    These are the same trial with rescaled Q and R, a smaller ensemble, the Q and R of maximum likelihood, and its
    Q and R for other filter types; and the next filter type when these are done.
    """
    if _rescales(plan):
        _enqueue_rescaled(study, plan, last)
    if plan.budget is not None and (last.number == 0 or UNTUNED in last.user_attrs):
        _enqueue_smaller_ensemble(study, plan, last, plan.budget)
    if last.number == MAXIMUM_LIKELIHOOD_AFTER - 1 and not plan.hold_r and plan.tunes_noise:
        _enqueue_maximum_likelihood(study, plan)
    count = len(plan.filter_types)
    if count > 1 and _ends_a_round(last.number + 1, count):
        _enqueue_transferred_noise(study)
    _enqueue_untuned(study, plan)


def _rescales(plan: Plan) -> bool:
    return plan.is_constrained and not plan.hold_r and plan.tunes_noise


def _enqueue_untuned(study: optuna.Study, plan: Plan) -> None:
    """Enqueue the untuned filter of the plan's next filter type, once all other enqueued trials have been run.

    So each filter type is tried with its Q and R rescaled before the next one begins: untuned filters of different
    types can be compared only where their innovations are consistent.
    """
    trials = study.get_trials(deepcopy=False)
    begun = [trial.user_attrs.get(UNTUNED) for trial in trials]
    if begun[:1] == [None]:
        return  # a study that begins with something else has enqueued all at once
    name = next((name for name in plan.filter_types if name not in begun), None)
    if name is not None and not any(trial.state == TrialState.WAITING for trial in trials):
        choice = untuned_choice(name, plan.scenarios[0])
        study.enqueue_trial(trial_parameters(choice, plan.space()), user_attrs={UNTUNED: name})


def _enqueue_rescaled(study: optuna.Study, plan: Plan, last: FrozenTrial) -> None:
    """Enqueue the last trial with Q and R multiplied by its mean NIS, if it is inconsistent and could be the best.

    A common factor on Q and R (and P_0, where it is chosen) leaves the gain of a linear filter as it is, and
    divides the NIS: without this a sampler would have to find by chance, for every good ratio of Q and R, the one
    scale that is consistent.
    """
    if (
        last.state != TrialState.COMPLETE
        or is_consistent(last)
        or NIS not in last.user_attrs
        or last.user_attrs.get(RESCALED) == MOST_RESCALINGS
    ):
        return
    best = best_trial(study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)))
    if best is not None and is_consistent(best) and best.values[0] < last.values[0]:
        return
    parameters, factor = plan.parameters(), last.user_attrs[NIS]
    scaled = {
        name: float(np.clip(factor * value, parameters[name].low, parameters[name].high))
        for name, value in last.params.items()
        if name in parameters and parameters[name].place.is_variance
    }
    attributes = {RESCALED: last.user_attrs.get(RESCALED, 0) + 1, f"{RESCALED} of": last.number}
    enqueue_new(study, {**last.params, **scaled}, attributes)


def enqueue_new(study: optuna.Study, parameters: dict, attributes: dict) -> None:
    """Enqueue a trial unless there is one with these parameters.

    Optuna compares it with all trials, one parameter at a time by NumPy: so it is asked only where one is near.
    """
    trials = study.get_trials(deepcopy=False)
    near = any(not one.state.is_finished() or _is_near(one.params, parameters) for one in trials)
    study.enqueue_trial(parameters, user_attrs=attributes, skip_if_exists=near)


def _is_near(one: dict, other: dict) -> bool:
    """Whether no parameter that both have differs by more than what Optuna takes as equal, 1e-5."""
    for name, value in other.items():
        if isinstance(value, Real) and isinstance(one.get(name, ""), Real):
            if not math.isclose(value, one[name], rel_tol=NEAR):
                return False
        elif name in one and one[name] != value:
            return False
    return True


def _enqueue_smaller_ensemble(study: optuna.Study, plan: Plan, last: FrozenTrial, budget: float) -> None:
    """Enqueue an untuned filter that is over the budget with as many members as the budget allows.

    The time of a step grows with the ensemble.
    """
    names = [name for name in last.params if name == "N" or name.endswith(" N")]
    if not is_over_budget(last) or not names:
        return
    size = int(ROOM * last.params[names[0]] * budget / last.user_attrs[COST])
    low, _ = ends_of(plan.space()[names[0]])
    if size >= low:
        study.enqueue_trial({**last.params, names[0]: size}, user_attrs={SMALLER: last.number})


def _enqueue_maximum_likelihood(study: optuna.Study, plan: Plan) -> None:
    """Enqueue the best trial with the Q and R under which the innovations are most likely.

    They are those of the first scenario's model in an extended Kalman filter, or in the Kalman filter where that
    is tuned. Near the best Q and R the score is so flat that a sampler finds the place late; where the model is
    wrong the trial is one among many. On recorded runs they are also tried with all else untuned.
    """
    best = best_trial(study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)))
    if best is None:
        return
    name = "kf" if plan.filter_types == ("kf",) else "ekf"
    data = plan.training_data()[0]
    data = data.slice(0, MAXIMUM_LIKELIHOOD_RUNS) if is_large(plan.scenarios[0]) else data
    found = optimum(name, plan.scenarios[0], data)
    names = [one.name for one in model_parameters(plan.scenarios[0])]
    space = plan.space()
    noise = {
        name: float(np.clip(value, *ends_of(space[name])))
        for name, value in zip(names, found.variances, strict=True)
    }
    study.enqueue_trial({**best.params, **noise}, user_attrs={MAXIMUM_LIKELIHOOD: True})
    if any(problem.leads_in for problem in plan.scenarios):  # recorded runs, whose likelihood is all there is
        filter_type = best.params.get(FILTER_TYPE, plan.filter)
        plain = trial_parameters(untuned_choice(filter_type, plan.scenarios[0]), space)
        enqueue_new(study, {**plain, **noise}, {MAXIMUM_LIKELIHOOD: True})


def _ends_a_round(trials: int, filter_types: int) -> bool:
    """Whether a study of so many filter types has 3, 6, 12, ... times as many trials."""
    doublings, rest = divmod(trials, FIRST_ROUND * filter_types)
    return rest == 0 and doublings > 0 and doublings & (doublings - 1) == 0


def _enqueue_transferred_noise(study: optuna.Study) -> None:
    """Enqueue the Q and R of the best trial with every other filter type that has been within the budget.

    Untuned filters do not show which type is best, and a sampler soon keeps to the type that it tuned first.
    """
    finished = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE, TrialState.PRUNED))
    best = best_trial(finished)
    if best is None:
        return
    shared = {name: value for name, value in best.params.items() if name != FILTER_TYPE and " " not in name}
    latest = {trial.params[FILTER_TYPE]: trial for trial in finished if not is_over_budget(trial)}
    for name, trial in latest.items():
        if name != best.params[FILTER_TYPE]:
            study.enqueue_trial({**trial.params, **shared}, user_attrs={TRANSFERRED: best.number})
