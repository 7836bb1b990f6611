"""Trials enqueued after a finished trial: a sampler would find them only late and by chance.

NIS is the normalised innovation squared.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import optuna
from optuna.trial import FrozenTrial, TrialState

from filters.registry import filter_type
from tuning.evaluation.baselines import competing_baselines
from tuning.evaluation.sizes import SizeRow, close_size, ensemble_sizes, sufficient_size
from tuning.evaluation.summary import sizes_as_data, stored_sizes
from tuning.likelihood.gradient import OF_STATES
from tuning.problems.data import Data
from tuning.search.among_types import (
    NEAR_BEST,
    UNTUNED,
    ends_a_round,
    enqueue_near_in_race,
    enqueue_next_type,
    enqueue_smaller_ensemble,
    enqueue_transferred_noise,
    is_race,
)
from tuning.search.gradient_noise import BY_GRADIENT, MAXIMUM_LIKELIHOOD, MOST_FOR_STARTS, noise_by_gradient
from tuning.search.objectives import SCORE
from tuning.search.parameters import model_parameters
from tuning.search.plan import Plan
from tuning.search.samplers import is_local, near
from tuning.search.space import FILTER_TYPE, Choice, trial_parameters, untuned_choice, within_ranges
from tuning.search.trials import NIS, best_trial, enqueue_new, is_consistent

# Attributes of trials. Their texts are in journals and databases, so they stay as they were first written.
RESCALED = "consistent twin"  # how often the trial's Q and R have been rescaled
BASELINE = "baseline"  # the name of the baseline that the trial is
MOST_RESCALINGS = 2  # nonlinear filters may need a second one
MAXIMUM_LIKELIHOOD_AFTER = 20  # trials, after which the likeliest noise is tried with all else of the best one


def enqueue_what_is_left(study: optuna.Study, plan: Plan) -> None:
    """Enqueue what an interrupted study still lacks: the rescaled last trial, and the next filter type."""
    finished = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    if finished and plan.rescales:
        _enqueue_rescaled(study, plan, finished[-1])
    enqueue_next_type(study, plan)


def enqueue_after(study: optuna.Study, plan: Plan, last: FrozenTrial) -> None:
    """Enqueue the trials that follow from the last one.

    After the first one these are the baselines and the maximum-likelihood trial, which is repeated later with the
    other parameters of the best trial. Further trials have rescaled Q and R, a smaller ensemble, or its Q
    and R for other filter types; then comes the next filter type.
    """
    if plan.rescales:
        _enqueue_rescaled(study, plan, last)
    if plan.budget is not None:
        enqueue_smaller_ensemble(study, plan, last, plan.budget)
    if last.number == 0 and UNTUNED in last.user_attrs and len(plan.filter_types) == 1:
        _enqueue_baselines(study, plan)
        _enqueue_maximum_likelihood(study, plan, last.params)
        _enqueue_minimum(study, plan, last.params)
    if last.number == MAXIMUM_LIKELIHOOD_AFTER - 1:
        best = best_trial(study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)))
        if best is not None:
            _enqueue_maximum_likelihood(study, plan, best.params)
            _enqueue_minimum(study, plan, best.params)
    if len(plan.filter_types) > 1 and ends_a_round(plan, study.get_trials(deepcopy=False), last):
        enqueue_transferred_noise(study, plan)
    enqueue_next_type(study, plan)
    if is_local(plan, last.number):
        (enqueue_near_in_race if is_race(plan) else _enqueue_near)(study, plan, last.number)


def _enqueue_near(study: optuna.Study, plan: Plan, number: int) -> None:
    """Enqueue a trial near the best one, once all other enqueued trials have been run."""
    best = best_trial(study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)))
    if best is not None and not study.get_trials(deepcopy=False, states=(TrialState.WAITING,)):
        enqueue_new(study, near(best.params, plan.space(), plan, number), {NEAR_BEST: best.number})


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


def _enqueue_baselines(study: optuna.Study, plan: Plan) -> None:
    """Enqueue the baselines of the first filter type, without the oracle."""
    problem, space = plan.scenarios[0], plan.space()
    for name, choice in competing_baselines(plan.filter_types[0], problem, plan.seed).items():
        enqueue_new(study, within_ranges(trial_parameters(choice, space), space), {BASELINE: name})


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
        plain = within_ranges(trial_parameters(untuned_choice(filter_type, plan.scenarios[0]), space), space)
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


# The ensemble size of a study's choice, from a table stored in the study.


SIZES = "ensemble sizes"  # attribute of a study: their table, with its digest


def sizes_of(
    study: optuna.Study, choice: Choice, plan: Plan, data: Sequence[Data], consistent: bool
) -> list[SizeRow]:
    """The table of ensemble sizes of a choice, stored with the study; empty if there is none."""
    if not filter_type(choice.name).has_ensemble or len(plan.objectives) > 1:
        return []
    rows = stored_sizes(study.user_attrs.get(SIZES), choice, plan)
    if rows is None:
        rows = ensemble_sizes(choice, plan, data, consistent)
        study.set_user_attr(SIZES, sizes_as_data(rows, choice, plan))
    return rows


def sized(choice: Choice, plan: Plan, data: Sequence[Data], sizes: Sequence[SizeRow], consistent: bool) -> Choice:
    """A choice with the smallest sufficient ensemble; unchanged without an ensemble."""
    if sizes:
        return choice.with_size(sufficient_size(sizes, consistent))
    recorded = all(scenario.leads_in for scenario in plan.scenarios)
    if filter_type(choice.name).has_ensemble and len(plan.objectives) == 1 and recorded:
        return choice.with_size(close_size(choice, plan, data))
    return choice
