"""A study that chooses the filter, too, under a budget of time a step."""

import json
import math
import warnings
from functools import cache

import numpy as np
import optuna
import pytest
from optuna.distributions import CategoricalDistribution
from optuna.trial import TrialState

import tuning
from filters.registry import FILTERS
from tests.filters.checks import refused
from tuning.api.tune import warn_of_few_trials
from tuning.evaluation.baselines import noise_estimated
from tuning.evaluation.held_out import evaluate_held_out
from tuning.evaluation.tuned import write_tuned
from tuning.plants.thruster import find_scenario
from tuning.problems.excitation import Steps
from tuning.problems.model_problem import ModelProblem, RunsProblem
from tuning.reporting.sections import trials_of_type
from tuning.search import among_types
from tuning.search import trials as tuning_trials
from tuning.search.among_types import ESTIMATED, ESTIMATED_Q, NEAR_BEST, RESCALED, SMALLER, TRANSFERRED, UNTUNED
from tuning.search.plan import Plan, joint_distributions
from tuning.search.space import AUTO_FILTER_TYPES, FILTER_TYPE, choice_of, trial_parameters, untuned_choice
from tuning.search.study import open_study, run_study
from tuning.search.trials import BUDGET, COST

MISMATCH = find_scenario("mismatch")
PLAN = Plan("auto", (MISMATCH,), budget=1.0)
FEW = ("ekf", "kf", "enkf", "pf")  # kinds of most tests, for speed
COSTS = {"ekf": lambda n: 0.1, "kf": lambda n: 0.07, "enkf": lambda n: 0.05 * n, "pf": lambda n: 0.02 * n}


@pytest.fixture
def priced(monkeypatch):
    """Few kinds, and costs that do not depend on the machine."""
    monkeypatch.setattr("tuning.search.plan.AUTO_FILTER_TYPES", FEW)

    def price(filter_, data):
        return COSTS[filter_.name](filter_.size)

    monkeypatch.setattr(tuning_trials, "microseconds_a_step", price)


@cache
def studied(plan, count):
    """A study, run once for all tests: the first trials of a longer one are those of a shorter one."""
    return run_study(open_study("s", plan, optuna.storages.InMemoryStorage()), plan, count)


def test_the_kinds_are_all_filters_with_a_covariance_but_those_that_a_model_does_not_allow():
    assert AUTO_FILTER_TYPES[0] == "ekf" and len(set(AUTO_FILTER_TYPES)) == len(AUTO_FILTER_TYPES)
    assert set(AUTO_FILTER_TYPES) == {name for name, kind in FILTERS.items() if kind.has_covariance}
    model = MISMATCH.model().replace(operating_state=None, operating_input=None, operating_points=None)
    plan = PLAN._replace(scenarios=(ModelProblem(model, inputs=Steps(12.0), steps=60),))
    assert set(AUTO_FILTER_TYPES) - set(plan.filter_types) == {"kf", "kf-steady"}
    assert PLAN.filter_types == AUTO_FILTER_TYPES


@pytest.mark.parametrize("kind", AUTO_FILTER_TYPES)
def test_a_choice_of_any_kind_survives_its_trial_parameters(kind):
    space, choice = joint_distributions(AUTO_FILTER_TYPES, MISMATCH), untuned_choice(kind, MISMATCH)
    parameters = trial_parameters(choice, space)
    assert choice_of("auto", parameters, MISMATCH) == choice
    assert all(" " not in key or key.startswith(f"{kind} ") for key in parameters)
    assert all(space[key]._contains(space[key].to_internal_repr(value)) for key, value in parameters.items())


def test_numbers_of_a_kind_are_chosen_for_that_kind_alone_and_noise_for_all(priced):
    result = studied(PLAN, 40)
    for trial in result.trials:
        kind = trial.params[FILTER_TYPE]
        own = {key for key in trial.params if " " in key}
        assert {"Q11", "Q22", "R"} < set(trial.params) and all(key.startswith(f"{kind} ") for key in own)
        assert (f"{kind} N" in own) == (kind in ("enkf", "pf"))


