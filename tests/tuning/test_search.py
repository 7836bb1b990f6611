"""What a study searches, minimises and keeps: objectives, consistency, pruning, samplers, several scenarios."""

import importlib.util
import pickle
from functools import cache

import numpy as np
import optuna
import pytest
from optuna.distributions import FloatDistribution, IntDistribution
from optuna.trial import TrialState

from filters.registry import FILTERS
from tests.filters.checks import refused
from tests.slow import slow_but
from tuning.evaluation.evaluate import evaluate, score_ratio
from tuning.evaluation.held_out import evaluate_held_out
from tuning.experiments import lorenz63
from tuning.likelihood.gradient import BAD_START, tune_by_gradient
from tuning.plants.thruster import find_scenario
from tuning.search import trials
from tuning.search import trials as tuning_trials
from tuning.search.among_types import MAXIMUM_LIKELIHOOD, MAXIMUM_LIKELIHOOD_AFTER, RESCALED
from tuning.search.parameters import size_ladder
from tuning.search.plan import LARGEST, NIS_BAND, Plan, nis_violation
from tuning.search.space import (
    choice_of,
    distributions,
    oracle_choice,
    parameters_of,
    trial_parameters,
    untuned_choice,
)
from tuning.search.study import open_study, run_study
from tuning.search.trials import BLOCK, NEEDS, SAMPLERS

MISMATCH, NOMINAL, OUTLIERS = map(find_scenario, ("mismatch", "nominal", "outliers"))
PLAN = Plan("ekf", (MISMATCH,))


@cache
def studied(plan, trials):
    """A study, run once for all tests: the first trials of a longer one are those of a shorter one."""
    return run_study(open_study("s", plan, optuna.storages.InMemoryStorage()), plan, trials)


def test_the_winner_of_a_study_has_the_best_log_score_at_hardly_any_cost_in_error():
    result = studied(PLAN, 40)
    best, met = tuning_trials.best_trial(result.trials), result.validation.met
    chosen = result.validation.named(result.validation.chosen)
    (evaluation,) = tuning_trials.measure(PLAN.choice_of(best.params), PLAN, PLAN.training_data())
    assert tuning_trials.violation(best) <= 0 and NIS_BAND[0] <= evaluation.nis.value <= NIS_BAND[1]
    assert nis_violation(evaluation) == pytest.approx(tuning_trials.violation(best))
    least = min(one.value for one in met)
    assert chosen.name.startswith("trial") and chosen.value <= 1.05 * least
    assert chosen.proper == max(one.proper for one in met if one.value <= 1.05 * least)
    assert 0.5 < chosen.nees < 2.0 and result.best_value < 1.05 * result.free_value
    by_band = next(one for one in met if one.name == f"trial {best.number + 1}")
    assert by_band.nees > 10.0  # what the band on the innovations alone would have chosen


def test_a_common_factor_on_q_and_r_is_what_makes_a_trial_consistent():
    result = studied(PLAN, 40)
    untuned, rescaled = result.trials[:2]
    assert tuning_trials.violation(untuned) > 0 and rescaled.user_attrs[RESCALED] == 1
    factors = {name: rescaled.params[name] / untuned.params[name] for name in ("Q11", "Q22", "R")}
    assert factors["Q11"] == pytest.approx(factors["R"]) == pytest.approx(factors["Q22"])
    assert (
        rescaled.values[0] == pytest.approx(untuned.values[0], rel=0.02) and tuning_trials.violation(rescaled) <= 0
    )


def test_one_trial_has_the_most_likely_noise_and_finds_what_sampling_finds_late():
    plan = Plan("ekf", (NOMINAL,), seed=3)
    result = studied(plan, MAXIMUM_LIKELIHOOD_AFTER + 2)
    (most_likely,) = [trial for trial in result.trials if MAXIMUM_LIKELIHOOD in trial.user_attrs]
    assert 0 < most_likely.number < 6
    found = tune_by_gradient("ekf", NOMINAL, plan.training_data()[0], [(1, 1, 1)])
    assert [most_likely.params[name] for name in found.names] == pytest.approx(found.best.parameters)
    true = evaluate(oracle_choice("ekf", NOMINAL).filter(NOMINAL), plan.training_data()[0], NOMINAL.scale)
    choice = choice_of("ekf", most_likely.params, NOMINAL)  # its trial may be pruned, and has no value then
    found = evaluate(choice.filter(NOMINAL), plan.training_data()[0], NOMINAL.scale)
    assert found.score.value < 1.005 * true.score.value


