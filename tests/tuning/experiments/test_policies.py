"""`thruster reproduce policies`: its statistics as textbooks have them, its plan, its runs and what it writes."""

import json
from itertools import pairwise

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from scipy.stats import t as student
from scipy.stats import ttest_ind

from tests.filters.checks import refused
from tuning.experiments import policies as runs
from tuning.experiments.policies import (
    BEST,
    CLASSICAL,
    EPISODES,
    QUICK,
    VARIANTS,
    WRONG,
    Comparison,
    Figure,
    Result,
    Run,
    as_interval,
    combined,
    mean_figure,
    run_comparison,
    runs_of,
    typical_error,
    typical_return,
)
from tuning.experiments.policies_report import HEADER, answers, rows_of, summary_rows
from tuning.plants.thruster import find_scenario
from tuning.policies.environments import make_environments
from tuning.policies.saved import Scores, classical_policy, run_episodes, score
from tuning.policies.setup import FIRST_SCORED_STEP, THRUSTER, Part, make_configuration
from tuning.problems.data import held_out_seeds

MEDIUM = find_scenario("medium_noise")
SEEDS = held_out_seeds(0, 3)


def setup(observe, seed=0, steps=2048):
    return make_configuration("manoeuvre", MEDIUM, observe, steps=steps, seed=seed)


def result(observe, returns, kind="ppo", errors=1.0, seed=0):
    """A made-up result with these returns, and thrust errors of some size in all parts."""
    returns = np.asarray(returns, dtype=float)
    part = Part(np.full(returns.size, 100 * errors**2), np.full(returns.size, 100))
    scores = Scores(returns, dict.fromkeys(THRUSTER.parts, part))
    return Result(Run("medium", kind, "", setup(observe, seed)), scores, [], 1.0)


def test_the_interval_of_a_return_is_that_of_the_mean_over_episodes():
    returns = np.random.default_rng(3).normal(-2.0, 0.5, 400)
    interval = as_interval(typical_return([result("ekf", returns)]))
    assert interval.value == pytest.approx(returns.mean())
    half = 1.966 * returns.std(ddof=1) / 20
    assert (interval.high - interval.low) / 2 == pytest.approx(half, rel=1e-3)


def test_training_seeds_widen_the_interval_of_a_return_and_of_an_error():
    noise = np.random.default_rng(3).normal(0.0, 0.01, (5, 100))
    levels = np.array([-1.0, -1.1, -1.2, -1.3, -1.4])
    made = [result("ekf", level + row, errors=-level) for level, row in zip(levels, noise, strict=True)]
    half = 2.776 * levels.std(ddof=1) / 5**0.5
    for found in (as_interval(typical_return(made)), as_interval(typical_error(made, "steady"))):
        assert abs(found.value) == pytest.approx(1.2, abs=0.01)
        assert (found.high - found.low) / 2 == pytest.approx(half, rel=0.02)


def with_parts(made, **parts):
    return made._replace(scores=made.scores._replace(parts={**made.scores.parts, **parts}))


def test_thrust_errors_are_pooled_before_the_root():
    two = Part(np.array([3.0, 1.0]), np.array([1, 3]))
    made = result("ekf", [0.0, 0.0])
    made = with_parts(made, steady=two)
    assert typical_error([made], "steady").value == pytest.approx(1.0)
    none = with_parts(made, reversal=Part(np.zeros(2), np.zeros(2, dtype=int)))
    assert np.isnan(typical_error([none], "reversal").value)


