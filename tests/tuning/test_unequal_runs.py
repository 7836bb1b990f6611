"""Runs of different lengths, a truth here and there, lists of problems: metrics are those of each run, pooled."""

import numpy as np
import optuna
import pytest
from scipy.stats import t

import tuning
from filters import bounds, make_filter, run
from filters.bounds import posterior_variances
from filters.consistency.nees import RESAMPLES, normalized_squares, whitened
from filters.consistency.report import consistency_report
from tests.filters.checks import refused
from tests.linear_problem import LinearProblem
from thruster_env.model.affine import affine_model
from tuning.evaluation.evaluate import check_consistency, evaluate, likelihood_gain, score_ratio
from tuning.evaluation.sizes import ensemble_sizes, few_seeds_first
from tuning.likelihood.gradient import goal_of
from tuning.likelihood.identifiability import identify
from tuning.problems.check import check_data, checked_problem
from tuning.problems.data import Data, mask_of, only, padded
from tuning.problems.log_problem import LogProblem
from tuning.problems.model_problem import RunsProblem, average_bound, log_of
from tuning.problems.problem import Parameter
from tuning.reporting.time_figures import one_run
from tuning.search.among_types import close_size
from tuning.search.plan import Plan
from tuning.search.space import untuned_choice
from tuning.search.trials import BLOCK, measure, shares

LENGTHS, FIRST, SCALE = (75, 40, 61, 40, 28), 10, np.array([0.3, np.inf, 0.5])
MODEL = LinearProblem().model()
KF, WORSE = (make_filter("kf", MODEL.replace(process_noise_cov=[q, 0.02, 0.02])) for q in (0.02, 0.3))
GAPS = np.arange(75) % 7 != 3  # where the truth is known, in the second test


def runs_of(lengths=LENGTHS):
    """Each run alone: inputs, measurements, states."""
    found = [LinearProblem(steps=count - 1).data([7 + place]) for place, count in enumerate(lengths)]
    return [(one.inputs[0], one.measurements[0], one.states[0]) for one in found]


def data_of(runs, truth=None, junk=None):
    """The runs as one; `junk` stands in the padding, and where the truth is unknown."""
    inputs, measurements, states = zip(*runs, strict=True)
    rows = max(map(len, measurements))
    exists = mask_of([len(one) for one in measurements], rows)
    counted = exists if truth is None else only(exists, np.broadcast_to(truth[:rows], (len(runs), rows)))
    given = padded(inputs, rows - 1, None), padded(measurements, rows), padded(states, rows)
    if junk is not None:
        given[0][~exists[:, 1:]], given[1][~exists], given[2][~counted] = junk, junk, junk
    keys = np.zeros((len(runs), 2))
    with np.errstate(over="ignore"):
        energy = {"E": 0.5 * given[2][..., 1] ** 2}
    return Data(tuple(range(len(runs))), given[0], given[1], keys, FIRST, given[2], energy, counted)


def by_hand(filter_, runs, truth=None):
    """Squares, NEES, NIS, log-likelihoods and channels of the scored steps of each run, run alone."""
    found = []
    for inputs, measurements, states in runs:
        one = run(filter_, np.zeros((1, 2)), inputs[None], measurements[None])
        there = np.arange(len(measurements)) >= FIRST
        there &= True if truth is None else truth[: len(measurements)]
        errors, nu = one.means[0] - states, one.innovations[0]
        nis = np.where(np.isnan(measurements).all(axis=1), np.nan, normalized_squares(nu, one.innovation_covs[0]))
        energy = 0.5 * (one.means[0, :, 1] ** 2 - states[:, 1] ** 2)
        parts = errors**2, normalized_squares(errors, one.covs[0]), nis, one.log_likelihoods[0], energy**2
        found.append([part[there] for part in parts])
    return found