def test_with_r_held_the_most_likely_q_is_tried_and_without_a_covariance_nothing():
    result = studied(Plan("ekf", (NOMINAL,), hold_r=True), 8)
    (most_likely,) = [trial for trial in result.trials if MAXIMUM_LIKELIHOOD in trial.user_attrs]
    assert set(most_likely.params) == {"Q11", "Q22"}
    result = studied(Plan("low-pass", (NOMINAL,)), MAXIMUM_LIKELIHOOD_AFTER + 2)
    assert not any(MAXIMUM_LIKELIHOOD in trial.user_attrs for trial in result.trials)


def test_without_consistency_any_nis_will_do():
    result = studied(PLAN._replace(consistent=False), 8)
    assert result.free_value is None and not any(RESCALED in trial.user_attrs for trial in result.trials)
    assert {tuning_trials.violation(trial) for trial in result.trials} == {0.0}


def test_a_trial_ends_early_only_if_it_is_worse_on_the_same_seeds():
    result = studied(PLAN, 40)
    data = PLAN.training_data()
    pruned = [trial for trial in result.trials if trial.state == TrialState.PRUNED]
    assert len(pruned) == result.pruned > 0
    for trial in pruned[:5]:
        assert len(trial.intermediate_values) % BLOCK == 0 and len(trial.intermediate_values) < 32
        (whole,) = tuning_trials.measure(choice_of("ekf", trial.params, MISMATCH), PLAN, data)
        assert whole.score.value > result.best_value
    unpruned = studied(PLAN._replace(prune=False), 12)
    assert unpruned.pruned == 0 and not any(trial.intermediate_values for trial in unpruned.trials)


def test_the_reported_values_are_the_scores_of_single_seeds():
    result = studied(PLAN, 40)
    data = MISMATCH.data(range(32))
    for seed in (0, 9, 31):
        alone = data.slice(seed, seed + 1)
        filter_ = untuned_choice("ekf", MISMATCH).filter(MISMATCH)
        found = evaluate(filter_, alone, MISMATCH.scale).score.value
        assert result.trials[0].intermediate_values[seed] == pytest.approx(found, rel=1e-12)


def test_several_scenarios_are_averaged():
    plan = PLAN._replace(scenarios=(MISMATCH, OUTLIERS), prune=False)
    plans = [PLAN._replace(scenarios=(one,), prune=False) for one in plan.scenarios]
    values = [studied(one, 1).trials[0].values[0] for one in plans]
    assert studied(plan, 1).trials[0].values[0] == pytest.approx(np.mean(values), rel=1e-12)


@pytest.mark.parametrize("objective", ["thrust", "likelihood", "consistency"])
def test_every_objective_falls(objective):
    result = studied(PLAN._replace(objectives=(objective,), consistent=False), 15)
    assert result.best_value < result.trials[0].values[0]


@pytest.mark.slow
def test_two_objectives_give_a_front_that_no_trial_beats():
    plan = Plan("enkf", (NOMINAL,), objectives=("score", "cost"))
    result = studied(plan, 12)
    values = np.array([trial.values for trial in result.front])
    assert 1 <= len(values) and (np.diff(values[np.argsort(values[:, 0])][:, 1]) <= 0).all()
    assert {len(trial.values) for trial in result.trials} == {2}


@pytest.mark.parametrize("name", SAMPLERS)
def test_every_sampler_proposes_within_the_ranges(name):
    needed = {"gp": "torch", "cma-es": "cmaes"}.get(name)
    plan = PLAN._replace(sampler=name, consistent=False)
    if needed is not None and importlib.util.find_spec(needed) is None:
        with pytest.raises(ValueError, match=f"the sampler {name!r} needs {needed}, .*: pip install"):
            open_study("s", plan, optuna.storages.InMemoryStorage())
        return
    result = studied(plan, 4)
    assert len({tuple(trial.params.values()) for trial in result.trials}) == 4
    for key, distribution in distributions("ekf", MISMATCH).items():
        assert all(distribution.low <= trial.params[key] <= distribution.high for trial in result.trials)


def test_a_grid_ends_where_it_is_exhausted():
    sampler = tuning_trials.make_sampler("grid", 0, 0, {"N": distributions("enkf", NOMINAL)["N"]})
    assert isinstance(sampler, optuna.samplers.GridSampler)


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        ({"scenarios": ()}, "a study must have at least one scenario, but got none"),
        ({"objectives": ("score", "score")}, "objectives must be one, or two different ones"),
        ({"objectives": ("speed",)}, "objective must be one of score, mse, log-score, thrust, .* cost"),
        ({"filter": "low-pass", "objectives": ("likelihood",)}, "'likelihood' needs a filter with a covariance"),
        ({"sampler": "guess"}, "sampler must be one of tpe, gp, cma-es, nsga-ii, random, grid, but got 'guess'"),
    ],
)
def test_a_plan_that_cannot_work_is_refused(change, rule):
    refused(rule, open_study, "s", PLAN._replace(**change), optuna.storages.InMemoryStorage())