def test_each_kind_is_tried_with_the_noise_that_true_states_show(priced):
    trials = studied(PLAN._replace(prune=False), 26).trials[:16]
    assert [trial.user_attrs.get(UNTUNED) for trial in trials[:2]] == ["ekf", None]
    assert choice_of("auto", trials[0].params, MISMATCH) == untuned_choice("ekf", MISMATCH)
    in_race = set(among_types.race_of(PLAN, trials).running)
    assert [trial.user_attrs[ESTIMATED_Q] for trial in trials if ESTIMATED_Q in trial.user_attrs] == list(FEW)
    assert in_race and any(ESTIMATED in trial.user_attrs for trial in trials)
    for key in (ESTIMATED_Q, ESTIMATED):
        found = [trial for trial in trials if key in trial.user_attrs]
        assert [trial.user_attrs[key] for trial in found] == [trial.params[FILTER_TYPE] for trial in found]
        for trial in found:
            choice = choice_of("auto", trial.params, MISMATCH)
            estimated = noise_estimated(choice.name, MISMATCH).model
            np.testing.assert_allclose(choice.model["process_noise_cov"], np.diag(estimated["process_noise_cov"]))
            r = np.squeeze(estimated["measurement_noise_cov"]) if key == ESTIMATED else 0.25
            assert choice.model["measurement_noise_cov"] == pytest.approx(r)
    assert trials[1].user_attrs[RESCALED] == 1  # before the next kind is begun


def test_kinds_that_were_not_begun_are_begun_by_whoever_goes_on(priced):
    storage = optuna.storages.InMemoryStorage()
    for count in (1, 2, 6, 10):
        trials = run_study(open_study("s", PLAN, storage), PLAN, count).trials
    assert [one.user_attrs[ESTIMATED_Q] for one in trials if ESTIMATED_Q in one.user_attrs] == list(FEW)
    assert RESCALED in trials[1].user_attrs


def test_on_recorded_runs_each_kind_begins_with_the_likeliest_noise(priced):
    model = MISMATCH.model()
    data = MISMATCH.data(range(5))
    runs = [{"measurements": z, "inputs": u} for z, u in zip(data.measurements, data.inputs, strict=True)]
    problem = RunsProblem(runs, model, held_out=[3, 4], dt=MISMATCH.dt)
    plan = PLAN._replace(scenarios=(problem,), objectives=("likelihood",))
    trials = studied(plan, 9).trials
    likeliest = among_types.noise_by_gradient(open_study("t", plan, optuna.storages.InMemoryStorage()), plan)
    for trial in (one for one in trials if ESTIMATED_Q in one.user_attrs):
        assert {key: trial.params[key] for key in likeliest} == pytest.approx(likeliest)


def test_what_is_over_the_budget_ends_at_once_and_never_wins(priced):
    result = studied(PLAN, 40)
    over = [trial for trial in result.trials if tuning_trials.is_over_budget(trial)]
    assert over and all(trial.state == TrialState.PRUNED and not trial.intermediate_values for trial in over)
    for trial in result.trials:
        if trial.state != TrialState.WAITING:
            cost = COSTS[trial.params[FILTER_TYPE]](trial.params.get(f"{trial.params[FILTER_TYPE]} N", 0))
            assert trial.user_attrs[COST] == cost and trial.constraints[BUDGET] == math.log(cost / 1.0)
            assert tuning_trials.is_over_budget(trial) == (cost > 1.0)
    best = tuning_trials.best_trial(result.trials)
    assert best.user_attrs[COST] <= 1.0 and result.microseconds <= 1.0 and tuning_trials.violation(best) <= 0
    assert result.choice.name == best.params[FILTER_TYPE]
    kinds = {kind.name: kind for kind in among_types.filter_types_tried(result.trials)}
    assert sum(kind.trials for kind in kinds.values()) == 40 and kinds["pf"].over_budget == kinds["pf"].trials
    assert kinds["pf"].value is None and kinds["pf"].microseconds > 1.0
    assert kinds[best.params[FILTER_TYPE]].value == best.values[0] and list(kinds)[0] == best.params[FILTER_TYPE]
    assert {t.params[FILTER_TYPE] for t in trials_of_type(result.trials, "kf")} == {"kf"}


def test_a_filter_over_the_budget_is_tried_with_fewer_members(priced):
    trials = studied(PLAN, 40).trials[:12]
    untuned = next(trial for trial in trials if trial.params[FILTER_TYPE] == "enkf")
    (smaller,) = [trial for trial in trials if SMALLER in trial.user_attrs]  # none for pf: 200 are too many
    assert smaller.user_attrs[SMALLER] == untuned.number and smaller.params["enkf N"] == 18
    assert {**smaller.params, "enkf N": 30} == untuned.params and not tuning_trials.is_over_budget(smaller)