def test_the_table_tells_what_part_of_the_gap_to_the_best_controller_is_closed():
    noise = np.random.default_rng(1).normal(0.0, 0.01, 60)
    made = [result(arm, level + noise) for arm, level in (("raw", -4.0), ("ekf", -2.0), ("true", -1.5))]
    made += [result(arm, level + noise, kind=BEST) for arm, level in (("ekf", -1.6), ("true", -1.0))]
    made.append(result("ekf", -3.0 + noise, kind="pi", errors=2.0))
    made.append(result("ekf", -4.0 + noise, kind="lqr"))
    rows = {row[0]: dict(zip(HEADER, row, strict=True)) for row in rows_of(made, "medium")}
    assert rows["PPO: ekf"]["gap closed"] == "67 %" and rows["PI: ekf"]["gap closed"] == "33 %"
    assert rows["PPO: raw"]["gap closed"] == "0 %" and rows["MPC: true"]["gap closed"] == "100 %"
    assert rows["PPO: true"]["gap closed"] == "83 %" and rows["PI: ekf"]["steady"] == "2.00"
    said = dict(summary_rows(made))
    assert said["gap closed by PPO: ekf"].startswith("66.7 % [66.") and said["gap closed by PPO: enkf"] == ""
    assert said["cost of MPC: ekf / of MPC: true"].startswith("1.600 [")
    assert said["cost of PPO: stack / of PPO: ekf"] == ""
    assert said["cost of PPO: ekf / of MPC: ekf"].startswith("1.250 [")
    assert said["cost of LQG: ekf / of MPC: ekf"].startswith("2.500 [")
    found = answers(made)
    assert "at least 66.7 % [66." in found[0]
    assert found[0].endswith("70 % is not reached by all, intervals counted.")
    assert "knowing the true state is worth +0.6000 [+0.6000, +0.6000]: better." in found[1]
    assert found[2].startswith("PPO: true costs 1.500 [") and found[2].endswith("as much as MPC: not within 2 %.")


@pytest.mark.parametrize(
    ("level", "said"),
    [(-0.99, "better"), (-1.01, "within 2 %"), (-1.02, "perhaps within 2 %"), (-1.1, "not within")],
)
def test_near_the_best_controller_means_with_the_whole_interval(level, said):
    noise = np.random.default_rng(1).normal(0.0, 0.1, 60)
    own = np.random.default_rng(2).normal(0.0, 0.003, 60)
    made = [result("true", level + noise + own), result("true", -1.0 + noise, kind=BEST)]
    (found,) = answers(made)
    assert f"as much as MPC: {said}" in found


def test_answers_on_a_situation_that_the_model_does_not_know_and_none_without_a_gap():
    made = [result("ekf", [-1.0, -1.1])._replace(run=Run("medium", "ppo", "dead band", setup("ekf")))]
    made.append(result("ekf", [-1.5, -1.6])._replace(run=Run("medium", BEST, "dead band", setup("ekf"))))
    assert answers(made) == ["PPO: ekf, dead band returns +0.500 [+0.500, +0.500] more than MPC: better."]
    made = [result(arm, np.full(20, -1.0)) for arm in ("raw", "ekf")]
    made.append(result("true", np.full(20, -1.0), kind=BEST))
    assert {row[2] for row in rows_of(made, "medium")} == {""} and answers(made) == []


def test_scores_are_what_a_naive_loop_finds():
    chosen = setup("ekf")
    policy = classical_policy("lqr", chosen)
    found = score(policy, chosen, SEEDS)
    venv = make_environments(chosen, SEEDS, endless=True)
    returns, (thrusts, references, shown), alive = run_episodes(policy, venv, 500, THRUSTER)
    assert alive.all()
    assert np.array_equal(found.returns, returns)
    for b in range(len(SEEDS)):
        changes = [0] + [k for k, (r, s) in enumerate(pairwise(references[b]), start=1) if abs(s - r) > 1.0]
        crossed = [k for k, (r, s) in enumerate(pairwise(references[b]), start=1) if r * s < 0]
        after = {k for change in changes for k in range(change, change + 15)} & set(range(500))
        reversal = {k for change in crossed for k in range(change, change + 15)} & set(range(500))
        squares = (thrusts[b] - references[b]) ** 2
        assert 9 <= len(changes) <= 11 and crossed
        parts = {"transient": after, "steady": set(range(500)) - after, "reversal": reversal}
        for name, steps in parts.items():
            part = found.parts[name]
            assert part.steps[b] == len(steps) and part.squares[b] == pytest.approx(squares[sorted(steps)].sum())
        late = slice(FIRST_SCORED_STEP, None)
        seen = ((shown[b] - thrusts[b])[late] ** 2).sum()
        assert found.parts["observed"].squares[b] == pytest.approx(seen)
        assert found.parts["observed"].steps[b] == 450
    assert found.parts["all"].steps.tolist() == [500] * 3


