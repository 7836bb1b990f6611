"""The trials that a study enqueues, and the race among its filter types.

A sampler would find these trials only late and by chance. In order: Q and R by gradients, the race with the first
trials of each type, the results of each type, the trials that follow from a finished one, and the ensemble size of
the study's choice.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import optuna
from optuna.trial import FrozenTrial, TrialState

from filters.filter import PageFilter
from filters.registry import filter_type
from tuning.evaluation.baselines import competing_baselines, noise_estimated
from tuning.evaluation.held_out import sizes_as_data, stored_sizes
from tuning.evaluation.sizes import SIZE_TOLERANCE, SizeRow, ensemble_sizes, sufficient_size
from tuning.likelihood.gradient import goal_of, optimum, start_at, starts_of
from tuning.likelihood.objective import OF_STATES, Objective
from tuning.likelihood.parametric import has_gradient
from tuning.problems.data import Data, estimates_in_parts
from tuning.problems.problem import Problem
from tuning.search.parameters import R, model_parameters, size_ladder
from tuning.search.plan import LIKELIHOOD, SCORE, Plan, reported
from tuning.search.space import FILTER_TYPE, Choice, ends_of, trial_parameters, untuned_choice, within_ranges
from tuning.search.trials import COST, NIS, best_trial, enqueue_new, is_consistent, is_near, is_over_budget, near

# Attributes of studies and trials, whose texts must not change: they are in journals and databases.
MAXIMUM_LIKELIHOOD = "likeliest noise"  # Q and R have maximum likelihood; of a study what they are
BY_GRADIENT = "gradient of"  # the objective on the true states, of which Q and R are the minimum; of a study they
UNTUNED = "untuned"  # the filter whose parameters before any tuning these are
ESTIMATED_Q = "estimated Q of"  # the filter that has the Q of noise estimation, and the R of the data sheet
ESTIMATED = "estimated noise of"  # the filter that has both from noise estimation
SMALLER = "smaller ensemble of"  # number of the trial that was over the budget
TRANSFERRED = "noise of"  # number of the trial of another filter type that Q and R are from
NEAR_BEST = "near"  # number of the best trial, of which this one is a variation
RESCALED = "consistent twin"  # how often the trial's Q and R have been rescaled
BASELINE = "baseline"  # the name of the baseline that the trial is
SIZES = "ensemble sizes"  # attribute of a study: their table, with its digest

# Of Q and R by gradients.
MOST_FOR_STARTS = 8  # parameters, of which an ascent has more than one start
MOST_STATES = 8  # of a model, in which filters but the linear and the extended one follow their own gradients
MOST_FOR_ALL = 24  # parameters, of which an ascent has all runs
MAXIMUM_LIKELIHOOD_RUNS = 8  # of a model with many states or parameters, and to compare starts: they tell enough

# Of the race.
REMAINING = 3  # of so many filter types in a round of the race one goes on to the next ...
MORE = 2  # ... in which it has so many times as many new trials
INCONSISTENT = 0.05  # part of its objective by which a trial outside the NIS band counts as worse in the race
ROOM = 0.9  # part of the budget that a smaller ensemble may take

# Of trials that follow from finished ones.
MOST_RESCALINGS = 2  # nonlinear filters may need a second one
MAXIMUM_LIKELIHOOD_AFTER = 20  # trials, after which the likeliest noise is tried with all else of the best one


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


def _best_start(goal: Objective) -> np.ndarray:
    """The start of an ascent: of a model with few numbers where the best of three starts leads on a few runs."""
    free, few = goal.coordinates.free, goal.of_few(MAXIMUM_LIKELIHOOD_RUNS)
    if goal.is_large or len(free) > MOST_FOR_STARTS:
        return start_at(goal, [1.0] * len(free))
    best = max((optimum(few, start_at(goal, start)) for start in starts_of(free)), key=lambda ascent: ascent.value)
    return goal.coordinates.of(best.parameters)


def enqueue_next_type(study: optuna.Study, plan: Plan) -> None:
    """Enqueue the next first trial of a filter type, once all other enqueued trials have been run.

    So each is tried with its Q and R rescaled before the next one begins: filters of different types can be
    compared only where their innovations are consistent.
    """
    trials = study.get_trials(deepcopy=False)
    if any(trial.state == TrialState.WAITING for trial in trials) or (
        trials and UNTUNED not in trials[0].user_attrs
    ):
        return  # a study that begins with something else has enqueued all at once
    for key, name in _first_trials(plan, trials):
        if not any(trial.user_attrs.get(key) == name for trial in trials):
            parameters = _first_parameters(study, plan, key, name)
            if parameters is not None and not any(is_near(trial.params, parameters) for trial in trials):
                study.enqueue_trial(parameters, user_attrs={key: name})
                return


def is_race(plan: Plan) -> bool:
    """Whether filter types leave a study: not one of two objectives, whose front may need each of them."""
    return len(plan.filter_types) > 1 and len(plan.objectives) == 1


class Race(NamedTuple):
    """Where a race among filter types stands."""

    round: int  # from 0
    running: tuple[str, ...]  # the types that are still in it, the best first
    trials: int  # that each of them shall have at the end of the round


def race_of(plan: Plan, trials: Sequence[FrozenTrial]) -> Race:
    """The race after some trials by successive halving: the best third of the types has twice as many new trials.

    It depends on finished trials alone, so a study that is continued and each of several workers go on with it.
    A type's rank is that of its best trial; that of a pruned trial is its error over the best trial's on the same
    seeds. A type that is over the budget leaves.

    Source: Jamieson, Talwalkar (2016), "Non-stochastic best arm identification and hyperparameter optimization",
    International Conference on Artificial Intelligence and Statistics.
    """
    finished: dict[str, list[FrozenTrial]] = {name: [] for name in plan.filter_types}
    for trial in trials:
        if trial.state in (TrialState.COMPLETE, TrialState.PRUNED):
            finished[trial.params[FILTER_TYPE]].append(trial)
    best = best_trial([trial for of_type in finished.values() for trial in of_type])
    rank = {
        name: min((_in_race(trial, best) for trial in of_type), default=math.inf)
        for name, of_type in finished.items()
    }
    running = [name for name, of_type in finished.items() if not of_type or not all(map(is_over_budget, of_type))]
    round_number, wanted = 0, 1
    while len(running) > 1 and all(len(finished[name]) >= wanted for name in running):
        if is_race(plan):
            running = sorted(running, key=rank.__getitem__)[: -(-len(running) // REMAINING)]
        round_number, wanted = round_number + 1, wanted + MORE ** (round_number + 1)
    return Race(round_number, tuple(sorted(running, key=rank.__getitem__)), wanted)


def _in_race(trial: FrozenTrial, best: FrozenTrial | None) -> float:
    """The first objective of a trial, which counts as worse outside the NIS band; of a pruned one by its seeds."""
    if trial.state == TrialState.COMPLETE:
        value = trial.values[0]
        return value if is_consistent(trial) else value + INCONSISTENT * abs(value)
    seeds = trial.intermediate_values.keys() & best.intermediate_values.keys() if best is not None else set()
    if best is None or not seeds:
        return math.inf
    total, best_total = (sum(tried.intermediate_values[seed] for seed in seeds) for tried in (trial, best))
    return best.values[0] * total / best_total


def next_in_race(plan: Plan, trials: Sequence[FrozenTrial]) -> str:
    """The filter type of the next trial: of those in the race the one with the fewest, the best of these first."""
    begun = Counter(trial.params.get(FILTER_TYPE) for trial in trials if trial.state != TrialState.WAITING)
    return min(race_of(plan, trials).running or plan.filter_types, key=begun.__getitem__)


def _first_trials(plan: Plan, trials: Sequence[FrozenTrial]) -> Iterator[tuple[str, str]]:
    """The first filter type untuned; then of several types each with what noise estimation says of Q, and of both.

    Both are for the types that are in the second round of the race.

    Untuned filters do not show which type is best. The R of noise estimation contains all that the sensor does,
    outliers included: a filter that models these does better with that of the data sheet.
    """
    yield UNTUNED, plan.filter_types[0]
    if len(plan.filter_types) > 1:
        yield from ((ESTIMATED_Q, name) for name in plan.filter_types)
        race = race_of(plan, trials)
        yield from ((ESTIMATED, name) for name in race.running if race.round or not is_race(plan))


def _first_parameters(study: optuna.Study, plan: Plan, key: str, name: str) -> dict | None:
    """The parameters of a first trial; None if the filter type is over the budget."""
    space, untuned = plan.space(), untuned_choice(name, plan.scenarios[0])
    if key == UNTUNED:
        return within_ranges(trial_parameters(untuned, space), space)
    tried = [trial for trial in study.get_trials(deepcopy=False) if trial.params.get(FILTER_TYPE) == name]
    within = [trial for trial in tried if not is_over_budget(trial)]
    if tried and not within:
        return None
    start = within[-1].params if within else trial_parameters(untuned, space)
    return within_ranges({**start, **(_estimated(study, plan, with_r=key == ESTIMATED) or {})}, space)


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


def ends_a_round(plan: Plan, trials: Sequence[FrozenTrial], last: FrozenTrial) -> bool:
    """Whether a round of the race ended with the last trial."""
    return (
        race_of(plan, trials).round
        > race_of(plan, [trial for trial in trials if trial.number != last.number]).round
    )


def enqueue_transferred_noise(study: optuna.Study, plan: Plan) -> None:
    """Enqueue the Q and R of the best trial with every other filter type that is in the race.

    Untuned filters do not show which type is best, and a sampler soon keeps to the type that it tuned first.
    """
    finished = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE, TrialState.PRUNED))
    best = best_trial(finished)
    if best is None:
        return
    latest = {trial.params[FILTER_TYPE]: trial for trial in finished if not is_over_budget(trial)}
    for name in race_of(plan, finished).running:
        if name != best.params[FILTER_TYPE] and name in latest:
            parameters = {**latest[name].params, **_shared(best.params)}
            enqueue_new(study, parameters, {TRANSFERRED: best.number})


def enqueue_near_in_race(study: optuna.Study, plan: Plan, number: int) -> None:
    """Enqueue a trial near the best one of the type that is next, once all other enqueued trials have been run."""
    trials = study.get_trials(deepcopy=False)
    if any(trial.state == TrialState.WAITING for trial in trials):
        return
    name = next_in_race(plan, trials)
    best = best_trial([trial for trial in trials if trial.params.get(FILTER_TYPE) == name])
    if best is not None:
        enqueue_new(study, near(best.params, plan.space(), plan, number), {NEAR_BEST: best.number})


class TypeResult(NamedTuple):
    """The results of a filter type in a study."""

    name: str
    trials: int  # finished ones
    pruned: int  # for their errors ...
    over_budget: int  # ... and for their cost
    value: float | None  # first objective of its best trial; None if none is complete
    consistent: bool  # whether that trial's mean NIS (normalised innovation squared) is within its band
    microseconds: float | None  # us/step of that trial or, if none is complete, of the cheapest one

    def best(self, objective: str) -> str:
        """The first objective of the best trial in words; a star if its mean NIS is outside its band."""
        if self.value is None:
            return ""
        return f"{reported(objective, self.value):.4g}{'' if self.consistent else '*'}"


def filter_types_tried(trials: Sequence[FrozenTrial]) -> list[TypeResult]:
    """The filter types that finished trials chose, the best first; empty for a study of one type."""
    by_type: dict[str, list[FrozenTrial]] = {}
    for trial in trials:
        if FILTER_TYPE in trial.params and trial.state in (TrialState.COMPLETE, TrialState.PRUNED):
            by_type.setdefault(trial.params[FILTER_TYPE], []).append(trial)
    rows = [_row(name, of_type) for name, of_type in by_type.items()]
    return sorted(rows, key=lambda row: (row.value is None, not row.consistent, row.value or 0.0))


def filter_types_running(trials: Sequence[FrozenTrial]) -> list[str]:
    """The filter types of the running trials, in alphabetical order; empty in a study of one type."""
    running = (trial for trial in trials if trial.state == TrialState.RUNNING)
    return sorted({trial.params[FILTER_TYPE] for trial in running if FILTER_TYPE in trial.params})


def _row(name: str, trials: list[FrozenTrial]) -> TypeResult:
    best, over = best_trial(trials), sum(map(is_over_budget, trials))
    costs = [trial.user_attrs[COST] for trial in ([best] if best else trials) if COST in trial.user_attrs]
    return TypeResult(
        name,
        len(trials),
        sum(trial.state == TrialState.PRUNED for trial in trials) - over,
        over,
        None if best is None else best.values[0],
        best is not None and is_consistent(best),
        min(costs, default=None),
    )


def enqueue_what_is_left(study: optuna.Study, plan: Plan) -> None:
    """Enqueue what an interrupted study still lacks: the rescaled last trial, and the next filter type."""
    finished = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    if finished and plan.rescales:
        _enqueue_rescaled(study, plan, finished[-1])
    enqueue_next_type(study, plan)


def is_local(plan: Plan, number: int) -> bool:
    """Whether the trial after this number is to be near the best: every second one of "tpe" with one objective."""
    return plan.sampler == "tpe" and len(plan.objectives) == 1 and number % 2 == 1


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


def close_size(choice: Choice, plan: Plan, training: Sequence[Data]) -> int:
    """The smallest ensemble whose estimates are so close to the largest one's that the error barely grows.

        mean of (m_N - m_L)^2 / P_L over runs, scored steps and states < 1.01^2 - 1

    This can be computed without truth: sampling adds this much to the mean square error, in units of the
    variance that the largest ensemble assumes. The likelihood is insensitive to it if R is large. If the
    plan has a budget, no size is above that of the choice.

    Args:
        choice: the choice of a study.
        plan: the plan of the study.
        training: the plan's training data.
    """
    size = choice.numbers["ensemble_size"]
    sizes = [n for n in sorted({*size_ladder(choice.name), size}) if plan.budget is None or n <= size]
    rest, limit = sizes[:-1], (1.0 + SIZE_TOLERANCE) ** 2 - 1.0
    for scenario, data in zip(plan.scenarios, training, strict=True):
        means, variances = _scored(choice.with_size(sizes[-1]), scenario, data)
        likely = np.maximum(variances, np.finfo(float).tiny)
        excess = [((_scored(choice.with_size(n), scenario, data)[0] - means) ** 2 / likely).mean() for n in rest]
        rest = [n for n, error in zip(rest, excess, strict=True) if error < limit]
    return min(rest, default=sizes[-1])


def _scored(choice: Choice, scenario: Problem, data: Data) -> tuple[np.ndarray, np.ndarray]:
    """Means and variances of all scored steps, (steps, n) each."""
    parts = list(estimates_in_parts(choice.filter(scenario), data))
    means, covs = (
        np.concatenate([part.scored_rows(getattr(estimates, name)) for part, estimates in parts])
        for name in ("means", "covs")
    )
    return means, np.einsum("kii->ki", covs)


def sized(choice: Choice, plan: Plan, data: Sequence[Data], sizes: Sequence[SizeRow], consistent: bool) -> Choice:
    """A choice with the smallest sufficient ensemble; unchanged without an ensemble."""
    if sizes:
        return choice.with_size(sufficient_size(sizes, consistent))
    recorded = all(scenario.leads_in for scenario in plan.scenarios)
    if filter_type(choice.name).has_ensemble and len(plan.objectives) == 1 and recorded:
        return choice.with_size(close_size(choice, plan, data))
    return choice


def keeps_more(name: str) -> bool:
    """Whether a filter with a page keeps more than mean and covariance, such as an estimate of R."""
    kind = filter_type(name).filter_class
    return issubclass(kind, PageFilter) and kind.page.initial is not None