@pytest.mark.parametrize("truth", [None, GAPS], ids=["lengths", "gaps in the truth"])
def test_metrics_are_those_of_each_run_pooled_over_all_scored_steps(truth):
    runs = runs_of()
    found = evaluate(KF, data_of(runs, truth), SCALE)
    squares, nees, nis, likelihoods, energy = zip(*by_hand(KF, runs, truth), strict=True)
    rmse = np.sqrt(np.concatenate(squares).mean(axis=0))
    np.testing.assert_allclose([one.value for one in found.rmse], rmse, rtol=1e-12)
    assert found.score.value == pytest.approx((rmse[0] / 0.3 + rmse[2] / 0.5) / 2, rel=1e-12)
    assert found.nees.value == pytest.approx(np.concatenate(nees).mean(), rel=1e-10)
    assert found.median_nees == pytest.approx(np.median(np.concatenate(nees)), rel=1e-10)
    assert found.nis.value == pytest.approx(np.nanmean(np.concatenate(nis)), rel=1e-10)
    np.testing.assert_allclose(found.log_likelihoods, [one.sum() for one in likelihoods], rtol=1e-12)
    assert found.output_rmse["E"].value == pytest.approx(np.sqrt(np.concatenate(energy).mean()), rel=1e-12)
    assert len(np.concatenate(squares)) < 5 * max(LENGTHS)


def test_intervals_resample_whole_runs_with_their_lengths():
    runs = runs_of()
    found = evaluate(KF, data_of(runs), SCALE)
    squares = [one[0] for one in by_hand(KF, runs)]
    picks = np.random.default_rng(0).multinomial(5, [0.2] * 5, size=RESAMPLES)
    sums, counts = np.array([one.sum(axis=0) for one in squares]), np.array([len(one) for one in squares])
    ends = np.quantile(np.sqrt(picks @ sums / (picks @ counts)[:, None]), [0.025, 0.975], axis=0)
    rmse, wider = np.sqrt(sums.sum(axis=0) / counts.sum()), t.ppf(0.975, 4) / 1.96 * np.sqrt(5 / 4)
    expected = rmse * (ends / rmse) ** wider
    np.testing.assert_allclose([(one.low, one.high) for one in found.rmse], expected.T, rtol=1e-12)
    worse = evaluate(WORSE, data_of(runs), SCALE)
    np.testing.assert_allclose(score_ratio(worse, found).value, worse.score.value / found.score.value, rtol=1e-12)
    assert likelihood_gain(found, worse).value == pytest.approx(found.log_likelihood - worse.log_likelihood)


@pytest.mark.slow
@pytest.mark.parametrize("junk", [np.nan, np.inf, 1e300, -3.0])
def test_nothing_in_the_padding_changes_any_number(junk):
    clean, dirty = (data_of(runs_of(), GAPS, given) for given in (None, junk))
    for filter_ in (KF, make_filter("enkf", MODEL, ensemble_size=6)):
        for one, other in zip(evaluate(filter_, clean, SCALE), evaluate(filter_, dirty, SCALE), strict=True):
            np.testing.assert_array_equal(np.array(one, dtype=object), np.array(other, dtype=object))
        reports = [repr(check_consistency(filter_, data)) for data in (clean, dirty)]
        assert reports[0] == reports[1]
    problem = LinearProblem()
    found = [goal_of("kf", problem, data)(np.log(np.full(5, 0.1))) for data in (clean, dirty)]
    np.testing.assert_array_equal(found[0].scores, found[1].scores)
    assert np.isfinite(found[0].part_values).all()
    np.testing.assert_array_equal(clean.beginning.measurements, dirty.beginning.measurements)
    check_data(dirty, MODEL, "dirty")
    shown = [one_run(KF, data, 1, None) for data in (clean, dirty)]
    assert len(shown[0].time) == LENGTHS[1] and np.nanmax(np.abs(shown[0].errors - shown[1].errors)) == 0