def test_pi_has_gains_that_do_better_than_the_usual_ones_on_held_out_episodes():
    chosen = setup("raw")
    found = classical_policy("pi", chosen)
    usual = found.controller.for_env(make_environments(chosen, [0], native=False).envs[0])
    held_out = held_out_seeds(0, 40)
    of_usual = score(type(found)(usual, 0, found.half), chosen, held_out).returns
    assert (score(found, chosen, held_out).returns - of_usual).mean() > 0.5


def test_a_controller_of_states_refuses_raw_measurements():
    for name in ("lqr", "one-step", "mpc"):
        refused(f"{name} must observe a state, but got observe='raw'", classical_policy, name, setup("raw"))
    with pytest.raises(ValueError, match="controller must be one of pi, lqr, one-step, mpc, but got 'pid'"):
        classical_policy("pid", setup("raw"))


def test_predictive_control_beats_lqr_and_a_horizon_changes_little():
    chosen, seeds = setup("true"), held_out_seeds(0, 40)
    lqr, one, best = (score(classical_policy(name, chosen), chosen, seeds) for name in ("lqr", "one-step", "mpc"))
    assert one.returns.mean() > 0.25 * lqr.returns.mean()
    assert best.returns.mean() == pytest.approx(one.returns.mean(), abs=1e-3)


def test_a_predictive_controller_believes_in_what_its_filter_does():
    assumed = find_scenario("mismatch").parameter_factors
    wrong = make_configuration("manoeuvre", MEDIUM.replace(parameter_factors=assumed), "ekf")
    policies = (classical_policy("mpc", chosen) for chosen in (wrong, setup("ekf")))
    told, right = (policy.controller.problem.constants for policy in policies)
    assert told.voltage_gain == pytest.approx(0.95 * right.voltage_gain)


def test_the_plan_has_every_arm_at_every_noise_with_equal_networks_and_steps():
    planned = runs_of(Comparison(seeds=2, variants=False))
    assert len({run.name for run in planned}) == len(planned)
    for kind, count in (("ppo", 2 * 3 * 7), ("ppo+mpc", 2 * 4), ("sac", 2 * 2), ("sac+mpc", 2 * 2)):
        learnt = [run for run in planned if run.kind == kind]
        numbers = {json.dumps([run.setup.steps, run.setup.num_envs, run.setup.hyperparameters]) for run in learnt}
        assert len(learnt) == count and len(numbers) == 1
        assert {run.setup.controller for run in learnt} == {BEST if kind.endswith("+mpc") else None}
    classical = [(run.kind, run.setup.observe) for run in planned if run.noise == "low" and run.kind in CLASSICAL]
    assert classical == [(kind, arm) for kind, arms in CLASSICAL.items() for arm in arms]
    variances = {run.noise: run.setup.env_arguments["measurement_noise_cov"] for run in planned}
    assert variances == {"low": 0.25, "medium": 4.0, "high": 16.0}
    assert {tuple(run.setup.env_arguments["process_noise_cov"]) for run in planned} == {(4.0, 0.01)}
    with_memory = runs_of(Comparison(noises=("low",), seeds=1, variants=False, recurrent=True))
    assert [run.name for run in with_memory if run.kind == "recurrent-ppo"] == ["low-recurrent-ppo-raw-seed0"]


def test_variants_change_what_the_filter_assumes_and_nothing_else():
    runs_there = runs_of(Comparison(noises=("medium",), observation_sets=("ekf",), seeds=1))
    planned = {run.label: run.setup for run in runs_there if run.kind == "ppo"}
    best = {run.label: run.setup for run in runs_there if run.kind == BEST}
    for arm, variant in VARIANTS:
        assert best[f"{arm}, {variant}"].filter_arguments == planned[f"{arm}, {variant}"].filter_arguments
    assert {run.variant for run in runs_there if run.kind == "ppo+mpc"} == {"", *WRONG}
    (dead,) = planned["ekf, dead band"].env_arguments["amplifier"]
    (flow,) = planned["ekf, unknown flow"].env_arguments["flow"]
    assert dead["name"] == "dead-band" and flow["name"] == "gauss-markov"
    exact, wrong = planned["ekf"], planned["ekf, wrong model"]
    assert exact.filter_arguments == {}
    assert wrong.filter_arguments == {"parameter_factors": {"lift_coefficient": 1.15, "voltage_gain": 0.95}}
    assert wrong.env_arguments == exact.env_arguments
    untuned, tuned = planned["ekf, untuned"].filter_arguments, planned["ekf, tuned"].filter_arguments
    assert untuned["process_noise_cov"] == list(MEDIUM.untuned["process_noise_cov"])
    found = np.asarray(tuned["process_noise_cov"])
    variances = np.diag(found) if found.ndim == 2 else found
    assert np.allclose(np.log(variances / [4.0, 0.01]), 0.0, atol=np.log(2))
    assert set(planned["ekf, wrong model tuned"].filter_arguments) == {"parameter_factors", *tuned}


