"""Trials that a finished trial calls for: a sampler would find them by chance only, and late.

NIS is the normalised innovation squared.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from numbers import Real

import numpy as np
import optuna
from optuna.trial import FrozenTrial, TrialState

from filters.registry import filter_class
from tuning.evaluation.baselines import GIVEN, ORACLE, RULE, baselines
from tuning.likelihood.family import has_gradient, keeps_more
from tuning.likelihood.goal import OF_STATES, Goal
from tuning.likelihood.gradient import goal_of, optimum, start_at, starts_of
from tuning.search.cost import COST
from tuning.search.local import is_local, near
from tuning.search.objectives import LIKELIHOOD, SCORE
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
MAXIMUM_LIKELIHOOD = "likeliest noise"  # Q and R have maximum likelihood; of a study what they are
BY_GRADIENT = "gradient of"  # the objective on the true states, of which Q and R are the minimum; of a study they
NEAR_BEST = "near"  # number of the best trial, of which this one is a variation
BASELINE = "baseline"  # the name of the baseline that the trial is
NEAR = 2e-5  # relative difference of parameters, above which trials are certainly not equal
MOST_RESCALINGS = 2  # nonlinear filters may need a second one
FIRST_ROUND = 3  # trials for each filter type, after which the noise of the best trial is tried with all types
ROOM = 0.9  # part of the budget that a smaller ensemble shall take
MAXIMUM_LIKELIHOOD_AFTER = 20  # trials, after which the likeliest noise is tried with all else of the best one
MOST_FOR_STARTS = 8  # parameters, of which an ascent has more than one start
MOST_STATES = 8  # of a model, in which filters but the linear and the extended one follow their own gradients
MOST_FOR_ALL = 24  # parameters, of which an ascent has all runs
MAXIMUM_LIKELIHOOD_RUNS = 8  # of a model with many states or parameters, and to compare starts: they tell enough


def enqueue_what_is_left(study: optuna.Study, plan: Plan) -> None:
    """Enqueue what an interrupted study left out: the rescaled last trial, and the next filter type."""
    finished = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    if finished and _rescales(plan):
        _enqueue_rescaled(study, plan, finished[-1])
    _enqueue_untuned(study, plan)


def enqueue_after(study: optuna.Study, plan: Plan, last: FrozenTrial) -> None:
    """Enqueue the trials that the last one calls for.

    After the first one these are the baselines and the maximum-likelihood trial, which is repeated later with the
    other parameters of the best trial. Further the same trial with rescaled Q and R, a smaller ensemble, and its Q
    and R for other filter types; and the next filter type when these are done.
    """
    if _rescales(plan):
        _enqueue_rescaled(study, plan, last)
    if plan.budget is not None and (last.number == 0 or UNTUNED in last.user_attrs):
        _enqueue_smaller_ensemble(study, plan, last, plan.budget)
    if last.number == 0 and UNTUNED in last.user_attrs and len(plan.filter_types) == 1:
        _enqueue_baselines(study, plan)
        _enqueue_maximum_likelihood(study, plan, last.params)
        _enqueue_minimum(study, plan, last.params)
    if last.number == MAXIMUM_LIKELIHOOD_AFTER - 1:
        best = best_trial(study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)))
        if best is not None:
            _enqueue_maximum_likelihood(study, plan, best.params)
            _enqueue_minimum(study, plan, best.params)
    count = len(plan.filter_types)
    if count > 1 and _ends_a_round(last.number + 1, count):
        _enqueue_transferred_noise(study)
    _enqueue_untuned(study, plan)
    if is_local(plan, last.number):
        _enqueue_near(study, plan, last.number)


def _enqueue_near(study: optuna.Study, plan: Plan, number: int) -> None:
    """Enqueue a trial near the best one, once all other enqueued trials have been run."""
    best = best_trial(study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)))
    if best is not None and not study.get_trials(deepcopy=False, states=(TrialState.WAITING,)):
        enqueue_new(study, near(best.params, plan.space(), plan, number), {NEAR_BEST: best.number})


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
        space = plan.space()
        study.enqueue_trial(_within(trial_parameters(choice, space), space), user_attrs={UNTUNED: name})


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


def _enqueue_baselines(study: optuna.Study, plan: Plan) -> None:
    """Enqueue the baselines of the first filter type as far as the space has them, without the oracle.

    The scaled default and noise estimation of a problem with parameters of its own have a Q that no parameters
    give: they meet the best trials at the end (`tuning.search.validation`), and are no trials.
    """
    problem, space = plan.scenarios[0], plan.space()
    for name, choice in baselines(plan.filter_types[0], problem, plan.seed).items():
        if name != ORACLE and (problem.parameters is None or name in (GIVEN, RULE)):
            enqueue_new(study, _within(trial_parameters(choice, space), space), {BASELINE: name})


def _enqueue_maximum_likelihood(study: optuna.Study, plan: Plan, start: dict) -> None:
    """Enqueue a trial's parameters with the numbers of the model under which the innovations are most likely.

    On recorded runs, whose likelihood is all there is, they are also tried with all else untuned.
    """
    noise = noise_by_gradient(study, plan)
    if noise is None:
        return
    enqueue_new(study, {**start, **noise}, {MAXIMUM_LIKELIHOOD: True})
    if any(problem.leads_in for problem in plan.scenarios):
        space = plan.space()
        filter_type = start.get(FILTER_TYPE, plan.filter)
        plain = _within(trial_parameters(untuned_choice(filter_type, plan.scenarios[0]), space), space)
        enqueue_new(study, {**plain, **noise}, {MAXIMUM_LIKELIHOOD: True})


def _enqueue_minimum(study: optuna.Study, plan: Plan, start: dict) -> None:
    """Enqueue a trial's parameters with the Q and R to which gradients of the objective lead, if it has them.

    Of a score with few parameters a sampler that begins at the likeliest ones comes within 0.3 % in 20 trials.
    """
    objective, parameters = plan.objectives[0], model_parameters(plan.scenarios[0], **plan.options)
    if objective not in OF_STATES or (objective == SCORE and len(parameters) <= MOST_FOR_STARTS):
        return
    noise = noise_by_gradient(study, plan, objective)
    if noise is not None:
        enqueue_new(study, {**start, **noise}, {BY_GRADIENT: objective})


def noise_by_gradient(study: optuna.Study, plan: Plan, objective: str = LIKELIHOOD) -> dict[str, float] | None:
    """The Q and R, or own parameters, to which gradients of an objective lead, kept with the study.

    They are those of the tuned filter where it has gradients, learns no noise, and the model has few states, else
    of an extended Kalman filter, by an ascent: of models of few states from three starts. Near the best Q and R
    the score is so flat that a sampler finds the place late, and among many correlations never; where the model is
    wrong the trial is one among many. None for parameters that change functions of the model, which have no such
    gradient.
    """
    if not all(filter_class(name).has_covariance for name in plan.filter_types):
        return None
    key = MAXIMUM_LIKELIHOOD if objective == LIKELIHOOD else f"{BY_GRADIENT} {objective}"
    known = study.user_attrs.get(key)
    if known is not None:
        return known or None
    small = len(plan.scenarios[0].quantities.states) <= MOST_STATES
    own = small and has_gradient(plan.filter) and not keeps_more(plan.filter)
    name = plan.filter if plan.filter == "kf" or own else "ekf"
    try:
        goal = goal_of(name, plan.scenarios, plan.training_data(), objective, plan.options)
        some = goal.is_large or len(goal.coordinates.free) > MOST_FOR_ALL
        goal = goal.of_few(MAXIMUM_LIKELIHOOD_RUNS) if some else goal
        found = optimum(goal, _best_start(goal))
    except ValueError:  # more than numbers changes, or whole numbers
        study.set_user_attr(key, {})
        return None
    noise = _within(dict(zip(goal.coordinates.names, found.parameters.tolist(), strict=True)), plan.space())
    study.set_user_attr(key, noise)
    return noise


def _best_start(goal: Goal) -> np.ndarray:
    """The start of an ascent: of a model with few numbers where the best of three starts leads on a few runs."""
    free, few = goal.coordinates.free, goal.of_few(MAXIMUM_LIKELIHOOD_RUNS)
    if goal.is_large or len(free) > MOST_FOR_STARTS:
        return start_at(goal, [1.0] * len(free))
    best = max((optimum(few, start_at(goal, one)) for one in starts_of(free)), key=lambda one: one.value)
    return goal.coordinates.of(best.parameters)


def _within(parameters: Mapping, space: Mapping) -> dict:
    """The parameters, each moved into its range."""
    found = {}
    for name, value in parameters.items():
        if isinstance(value, Real):
            low, high = ends_of(space[name])
            value = min(max(value, low), high)
        found[name] = value
    return found


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