def test_consistency_is_looked_at_where_steps_are_scored():
    data, runs = data_of(runs_of(), GAPS), runs_of()
    found = check_consistency(KF, data)
    squares, nees, nis, *_ = zip(*by_hand(KF, runs, GAPS), strict=True)
    assert found.nees.mean.value == pytest.approx(np.concatenate(nees).mean(), rel=1e-10)
    assert found.nis.mean.value == pytest.approx(np.nanmean(np.concatenate(nis)), rel=1e-10)
    estimates = run(KF, data.filter_keys, data.seen.inputs, data.seen.measurements)
    deviations = np.sqrt(estimates.covs[..., 0, 0])[data.scored]
    inside = np.sqrt(np.concatenate(squares)[:, 0]) <= 1.959964 * deviations
    assert found.coverage[0].value == pytest.approx(inside.mean(), rel=1e-12)
    e = whitened(estimates.innovations, estimates.innovation_covs)
    there = data.scored[..., None] & ~np.isnan(data.measurements)
    pairs, e = there[:, :-1, 0] & there[:, 1:, 0], np.where(there, e, 0.0)
    size = (e[..., 0] ** 2).sum() / there[..., 0].sum()
    expected = (e[:, :-1, 0] * e[:, 1:, 0]).sum() / pairs.sum() / size
    assert found.whiteness.correlations[0, 0, 0] == pytest.approx(expected, rel=1e-10)
    alone = consistency_report(estimates, data.states, data.measurements, first_step=FIRST, counted=data.counted)
    assert alone.nees.mean == found.nees.mean


def test_what_all_runs_have_is_scored_as_before_to_the_last_bit():
    data = LinearProblem().data(range(4))
    everything = data._replace(counted=np.ones(data.measurements.shape[:2], dtype=bool))
    before, masked = evaluate(KF, data, SCALE), evaluate(KF, everything, SCALE)
    assert before.weights is None and masked.weights is None
    errors = run(KF, data.filter_keys, data.inputs, data.measurements).means - data.states
    late = np.ascontiguousarray(np.swapaxes(errors[:, FIRST:] ** 2, 0, 1))
    np.testing.assert_array_equal(before.mean_squares, late.mean(axis=0))
    np.testing.assert_allclose([one.value for one in before.rmse], [one.value for one in masked.rmse], rtol=1e-13)


def test_a_restart_in_the_padding_is_none():
    unstable = affine_model(A=[[30.0]], B=[[1.0]], C=[[1.0]], Q=[1.0], R=[1.0], P0=[1.0])
    filter_ = make_filter("kf", unstable)
    z = [np.zeros((rows, 1)) for rows in (400, 5)]
    data = Data((0, 1), np.zeros((2, 399, 1)), padded(z, 400), np.zeros((2, 2)), 0, counted=mask_of((400, 5), 400))
    assert run(filter_, data.filter_keys, data.inputs, data.measurements).divergences[1] > 0
    assert evaluate(filter_, data, None).divergences == 0


def test_a_list_of_runs_is_a_problem_in_which_each_run_counts_in_full():
    runs = runs_of((30, 47, 33, 52, 26, 61, 38, 44, 59))
    runs[1][2][5:9] = np.nan  # truth unknown
    problem = checked_problem(RunsProblem(runs, MODEL, first_scored_step=3, held_out=[2, 5], name="mine"))
    assert (problem.training_seeds(0, 32), problem.held_out_seeds(0, 0)) == (range(7), range(7, 9))
    lengths = [problem.data([seed]).scored_counts[0] for seed in range(9)]
    assert sorted(lengths) == sorted([27, 40, 30, 49, 23, 58, 35, 41, 56])
    held = problem.data(problem.held_out_seeds(0, 0))
    np.testing.assert_array_equal(held.one(0).inputs[0], runs[2][0])
    np.testing.assert_array_equal(held.one(1).states[0], runs[5][2])
    named = [dict(zip(("inputs", "measurements", "states"), one, strict=True)) for one in runs]
    same = RunsProblem(named, MODEL, first_scored_step=3, held_out=[2, 5])
    assert same.digest == problem.digest and problem.counts_start_up
    training = [problem.data([seed]) for seed in problem.parts.training]
    scored = np.concatenate([one.states[0][one.scored[0]] for one in training])
    np.testing.assert_allclose(problem.scale, scored.std(axis=0), rtol=1e-12)
    assert RunsProblem([one[:2] for one in runs], MODEL).scale is None