@pytest.mark.slow
def test_what_is_done_is_kept_after_an_interruption_and_done_once(tmp_path, monkeypatch):
    planned = [Run("medium", "ppo", "", setup("raw", seed)) for seed in range(2)]
    monkeypatch.setattr(runs, "runs_of", lambda comparison: planned)
    comparison = QUICK._replace(episodes=2)

    def interrupt(run, done, count):
        assert (done, count) == (1, 2)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_comparison(comparison, tmp_path, None, interrupt)
    (kept,) = tmp_path.glob("runs/*.json")
    written = kept.read_bytes(), kept.stat().st_mtime_ns
    seen = []
    results = run_comparison(comparison, tmp_path, None, lambda run, done, count: seen.append((run.name, done)))
    assert [found.run for found in results] == planned and len(seen) == 1 and seen[0][1] == 2
    assert (kept.read_bytes(), kept.stat().st_mtime_ns) == written
    assert all(len(found.scores.returns) == 2 and found.curve for found in results)
    run_comparison(comparison, tmp_path, None, lambda run, done, count: pytest.fail("nothing is left to do"))
    kept.write_text(kept.read_text()[:100])
    refused(r"json must be a whole file of results, but cannot be read", run_comparison, comparison, tmp_path)


@pytest.mark.slow
def test_the_quick_form_compares_every_arm_and_draws(thruster, tmp_path, monkeypatch):
    monkeypatch.setattr("tuning.experiments.policies_report.QUICK", QUICK._replace(episodes=4))
    command = "reproduce", "policies", "--quick", "--seeds", 1, "--steps", 2048, "--out", "found"
    done = thruster(*command, "--json", "found.json")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("Rough, by --quick")
    found = json.loads((tmp_path / "found.json").read_text())
    named = {row[HEADER[0]] for row in found["policies"]["medium"]}
    assert {f"PPO: {arm}" for arm in QUICK.observation_sets} < named
    classical = {"PI: raw", "LQG: kf", "LQR: true", "one step: enkf", "MPC: true"}
    assert classical | {"SAC: ekf", "PPO + MPC: true"} < named
    assert [(tmp_path / file).read_bytes()[:4] for file in found["files"]] == [b"\x89PNG"] * 2
    times = {path: path.stat().st_mtime_ns for path in (tmp_path / "found" / "runs").glob("*.json")}
    assert len(times) == len(named)
    assert thruster(*command).returncode == 0
    assert {path: path.stat().st_mtime_ns for path in times} == times


TRAININGS, EPISODE_COUNT = 5, 40
TRIALS = 1200


def figure(returns, source="a"):
    """The mean of returns (E, S), a column per training seed."""
    without = (returns.sum(axis=0) - returns) / (len(returns) - 1)
    return mean_figure(returns.mean(axis=0), without, source)


def returns_of(generator, episodes, level, spread, own, count=TRAININGS):
    """Returns (E, S) of policies that differ by seed, on episodes that are harder or easier for all of them."""
    seeds, noise = generator.normal(0.0, spread, count), generator.normal(0.0, own, (len(episodes), count))
    return level * (1.0 + 0.2 * episodes[:, None]) + seeds + noise


def test_of_one_policy_or_of_one_seed_it_is_students_interval():
    levels = np.array([-1.0, -1.1, -1.2, -1.3, -1.5])
    found = as_interval(figure(np.tile(levels, (EPISODE_COUNT, 1))))
    half = student.ppf(0.975, 4) * levels.std(ddof=1) / 5**0.5
    assert found == pytest.approx((levels.mean(), levels.mean() - half, levels.mean() + half))
    returns = np.random.default_rng(0).normal(-2.0, 0.5, (30, 1))
    found = as_interval(figure(returns))
    half = student.ppf(0.975, 29) * returns.std(ddof=1) / 30**0.5
    assert found == pytest.approx((returns.mean(), returns.mean() - half, returns.mean() + half))