def test_other_kinds_inherit_the_noise_of_the_best_one(priced):
    result = studied(PLAN._replace(budget=30.0), 17)  # a round of four types leaves two
    heirs = [trial for trial in result.trials if TRANSFERRED in trial.user_attrs]
    (best,) = {trial.user_attrs[TRANSFERRED] for trial in heirs}
    best = result.trials[best]
    kinds = [trial.params[FILTER_TYPE] for trial in heirs]
    assert len(kinds) == 1 and best.params[FILTER_TYPE] not in kinds and heirs[0].number > len(FEW)
    assert all(trial.params[key] == best.params[key] for trial in heirs for key in ("Q11", "Q22", "R"))


@pytest.mark.slow
def test_a_budget_holds_one_kind_too_and_no_size_goes_beyond_it(priced):
    plan = Plan("enkf", (MISMATCH,), budget=1.0)
    result = studied(plan, 15)
    assert result.choice.numbers["ensemble_size"] <= 20 and max(row.size for row in result.sizes) <= 20
    assert among_types.filter_types_tried(result.trials) == []


def test_a_budget_that_nothing_keeps_is_one_clear_line(priced):
    with pytest.raises(ValueError, match="budget must be at least the time of the cheapest trial, 0.07 mi.* 0.01"):
        studied(PLAN._replace(budget=0.01), 6)


def test_without_a_budget_a_front_of_error_against_cost_tells_the_kinds(priced):
    plan = PLAN._replace(budget=None, consistent=False, objectives=("score", "cost"))
    result = studied(plan, 10)
    assert {trial.params[FILTER_TYPE] for trial in result.front} and result.choice.name in FEW
    assert min(trial.values[1] for trial in result.front) == 0.07


def test_the_same_seed_gives_the_same_study_and_one_that_goes_on_the_same_race(priced):
    first = studied(PLAN, 40).trials[:14]
    assert [trial.params for trial in first] == [trial.params for trial in studied(PLAN, 14).trials]
    storage = optuna.storages.InMemoryStorage()
    run_study(open_study("s", PLAN, storage), PLAN, 9)
    parts = run_study(open_study("s", PLAN, storage), PLAN, 14).trials
    assert [trial.params[FILTER_TYPE] for trial in parts] == [trial.params[FILTER_TYPE] for trial in first]


def finished(number, name, values, state=TrialState.COMPLETE):
    """A trial of a filter type with these scores of single seeds."""
    return optuna.trial.create_trial(
        state=state,
        value=float(np.mean(values)) if state == TrialState.COMPLETE else None,
        params={FILTER_TYPE: name},
        distributions={FILTER_TYPE: CategoricalDistribution(FEW)},
        intermediate_values=dict(enumerate(values)),
    )


def test_the_best_third_of_the_types_rounded_up_goes_on_with_twice_as_many_trials(priced):
    def race(scores):
        return among_types.race_of(
            PLAN, [finished(i, name, [score] * 8) for i, (name, score) in enumerate(scores)]
        )

    first = [("ekf", 1.2), ("kf", 1.5), ("enkf", 1.1)]
    assert race(first) == (0, ("enkf", "ekf", "kf", "pf"), 1)  # until each has had a trial
    first.append(("pf", 2.0))
    assert race(first) == (1, ("enkf", "ekf"), 3)
    trials = [finished(i, name, [score] * 8) for i, (name, score) in enumerate(first)]
    assert among_types.next_in_race(PLAN, trials) == "enkf"
    trials.append(finished(4, "enkf", [], TrialState.RUNNING))  # another worker's
    assert among_types.next_in_race(PLAN, trials) == "ekf"
    assert race([*first, *[("kf", 0.5)] * 9]) == (1, ("kf", "enkf"), 3)
    second = [*first, *[("ekf", 1.0), ("enkf", 1.3)] * 2]
    assert race(second) == (2, ("ekf",), 7)
    pruned = [
        finished(0, "ekf", [1.0] * 32),
        finished(1, "kf", [1.4] * 8, TrialState.PRUNED),
        finished(2, "enkf", [1.3] * 8, TrialState.PRUNED),
        finished(3, "pf", [3.0] * 32),
    ]
    assert among_types.race_of(PLAN, pruned).running == ("ekf", "enkf")  # 1.3 times the best on the same seeds
    two = PLAN._replace(objectives=("score", "cost"))
    assert set(among_types.race_of(two, [finished(i, name, [1.0]) for i, name in enumerate(FEW)]).running) == set(
        FEW
    )


