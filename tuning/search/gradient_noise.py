"""The Q and R to which gradients lead, as parameters of a trial."""

from __future__ import annotations

import numpy as np
import optuna

from filters.registry import filter_type
from tuning.likelihood.family import has_gradient, keeps_more
from tuning.likelihood.gradient import Goal, goal_of, optimum, start_at, starts_of
from tuning.search.objectives import LIKELIHOOD
from tuning.search.plan import Plan
from tuning.search.space import within_ranges

# Attributes of studies and trials, which stay as they were first written.
MAXIMUM_LIKELIHOOD = "likeliest noise"  # Q and R have maximum likelihood; of a study what they are
BY_GRADIENT = "gradient of"  # the objective on the true states, of which Q and R are the minimum; of a study they
MOST_FOR_STARTS = 8  # parameters, of which an ascent has more than one start
MOST_STATES = 8  # of a model, in which filters but the linear and the extended one follow their own gradients
MOST_FOR_ALL = 24  # parameters, of which an ascent has all runs
MAXIMUM_LIKELIHOOD_RUNS = 8  # of a model with many states or parameters, and to compare starts: they tell enough


def noise_by_gradient(study: optuna.Study, plan: Plan, objective: str = LIKELIHOOD) -> dict[str, float] | None:
    """The Q and R, or own parameters, found by gradients of an objective, stored with the study.

    They are those of the tuned filter if it has gradients, learns no noise, and the model has few states,
    otherwise of an extended Kalman filter; models of few states get three starts. Near the best Q and R the score
    is so flat that a sampler finds the optimum late, and with many correlations never; with a wrong model the
    trial is one among many. None for parameters that change functions of the model, which have no such gradient.
    """
    if not all(filter_type(name).has_covariance for name in plan.filter_types):
        return None
    key = MAXIMUM_LIKELIHOOD if objective == LIKELIHOOD else f"{BY_GRADIENT} {objective}"
    known = study.user_attrs.get(key)
    if known is not None:
        return known or None
    small = len(plan.scenarios[0].quantities.states) <= MOST_STATES
    has_own_gradient = small and has_gradient(plan.filter) and not keeps_more(plan.filter)
    name = plan.filter if plan.filter == "kf" or has_own_gradient else "ekf"
    try:
        goal = goal_of(name, plan.scenarios, plan.training_data(), objective, plan.options)
        on_few = goal.is_large or len(goal.coordinates.free) > MOST_FOR_ALL
        goal = goal.of_few(MAXIMUM_LIKELIHOOD_RUNS) if on_few else goal
        best = optimum(goal, _best_start(goal))
    except ValueError:  # more than numbers changes, or whole numbers
        study.set_user_attr(key, {})
        return None
    noise = within_ranges(dict(zip(goal.coordinates.names, best.parameters.tolist(), strict=True)), plan.space())
    study.set_user_attr(key, noise)
    return noise


def _best_start(goal: Goal) -> np.ndarray:
    """The start of an ascent: of a model with few numbers where the best of three starts leads on a few runs."""
    free, few = goal.coordinates.free, goal.of_few(MAXIMUM_LIKELIHOOD_RUNS)
    if goal.is_large or len(free) > MOST_FOR_STARTS:
        return start_at(goal, [1.0] * len(free))
    best = max((optimum(few, start_at(goal, start)) for start in starts_of(free)), key=lambda ascent: ascent.value)
    return goal.coordinates.of(best.parameters)