def test_the_difference_of_two_policies_is_welchs():
    generator = np.random.default_rng(1)
    one, other = generator.normal(-1.0, 0.1, 5), generator.normal(-1.1, 0.4, 8)
    found = as_interval(figure(np.tile(one, (9, 1)), "one") - figure(np.tile(other, (9, 1)), "other"))
    expected = ttest_ind(one, other, equal_var=False).confidence_interval(0.95)
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high))


def test_episodes_are_shared_and_seeds_are_not():
    hard = np.random.default_rng(0).normal(-5.0, 3.0, (50, 1))
    assert as_interval(figure(hard + 0.25, "a") - figure(hard, "b")) == pytest.approx((0.25, 0.25, 0.25))
    levels = np.tile([-1.0, -2.0, -3.0], (50, 1))
    same, tied = figure(levels, "a"), as_interval(figure(levels, "a") - figure(levels, "b"))
    assert as_interval(same - same) == pytest.approx((0, 0, 0)) and tied.high > 1.5 and tied.value == 0


def test_figures_combine_as_their_numbers_do():
    one, other = Figure(6.0, {EPISODES: np.array([6.0, 7.0])}), Figure(2.0, {"b": np.array([1.0, 2.0, 4.0])})
    ratio = combined(lambda a, b: a / b, one, other)
    assert ratio.value == 3.0 == (one / other).value
    np.testing.assert_array_equal(ratio.without[EPISODES], [3.0, 3.5])
    np.testing.assert_array_equal(ratio.without["b"], [6.0, 3.0, 1.5])


def covered(own):
    """The share of trials whose interval has the truth, for each question that a comparison asks, by name."""
    generator, hits = np.random.default_rng(7), {}
    for _ in range(TRIALS):
        episodes = generator.normal(size=EPISODE_COUNT)
        for name, truth, interval in questions(generator, episodes, own):
            hits[name] = hits.get(name, 0) + (interval[0] <= truth <= interval[1])
    return {name: count / TRIALS for name, count in hits.items()}


def questions(generator, episodes, own):
    raw, ekf, true = (
        figure(returns_of(generator, episodes, level, spread, own), name)
        for name, level, spread in (("raw", -6.0, 0.3), ("ekf", -0.72, 0.02), ("true", -0.5, 0.01))
    )
    best = figure(returns_of(generator, episodes, -0.45, 0.0, own, count=1))  # a controller: nothing was trained
    for name, truth, made in (
        ("one policy", -0.72, ekf),
        ("difference of two", -0.22, ekf - true),
        ("ratio of two", 1.44, ekf / true),
        ("ratio to a controller", 1.6, ekf / best),
        ("gap closed", (6.0 - 0.72) / (6.0 - 0.45), combined(lambda a, b, c: (a - b) / (c - b), ekf, raw, best)),
    ):
        found = as_interval(made)
        yield name, truth, (found.low, found.high)


def test_with_five_seeds_intervals_cover_what_they_promise_or_are_rather_too_wide():
    # 95 %, to three standard errors of 1200 trials.
    share = covered(own=0.03)
    assert len(share) == 5 and all(abs(found - 0.95) < 0.019 for found in share.values()), share
    # What a policy does in one episode and not in others is in both sources of chance.
    share = covered(own=0.3)
    assert all(found > 0.935 for found in share.values()), share


def test_the_bootstrap_of_five_seeds_covers_less_than_it_promises():
    generator = np.random.default_rng(3)
    seeds = generator.normal(size=(2000, TRAININGS))
    drawn = generator.integers(TRAININGS, size=(400, TRAININGS))
    low, high = np.quantile(seeds[:, drawn].mean(axis=2), [0.025, 0.975], axis=1)
    assert 0.80 < ((low <= 0) & (high >= 0)).mean() < 0.90
    means = [as_interval(figure(row[None].repeat(2, axis=0))) for row in seeds]
    assert 0.935 < np.mean([found.covers(0.0) for found in means]) < 0.965