def test_logs_with_a_truth_are_not_cut_to_the_shortest():
    logs = [log_of(one, MODEL, 0.1, f"log {place}") for place, one in enumerate(runs_of((90, 140, 75, 101)))]
    problem = LogProblem(logs, MODEL, lead=10, blocks=1, held_out=["log 0", "log 1"])
    assert sorted(problem.data(range(4)).scored_counts) == [65, 80, 91, 130]
    gap = runs_of((90, 140, 75, 101, 300))
    gap[4][2][:280] = np.nan
    logs = [log_of(one, MODEL, 0.1, f"log {place}") for place, one in enumerate(gap)]
    problem = checked_problem(LogProblem(logs, MODEL, lead=10))
    assert all(problem.data([seed]).scored_counts[0] > 0 for seed in range(len(problem.parts.blocks)))


def test_other_results_know_of_the_mask():
    problem = RunsProblem(runs_of((30, 47, 33, 52, 26, 61)), MODEL, first_scored_step=3)
    plan = Plan("enkf", (problem,), objectives=("likelihood",))
    choice, data = untuned_choice("enkf", problem), plan.training_data()
    assert close_size(choice, plan, data) in (5, 8, 10, 12, 15, 20, 30, 50, 75, 100, 150, 200)
    kf = untuned_choice("kf", problem)
    ends = problem.data(problem.parts.training)
    space = Plan("kf", (problem,)).space()
    tidy, junk = (identify(kf, (problem,), [one], space) for one in (ends, ends._replace(inputs=_late_junk(ends))))
    np.testing.assert_array_equal(tidy.cov, junk.cov)


def _late_junk(data):
    past = np.arange(data.steps) + 1 >= data.rows[:, None]
    return np.where(past[..., None], 1e9, data.inputs)


BAD = {
    "a list": (lambda: RunsProblem("runs.csv", MODEL), "runs must be a list of runs, .* but got 'runs.csv'"),
    "parts": (lambda: RunsProblem([(1, 2, 3, 4)], MODEL), r"run 0 must be \(inputs, measurements\) or"),
    "keys": (lambda: RunsProblem([{"z": [1.0]}], MODEL), "run 0 must have measurements, .* but got 'z'"),
    "columns": (
        lambda: RunsProblem([(np.ones((4, 1)), np.ones((5, 3)))], MODEL),
        "measurements of run 0 must have 2",
    ),
    "rows": (
        lambda: RunsProblem([(np.ones((5, 1)), np.ones((5, 2)))], MODEL),
        r"inputs of run 0 .* \(4, 1\), but got",
    ),
    "model": (
        lambda: RunsProblem([(np.ones((4, 1)), np.ones((5, 2)))], 3),
        "model must be a StateSpaceModel, .* got 3",
    ),
}


@pytest.mark.parametrize(("make", "line"), BAD.values(), ids=list(BAD))
def test_what_is_no_run_is_one_clear_line(make, line):
    refused(line, make)


def test_a_mask_of_another_shape_and_a_run_without_a_scored_step_are_refused():
    data = data_of(runs_of())
    with pytest.raises(ValueError, match=r"counted of problem x must be bool and of shape \(5, 75\)"):
        check_data(data._replace(counted=np.ones((5, 3), dtype=bool)), MODEL, "x")
    with pytest.raises(ValueError, match="each run of problem x must have a step that is scored, from 30 on"):
        check_data(data._replace(first_scored=30), MODEL, "x")


@pytest.mark.parametrize(("scored", "lags"), [(40, 20), (21, 20), (11, 10), (2, 1), (1, 1)])
def test_a_consistency_report_has_as_many_lags_as_its_steps_allow(scored, lags):
    problem = LinearProblem(steps=60, first_scored=61 - scored)
    found = check_consistency(make_filter("kf", problem.model()), problem.data(range(6)))
    assert len(found.whiteness.correlations) == lags and np.isnan(found.whiteness.p_value) == (scored == 1)


