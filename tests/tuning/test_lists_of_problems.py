"""A list of problems: all runs of each, and the mean of their scores, of any numbers of runs, steps and states."""

import numpy as np
import optuna
import pytest

import tuning
from tests.linear_problem import LinearProblem
from tests.tuning.test_unequal_runs import MODEL, runs_of
from tuning.evaluation.evaluate import evaluate
from tuning.evaluation.sizes import ensemble_sizes, few_seeds_first
from tuning.problems.model_problem import RunsProblem
from tuning.problems.problem import Parameter
from tuning.search.plan import Plan
from tuning.search.space import untuned_choice
from tuning.search.trials import BLOCK, measure, shares

LENGTHS = (30, 41, 33, 52, 26, 45, 38, 44, 59, 31, 36, 48, 29, 40, 35, 27, 43, 34, 39)  # ten for training


class Named(LinearProblem):
    """A linear problem of another name and length."""

    def __init__(self, name, **arguments):
        """Take the name, and what a linear problem takes."""
        super().__init__(**arguments)
        self.name = name


@pytest.fixture(scope="module")
def problems():
    return RunsProblem(runs_of(LENGTHS), MODEL, first_scored_step=3, name="runs"), Named("model", steps=50)


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
    with pytest.raises(
        ValueError, match="have the same numbers of states and measurements, or .*, but linear-2 and"
    ):
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
    with pytest.raises(ValueError, match="states of problem linear-3 must be finite, but those of seed 0 are not"):
        use(Broken())


def test_what_is_off_in_later_seeds_is_refused_where_these_are_drawn():
    for use in (
        lambda: tuning.evaluate("kf", problem=Broken(2), seeds=4, progress=False),
        lambda: tuning.compare(["kf"], Broken(2), seeds=4, progress=False),
        lambda: tuning.tune(Broken(500_000), "kf", trials=1, progress=False),
    ):
        with pytest.raises(ValueError, match="states of problem linear-3 must be finite, but those of seed"):
            use()


def test_an_object_is_checked_once():
    problem = Broken(first=10**9)
    for _ in range(2):
        Plan("kf", (problem,)).checked()
    assert problem.drawn.count((0, 1)) == 1
