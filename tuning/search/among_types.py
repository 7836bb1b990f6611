"""Trials that a study over several filter types begins with, and those that compare the types.

NIS is the normalised innovation squared.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import optuna
from optuna.trial import FrozenTrial, TrialState

from tuning.evaluation.baselines import noise_estimated
from tuning.search.cost import COST
from tuning.search.gradient_noise import noise_by_gradient
from tuning.search.new_trials import is_near
from tuning.search.outcome import best_trial, is_over_budget
from tuning.search.parameters import R
from tuning.search.plan import Plan
from tuning.search.space import FILTER_TYPE, ends_of, trial_parameters, untuned_choice, within_ranges

# Attributes of trials. Their texts are in journals and databases, so they stay as they were first written.
UNTUNED = "untuned"  # the filter whose parameters before any tuning these are
ESTIMATED_Q = "estimated Q of"  # the filter that has the Q of noise estimation, and the R of the data sheet
ESTIMATED = "estimated noise of"  # the filter that has both from noise estimation
SMALLER = "smaller ensemble of"  # number of the trial that was over the budget
TRANSFERRED = "noise of"  # number of the trial of another filter type that Q and R are from
FIRST_ROUND = 3  # trials for each filter type, after which the noise of the best trial is tried with all types
ROOM = 0.9  # part of the budget that a smaller ensemble may take


def enqueue_next_type(study: optuna.Study, plan: Plan) -> None:
    """Enqueue the next first trial of a filter type, once all other enqueued trials have been run.

    So each is tried with its Q and R rescaled before the next one begins: filters of different types can be
    compared only where their innovations are consistent.
    """
    trials = study.get_trials(deepcopy=False)
    if any(one.state == TrialState.WAITING for one in trials) or (trials and UNTUNED not in trials[0].user_attrs):
        return  # a study that begins with something else has enqueued all at once
    for key, name in _first_trials(plan):
        if not any(one.user_attrs.get(key) == name for one in trials):
            parameters = _first_parameters(study, plan, key, name)
            if parameters is not None and not any(is_near(one.params, parameters) for one in trials):
                study.enqueue_trial(parameters, user_attrs={key: name})
                return


def _first_trials(plan: Plan) -> Iterator[tuple[str, str]]:
    """The first filter type untuned; then of several types each with what noise estimation says of Q, and of both.

    Untuned filters do not show which type is best. The R of noise estimation contains all that the sensor does,
    outliers included: a filter that models these does better with that of the data sheet.
    """
    yield UNTUNED, plan.filter_types[0]
    if len(plan.filter_types) > 1:
        yield from ((ESTIMATED_Q, name) for name in plan.filter_types)
        yield from ((ESTIMATED, name) for name in plan.filter_types)


def _first_parameters(study: optuna.Study, plan: Plan, key: str, name: str) -> dict | None:
    """The parameters of a first trial; None if the filter type is over the budget."""
    space, untuned = plan.space(), untuned_choice(name, plan.scenarios[0])
    if key == UNTUNED:
        return within_ranges(trial_parameters(untuned, space), space)
    tried = [one for one in study.get_trials(deepcopy=False) if one.params.get(FILTER_TYPE) == name]
    within = [one for one in tried if not is_over_budget(one)]
    if tried and not within:
        return None
    own = within[-1].params if within else trial_parameters(untuned, space)
    return within_ranges({**own, **(_estimated(study, plan, with_r=key == ESTIMATED) or {})}, space)


def _estimated(study: optuna.Study, plan: Plan, with_r: bool) -> dict | None:
    """Q, and R if asked for, from true states; without these the likeliest ones, and None if there are none.

    Parameters of a problem's own have both at once, and are then the likeliest ones.
    """
    name, problem = plan.filter_types[0], plan.scenarios[0]
    choice = noise_estimated(name, problem, plan.seed)
    if choice is None or (problem.parameters is not None and with_r):
        return noise_by_gradient(study, plan)
    if not with_r and problem.parameters is None:
        choice = choice._replace(model={**choice.model, R: untuned_choice(name, problem).model[R]})
    return _shared(trial_parameters(choice, plan.space()))


def _shared(parameters: Mapping) -> dict:
    """Those of a trial's parameters that all filter types have: Q and R, or the problem's own."""
    return {name: value for name, value in parameters.items() if name != FILTER_TYPE and " " not in name}


def enqueue_smaller_ensemble(study: optuna.Study, plan: Plan, last: FrozenTrial, budget: float) -> None:
    """Enqueue the first trial of a filter type that is over the budget with as many members as the budget allows.

    The time of a step grows with the ensemble.
    """
    names = [name for name in last.params if name == "N" or name.endswith(" N")]
    first = last.number == 0 or UNTUNED in last.user_attrs or ESTIMATED_Q in last.user_attrs
    if not first or not is_over_budget(last) or not names:
        return
    size = int(ROOM * last.params[names[0]] * budget / last.user_attrs[COST])
    low, _ = ends_of(plan.space()[names[0]])
    if size >= low:
        study.enqueue_trial({**last.params, names[0]: size}, user_attrs={SMALLER: last.number})


def ends_a_round(trials: int, filter_types: int) -> bool:
    """Whether a study of so many filter types has 3, 6, 12, ... times as many trials."""
    doublings, rest = divmod(trials, FIRST_ROUND * filter_types)
    return rest == 0 and doublings > 0 and doublings & (doublings - 1) == 0


def enqueue_transferred_noise(study: optuna.Study) -> None:
    """Enqueue the Q and R of the best trial with every other filter type that has been within the budget.

    Untuned filters do not show which type is best, and a sampler soon keeps to the type that it tuned first.
    """
    finished = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE, TrialState.PRUNED))
    best = best_trial(finished)
    if best is None:
        return
    latest = {trial.params[FILTER_TYPE]: trial for trial in finished if not is_over_budget(trial)}
    for name, trial in latest.items():
        if name != best.params[FILTER_TYPE]:
            study.enqueue_trial({**trial.params, **_shared(best.params)}, user_attrs={TRANSFERRED: best.number})