def chain(n):
    """A stable chain of n states, the first of which is measured."""
    a = 0.9 * np.eye(n) + 0.05 * np.eye(n, k=1)
    noise = {"Q": 0.1 * np.eye(n), "R": [0.2], "x0": np.zeros(n), "P0": np.eye(n)}
    return affine_model(A=a, B=np.ones((n, 1)), C=np.eye(n)[:1], **noise)


@pytest.mark.parametrize("same", [True, False])
def test_the_bound_of_a_large_model_is_over_the_scored_steps_of_the_sequences_taken(monkeypatch, same):
    lengths, model, rng = (20, 12, 31, 17), chain(13), np.random.default_rng(0)
    monkeypatch.setattr(bounds, "MOST_WORK", 2 * 2 * 30 * 13**3)
    inputs = np.zeros((4, 30, 1)) if same else rng.normal(size=(4, 30, 1))
    counted = mask_of(lengths, 31)
    data = Data((0, 1, 2, 3), inputs, np.zeros((4, 31, 1)), np.zeros((4, 2)), 5, counted=counted)
    found = average_bound(model, data, truths=2)
    each = posterior_variances(model, data.seen.inputs, truths=2)  # a linear model's do not follow from inputs
    assert len(each) == (1 if same else 2)
    taken = range(4) if same else (0, 2)
    rows = np.concatenate([each[0, 5 : lengths[place]] for place in taken])
    np.testing.assert_allclose(found, np.sqrt(rows.mean(axis=0)), rtol=1e-9)


OF_MANY = (30, 41, 33, 52, 26, 45, 38, 44, 59, 31, 36, 48, 29, 40, 35, 27, 43, 34, 39)  # ten for training


class Named(LinearProblem):
    """A linear problem of another name and length."""

    def __init__(self, name, **arguments):
        """Take the name, and what a linear problem takes."""
        super().__init__(**arguments)
        self.name = name


@pytest.fixture(scope="module")
def problems():
    return RunsProblem(runs_of(OF_MANY), MODEL, first_scored_step=3, name="runs"), Named("model", steps=50)


@pytest.fixture
def trial():
    """A trial that is never pruned, but notes what is reported."""
    study = optuna.create_study(pruner=optuna.pruners.NopPruner())
    return study.ask()


def test_a_trial_uses_every_run_of_each_problem(problems, trial):
    for some in (problems, problems[::-1]):
        trial = trial.study.ask()
        plan = Plan("ekf", some)
        data = plan.training_data()
        choice = untuned_choice("ekf", problems[1])
        found = measure(choice, plan, data)
        pruned = measure(choice, plan, data, trial)
        for one, other, problem, runs in zip(found, pruned, some, data, strict=True):
            expected = evaluate(choice.filter(problem), runs, problem.scale)
            assert len(one.mean_squares) == len(other.mean_squares) == len(runs.seeds)
            assert one.score.value == pytest.approx(expected.score.value, rel=1e-12)
            assert other.nis.value == pytest.approx(expected.nis.value, rel=1e-12)


def test_what_is_reported_to_the_pruner_is_an_equal_share_of_each_problem(problems, trial):
    plan = Plan("ekf", problems)
    few, many = data = plan.training_data()
    assert BLOCK < len(few.seeds) < len(many.seeds)
    choice = untuned_choice("ekf", problems[1])
    measure(choice, plan, data, trial)
    reported = trial.study.get_trials()[0].intermediate_values
    assert list(reported) == list(range(len(few.seeds)))
    scores = []
    for problem, runs in zip(problems, data, strict=True):
        squares = evaluate(choice.filter(problem), runs, problem.scale).mean_squares
        each = (np.sqrt(squares) / problem.scale).mean(axis=1)
        ends = shares(len(runs.seeds), len(few.seeds))
        scores.append([each[i:j].mean() for i, j in zip(ends, ends[1:], strict=False)])
    np.testing.assert_allclose(list(reported.values()), np.mean(scores, axis=0), rtol=1e-10)
    assert sum(np.diff(ends)) == len(many.seeds) and np.ptp(np.diff(ends)) <= 1