def test_trials_after_the_first_are_of_the_types_in_the_race(priced):
    result = studied(PLAN._replace(prune=False), 26)
    for trial in result.trials[10:]:
        before = [one for one in result.trials if one.number < trial.number]
        enqueued = {UNTUNED, ESTIMATED_Q, ESTIMATED, TRANSFERRED, RESCALED, SMALLER} & trial.user_attrs.keys()
        assert enqueued or trial.params[FILTER_TYPE] in among_types.race_of(PLAN, before).running
    late = [trial.params[FILTER_TYPE] for trial in result.trials[18:]]
    assert len(set(late)) <= 2 and any(NEAR_BEST in trial.user_attrs for trial in result.trials[10:])


def test_without_a_budget_auto_has_a_default_one_and_few_trials_are_warned_of(monkeypatch, priced):
    plans = []
    monkeypatch.setattr("tuning.api.tune.run_tuning", lambda plan, *others, **named: plans.append(plan))
    with pytest.warns(UserWarning, match="no budget .* may take 10 microseconds of one core, the default of 2 st"):
        tuning.tune(MISMATCH, "auto", progress=False)
    tuning.tune(MISMATCH, "auto", budget=3.0, progress=False)
    tuning.tune(MISMATCH, "auto", objective=["score", "cost"], progress=False)
    tuning.tune(MISMATCH, "ekf", progress=False)
    assert [plan.budget for plan in plans] == [10.0, 3.0, None, None]
    with pytest.warns(UserWarning, match="7 trials are fewer than 5 for each of 4 filter types: --trials 20"):
        warn_of_few_trials(PLAN, 7)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_few_trials(PLAN, 20)
        warn_of_few_trials(Plan("ekf", (MISMATCH,)), 1)


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        ({"budget": None}, "'auto' must have a budget of microseconds a step .* or the objective 'cost'"),
        ({"budget": 0.0}, "budget must be positive, but got 0.0"),
        (
            {"sampler": "grid"},
            r"a method \(--method\) that chooses among filters must be .* tpe, .*, but got 'grid'",
        ),
        ({"filter": "low-pass", "full_q": True}, "a full Q needs a filter with a covariance, but got 'low-pass'"),
    ],
)
def test_a_plan_that_cannot_work_is_refused(change, rule):
    refused(rule, open_study, "s", PLAN._replace(**change), optuna.storages.InMemoryStorage())


def test_budget_and_kinds_belong_to_the_identity(monkeypatch):
    storage = optuna.storages.InMemoryStorage()
    open_study("s", PLAN, storage)
    with pytest.raises(ValueError, match="must be for {'budget': 2.0}, but it was made for {'budget': 1.0}"):
        open_study("s", PLAN._replace(budget=2.0), storage)
    monkeypatch.setattr("tuning.search.plan.AUTO_FILTER_TYPES", FEW)
    refused("must be for {'kinds': .*'pf'", open_study, "s", PLAN, storage)


def test_cost_is_of_one_core_and_grows_with_the_ensemble():
    data = MISMATCH.data(range(32))
    untuned = untuned_choice("enkf", MISMATCH)
    small, large = (
        tuning_trials.microseconds_a_step(untuned.with_size(n).filter(MISMATCH), data) for n in (10, 200)
    )
    ekf = tuning_trials.microseconds_a_step(untuned_choice("ekf", MISMATCH).filter(MISMATCH), data)
    assert 0 < ekf < small and 3 < large / small < 40
    assert (
        tuning_trials.over_budget(2.0, 1.0) == pytest.approx(np.log(2))
        and tuning_trials.over_budget(1.0, 1.0) == 0.0
    )


@pytest.mark.parametrize("method", ["tpe", "gradient"])
def test_the_tuned_file_says_what_made_the_choice(tmp_path, method):
    plan, path = Plan("ekf", (MISMATCH,)), tmp_path / "t.json"
    result = studied(plan, 1)
    write_tuned(path, plan, result, [evaluate_held_out(result.choice, MISMATCH, 0, 2)], "s", method)
    study = json.loads(path.read_text())["study"]
    assert study["method"] == method
    assert study["best_training_value"] == (result.best_value if method == "tpe" else None)