@pytest.mark.parametrize(
    ("name", "kind"), slow_but([("nominal", "ekf"), ("published_tunnel", "kf")], [("nominal", "ekf")])
)
def test_from_a_bad_start_a_study_of_a_perfect_model_comes_within_half_a_per_cent_of_the_true_q_and_r(name, kind):
    scenario = find_scenario(name)
    plan, true = Plan(kind, (scenario,)), oracle_choice(kind, scenario)
    factors = np.array(BAD_START)
    q, r = np.array(true.model["process_noise_cov"]) * factors[:2], scenario.measurement_noise_cov * factors[2]
    bad = true._replace(model={"process_noise_cov": tuple(q.tolist()), "measurement_noise_cov": float(r)})
    study = open_study("s", plan, optuna.storages.InMemoryStorage(), bad)
    comparison = evaluate_held_out(run_study(study, plan, 100).choice, scenario, plan.seed)
    started = evaluate(bad.filter(scenario), scenario.data(comparison.seeds), scenario.scale)
    assert score_ratio(started, comparison.true).low > 1.1
    assert score_ratio(comparison.tuned, comparison.true).high < 1.005


def test_a_trial_whose_nis_is_not_finite_is_inconsistent_and_has_no_twin(monkeypatch):
    def lost(*given, judge=trials.compute_metrics):
        evaluation = judge(*given)
        return evaluation._replace(nis=evaluation.nis._replace(value=np.nan))

    monkeypatch.setattr(trials, "compute_metrics", lost)
    result = studied.__wrapped__(PLAN, 3)
    assert len(result.trials) == 3 and all(tuning_trials.violation(trial) == LARGEST for trial in result.trials)
    assert not any(RESCALED in trial.user_attrs for trial in result.trials)


def test_a_trial_that_there_is_already_is_not_enqueued_again():
    study = optuna.create_study()
    distributions = {"R": FloatDistribution(0.01, 1.0), "N": IntDistribution(5, 200)}
    params = {"R": 0.25, "N": 30}
    study.add_trial(optuna.trial.create_trial(params=params, distributions=distributions, value=1.0))
    for r, size, count in ((0.25, 30, 1), (0.25 + 1e-7, 30, 1), (0.2501, 30, 2), (0.25, 31, 3), (0.2501, 30, 3)):
        tuning_trials.enqueue_new(study, {"R": r, "N": size}, {})
        assert len(study.trials) == count


def test_r_may_be_held_at_the_sensor_s_sheet():
    result = studied(PLAN._replace(hold_r=True), 10)
    assert set(result.trials[0].params) == {"Q11", "Q22"}
    assert result.choice.model["measurement_noise_cov"] == MISMATCH.measurement_noise_cov
    assert not any(RESCALED in trial.user_attrs for trial in result.trials)
    assert result.best_value < result.trials[0].values[0]


def test_trials_have_a_nees_where_an_objective_is_made_of_it_alone():
    for objectives, known in ((("score",), False), (("score", "consistency"), True)):
        plan = PLAN._replace(objectives=objectives)
        (found,) = tuning_trials.measure(
            untuned_choice("ekf", MISMATCH), plan, [PLAN.training_data()[0].slice(0, 2)]
        )
        assert np.isfinite(found.nees.value) == np.isfinite(found.median_nees) == known
        assert np.isfinite(found.score.value) and np.isfinite(found.nis.value)


def test_the_box_of_a_search_grows_with_the_best_trial_and_stays_in_the_range():
    space = {name: FloatDistribution(1e-10, 1e4, log=True) for name in ("Q11", "R")} | {"N": IntDistribution(5, 9)}
    first = {"Q11": (1e-5, 1e2), "R": (1e-2, 1e3)}
    ends = {
        name: (one.low, one.high)
        for name, one in tuning_trials.box(space, first, {"Q11": 1e-6, "R": 2e3, "N": 5}).items()
    }
    assert ends == {"Q11": (1e-6 / 10.0, 1e2), "R": (1e-2, 1e4), "N": (5, 9)}
    assert tuning_trials.box(space, first, {})["Q11"] == FloatDistribution(1e-5, 1e2, log=True)


@pytest.mark.parametrize(("sampler", "trials"), [("tpe", 25), ("gp", 14), ("random", 25)])
def test_a_search_reaches_what_lies_outside_the_box_that_it_begins_in(sampler, trials):
    study = optuna.create_study(sampler=tuning_trials.make_sampler(sampler, 0, 0, {}, first={"Q": (1e-5, 1e2)}))
    study.optimize(lambda trial: np.log10(trial.suggest_float("Q", 1e-10, 1e4, log=True)), n_trials=trials)
    values = np.array([trial.params["Q"] for trial in study.trials])
    best = np.minimum.accumulate([1e-4, *values])[:-1]
    lowest = np.minimum(1e-5, best / 10.0)
    assert (lowest <= values * (1 + 1e-9)).all() and (values <= 1e2).all()
    assert values.min() < 1e-5