def test_sizes_of_an_ensemble_are_compared_on_all_runs_of_each_problem(problems):
    plan = Plan("enkf", problems)
    choice, training = untuned_choice("enkf", problems[1]), plan.training_data()
    fresh = plan.size_data()
    assert len(fresh[0].seeds) != len(fresh[1].seeds)
    rows = ensemble_sizes(choice.with_size(5), plan, training)
    assert len(rows[0].evaluation.mean_squares) == len(fresh[0].seeds)
    short = RunsProblem(runs_of((30,) * 6), MODEL, first_scored_step=3, name="short")
    plan = Plan("enkf", (short, problems[1]))
    found = few_seeds_first(choice.with_size(5), plan, plan.training_data(), [5, 30], False)
    assert found[1].ratio.high - found[1].ratio.low < 1.0
    assert found[1].seeds == len(plan.size_data()[0].seeds)


def test_problems_of_other_states_share_parameters_of_their_own():
    def maker(n):
        return lambda q=0.02: LinearProblem(n=n).model(process_noise_cov=np.full(n, q))

    both = [
        RunsProblem(
            [
                (one.inputs[0], one.measurements[0], one.states[0])
                for one in (LinearProblem(n=n, steps=30 + 5 * i).data([i]) for i in range(6))
            ],
            maker(n),
            parameters=[Parameter("q", 1e-3, 1.0)],
            first_scored_step=3,
        )
        for n in (2, 3)
    ]
    found = tuning.tune(both, "kf", trials=3, progress=False)
    assert [len(one.evaluation.rmse) for one in found.evaluations] == [2, 3]
    assert [one.name for one in found.problems] == ["some runs", "some runs (2)"]
    with pytest.raises(ValueError, match="have the same numbers of states and measurements, or .*, but linear-2"):
        Plan("kf", (LinearProblem(n=2), LinearProblem(n=3))).checked()
    with pytest.raises(ValueError, match="must have different names, but got linear-3, linear-3"):
        Plan("kf", (LinearProblem(), LinearProblem())).checked()
    with pytest.raises(ValueError, match="'gradient' .* must minimise the mean over problems, but got worst"):
        tuning.tune(both, "kf", method="gradient", worst=True, progress=False)


class Broken(LinearProblem):
    """A problem as a user may write it: the truth of some seeds has a gap that nobody was told of."""

    name = "mine"

    def __init__(self, first=0, **arguments):
        """`first` is the seed from which the truth has gaps."""
        super().__init__(**arguments)
        self.first, self.drawn = first, []

    def data(self, seeds):
        """The data, with NaN in the truth of some seeds."""
        self.drawn.append(tuple(seeds))
        found = super().data(seeds)
        gap = (np.array(seeds) >= self.first)[:, None, None] & (np.arange(self.steps + 1) == 40)[None, :, None]
        return found._replace(states=np.where(gap, np.nan, found.states))


@pytest.mark.parametrize(
    "use",
    [
        lambda problem: tuning.tune(problem, "kf", trials=2, progress=False),
        lambda problem: tuning.evaluate("kf", problem=problem, seeds=4, progress=False),
        lambda problem: tuning.compare(["kf", "ekf"], problem, seeds=4, progress=False),
        lambda problem: Plan("kf", (problem,)).checked(),
    ],
    ids=["tune", "evaluate", "compare", "plan"],
)
def test_a_problem_s_object_is_checked_as_one_that_is_found_by_its_name(use):
    refused("states of problem linear-3 must be finite, but those of seed 0 are not", use, Broken())


def test_what_is_off_in_later_seeds_is_refused_there_and_an_object_is_checked_once():
    for use in (
        lambda: tuning.evaluate("kf", problem=Broken(2), seeds=4, progress=False),
        lambda: tuning.compare(["kf"], Broken(2), seeds=4, progress=False),
        lambda: tuning.tune(Broken(500_000), "kf", trials=1, progress=False),
    ):
        refused("states of problem linear-3 must be finite, but those of seed", use)
    problem = Broken(first=10**9)
    for _ in range(2):
        Plan("kf", (problem,)).checked()
    assert problem.drawn.count((0, 1)) == 1