class Attack:
    """Makes a file when it is unpickled."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return open, (str(self.marker), "w")


def test_a_trial_s_state_is_read_as_data_and_no_code_runs(tmp_path, monkeypatch):
    monkeypatch.setitem(NEEDS, "cma-es", (None, None))  # the package is not there yet where this matters
    marker = tmp_path / "marker"
    state = {"cma:optimizer:0": pickle.dumps(Attack(marker)).hex()}
    trial = optuna.trial.create_trial(value=1.0, system_attrs=state)
    sampler = tuning_trials.make_sampler("cma-es", 0, 0, {})
    refused("must be that of an optimizer, but a trial's names .*open$", sampler._restore_optimizer, [trial])
    assert not marker.exists()
    assert sampler._restore_optimizer([optuna.trial.create_trial(value=1.0)]) is None


def test_arrays_are_read_and_what_is_damaged_is_one_clear_line():
    arrays = {"mean": np.arange(3.0), "n": np.float64(2.5), "transposed": np.eye(2).T}
    found = tuning_trials.read_state(pickle.dumps(arrays).hex())
    assert found["n"] == 2.5 and (found["mean"] == arrays["mean"]).all()
    for text in ("", "80", pickle.dumps(arrays).hex()[:-20], "no digits"):
        with pytest.raises(ValueError) as error:
            tuning_trials.read_state(text)
        assert "\n" not in str(error.value)


def test_a_study_goes_on_as_with_optuna_s_own():
    pytest.importorskip("cmaes", reason="optional: an extra that tests do without")

    def values(sampler):
        study = optuna.create_study(sampler=sampler)
        study.optimize(lambda t: t.suggest_float("x", -5, 5) ** 2 + t.suggest_float("y", -5, 5) ** 2, n_trials=30)
        return [trial.value for trial in study.trials]

    ours = tuning_trials.make_sampler("cma-es", 0, 0, {})
    seed = int(np.random.SeedSequence([0, 0, 0]).generate_state(1)[0])
    assert values(ours) == values(optuna.samplers.CmaEsSampler(seed=seed))


@pytest.mark.parametrize("name", FILTERS)
def test_a_choice_survives_its_trial_parameters(name):
    choice = untuned_choice(name, NOMINAL)
    assert choice_of(name, parameters_of(choice), NOMINAL) == choice
    assert choice.filter(NOMINAL).name == name


@pytest.mark.parametrize(("name", "size"), [("enkf", 30), ("ienkf", 30), ("pf", 1000), ("rbpf", 100)])
def test_particle_filters_have_sizes_of_their_own(name, size):
    assert untuned_choice(name, NOMINAL).numbers["ensemble_size"] == size
    ladder = size_ladder(name)
    assert (ladder[0], ladder[-1]) == {30: (5, 200), 100: (20, 1000), 1000: (200, 5000)}[size] and size in ladder


@pytest.mark.parametrize("name", ["pf", "apf"])
def test_particles_are_regularised_by_a_study_where_there_is_no_process_noise(name):
    untuned, known = untuned_choice(name, lorenz63.problem), untuned_choice(name, NOMINAL)
    assert untuned.numbers["regularisation"] == 0.0 and "regularisation" not in known.numbers
    assert "regularisation" not in distributions(name, NOMINAL)
    space = distributions(name, lorenz63.problem, hold_r=True)
    values = {"N": 300, "regularisation": 1.5} | ({"resampling_threshold": 0.3} if name == "pf" else {})
    choice = choice_of(name, values, lorenz63.problem)
    assert set(space) == set(values) and trial_parameters(choice, space) == values
    assert choice.filter(lorenz63.problem).regularisation == 1.5


def test_baselines_are_not_searched_over_q_and_r():
    assert parameters_of(untuned_choice("open-loop", NOMINAL)) == {}
    assert parameters_of(untuned_choice("low-pass", NOMINAL)) == {"time_constant": 2.0}
    choice = choice_of("low-pass", {"time_constant": 4.0}, NOMINAL)
    assert choice.numbers == {"time_constant": 4.0} and parameters_of(choice) == {"time_constant": 4.0}
    storage = optuna.storages.InMemoryStorage()
    for name in ("open-loop", "inversion"):
        with pytest.raises(ValueError, match=f"filter must have something to tune, but got '{name}'"):
            open_study("s", Plan(name, (NOMINAL,)), storage)
