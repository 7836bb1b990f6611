"""Recorded runs as a problem: blocks, what is held out, what counts, truth where logs have it, one sample time."""

import json
import pickle
from typing import NamedTuple

import numpy as np
import pytest

import filters
import tuning
from filters import run
from filters.sensitivity import likelihood
from tests.filters.checks import refused
from tests.models import state_space
from thruster_env.env.model_env import ReplayEnv
from thruster_env.logs.log import Log
from thruster_env.model.affine import affine_model
from thruster_env.model.simulate import simulate
from tuning.api.held_out import HeldOut
from tuning.evaluation.baselines import rule_label
from tuning.evaluation.evaluate import evaluate, score_ratio
from tuning.evaluation.held_out import evaluate_held_out
from tuning.evaluation.worth import scaling_sentence, tuning_effect
from tuning.experiments.benchmark import run_in_memory
from tuning.likelihood.gradient import tune_by_gradient
from tuning.likelihood.identifiability import identify
from tuning.problems.check import checked_problem
from tuning.problems.find import find_problem
from tuning.problems.log_parts import LEAD, parts_of
from tuning.problems.log_problem import LogProblem
from tuning.search.among_types import close_size
from tuning.search.parameters import size_ladder
from tuning.search.plan import Plan
from tuning.search.space import untuned_choice
from tuning.search.study import open_study, run_study
from tuning.search.workers import orders_of, plan_of

Q, R = 0.04, 0.25
MODEL = affine_model(A=[[0.9]], B=[[0.5]], C=[[1.0]], Q=[Q], R=[R], P0=[0.0])
GUESS = MODEL.replace(process_noise_cov=[1.0])


def logs_of(*steps, truth=False, offset=0.0):
    logs = []
    for number, count in enumerate(steps):
        inputs = offset + np.sign(np.sin(0.1 * np.arange(count)))[None, :, None]
        found = simulate(MODEL, np.array([[number, 5]]), inputs)
        states = {"state:x_1": found.states[0, :, 0]} if truth else {}
        referred = {"state:x_1": MODEL.states[0]} if truth else {}
        quantities = MODEL.input_quantities, MODEL.measurements
        logs.append(Log(f"run{number}", 0.1, inputs[0], found.measurements[0], *quantities, states, referred))
    return logs


def test_blocks_of_a_run_follow_one_another_and_each_has_a_lead_in():
    (log,) = logs_of(400)
    parts = parts_of([log], lead=20, blocks=6)
    scored = sorted((block.first + 20, block.first + block.rows) for block in parts.blocks)
    assert scored[0][0] == 20 and scored[-1][1] == 401
    assert all(before[1] == after[0] for before, after in zip(scored, scored[1:], strict=False))
    assert [len(some) for some in (parts.training, parts.sizes, parts.held_out)] == [4, 0, 2]
    problem = LogProblem(log, GUESS, lead=20, blocks=6)
    data = problem.data(range(6))
    for place, block in enumerate(problem.parts.blocks):
        rows = slice(block.first, block.first + block.rows)
        np.testing.assert_array_equal(data.measurements[place, : block.rows], log.measurements[rows])
        assert np.isnan(data.measurements[place, block.rows :]).all()
        np.testing.assert_array_equal(data.inputs[place, : block.rows - 1], log.inputs[rows][: block.rows - 1])


def test_every_third_run_is_held_out_or_those_that_are_named():
    logs = logs_of(200, 200, 300, 200)
    parts = parts_of(logs, blocks=2)
    assert {parts.blocks[i].run for i in parts.held_out} == {2}
    assert {parts.blocks[i].run for i in parts.training} == {0, 1, 3}
    named = LogProblem(logs, GUESS, blocks=2, held_out=["run0", "run3"])
    assert {named.parts.blocks[i].run for i in named.held_out_seeds(7, 200)} == {0, 3}
    assert named.training_seeds(7, 32) == named.parts.training == named.range_seeds
    seeds = {*named.parts.training, *named.parts.held_out}
    assert len(seeds) == len(named.parts.blocks)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: LogProblem(logs_of(60), GUESS, lead=60), "a log must have at least 63 rows.*but run0 has 61"),
        (lambda: LogProblem(logs_of(15), GUESS), "at least 2 blocks with measurements held out, but run0 give 1"),
        (lambda: LogProblem(logs_of(200), GUESS, held_out=["x"]), "held out must be among run0, but got 'x'"),
        (lambda: LogProblem([], GUESS), "logs must be some thruster_env.logs.log.Log"),
        (lambda: LogProblem(logs_of(200) * 2, GUESS), "must have different names, but got run0, run0"),
        (lambda: LogProblem(logs_of(200), GUESS, scale=[1.0]), "a scale must come with logs of all true states"),
        (
            lambda: LogProblem([logs_of(200)[0], Log("b", 0.2, *_rows())], GUESS),
            "must have the same sample time, but run0 has 0.1 s and b 0.2 s: put them on one grid with --dt 0.1",
        ),
    ],
)
def test_logs_that_cannot_be_a_problem_are_refused(make, said):
    refused(said, make)


def _rows():
    return np.zeros((200, 1)), np.arange(201.0)[:, None], MODEL.input_quantities, MODEL.measurements


def test_a_problem_of_logs_is_one_whose_digest_is_of_its_content():
    one, same = (checked_problem(LogProblem(logs_of(300), GUESS)) for _ in range(2))
    assert one.scale is None and one.true is None and one.digest == same.digest
    assert pickle.loads(pickle.dumps(one)).digest == one.digest
    orders = json.loads(json.dumps(orders_of(Plan("ekf", (one,)))))  # as workers get it
    assert plan_of(orders).scenarios[0].digest == one.digest
    others = LogProblem(logs_of(300, offset=0.1), GUESS), LogProblem(logs_of(300), GUESS, blocks=8)
    assert len({one.digest, *(other.digest for other in others)}) == 3


@pytest.mark.slow
def test_the_lead_in_counts_in_no_likelihood():
    problem = LogProblem(logs_of(600), MODEL, blocks=6)
    data = problem.data(problem.parts.training)
    choice = untuned_choice("kf", problem)
    evaluation = evaluate(choice.filter(problem), data, None)
    found = tune_by_gradient("kf", problem, data, [1.0])
    best = evaluate(found.choice.filter(problem), data, None)
    assert best.log_likelihoods.sum() == pytest.approx(found.best.value, rel=1e-9)
    assert best.log_likelihood >= evaluation.log_likelihood
    whole = likelihood(MODEL, data.inputs, data.measurements, np.zeros((1, 1, 1)), np.zeros((1, 1, 1)))
    assert whole.values.sum() < evaluate(_with(problem, MODEL), data, None).log_likelihoods.sum() - 10


def _with(problem, model):
    choice = untuned_choice("kf", problem)
    return choice._replace(model={"process_noise_cov": (Q,), "measurement_noise_cov": R}).filter(problem)


@pytest.mark.slow
def test_the_noise_of_a_simulation_is_found_again_without_its_truth():
    problem = LogProblem(logs_of(1500, 1500), GUESS)
    plan = Plan("kf", (problem,), objectives=("likelihood",))
    result = run_study(open_study("logs", plan), plan, 22)
    met = result.validation.met  # of which the scaled default is taken: no trial is significantly better
    found = min((one for one in met if one.name.startswith("trial")), key=lambda one: one.value).choice.model
    assert found["process_noise_cov"][0] == pytest.approx(Q, rel=0.3)
    assert found["measurement_noise_cov"] == pytest.approx(R, rel=0.15)
    comparison = evaluate_held_out(result.choice, problem, 0)
    assert comparison.seeds == problem.parts.held_out and not comparison.tuned.has_truth
    assert comparison.likelihood_gains["given"].low > 0
    known = identify(result.choice, (problem,), plan.training_data(), plan.space())
    assert known.identified.all() and (known.factors < 3).all()  # the errors of blocks of two runs are finite
    said = scaling_sentence(comparison)
    assert "The scaled default is the given Q and R with this Q times" in said
    assert "give the model state_low and state_high" in said  # for the model has no ranges
    assert "against the given filter" in tuning_effect(comparison)
    assert "rule of thumb" not in tuning_effect(comparison)
    numbers, errors, *_ = HeldOut(result.choice, problem, comparison).tables()
    assert [row[0] for row in errors.rows][:2] == ["given", "scaled default"] and "given" in numbers.columns


def test_what_has_ranges_has_a_rule_of_thumb():
    ranged = GUESS.replace(state_low=[0.0], state_high=[5.0])
    for problem in (LogProblem(logs_of(600), ranged), LogProblem(logs_of(600, truth=True), GUESS)):
        assert not problem.lacks_ranges and rule_label(problem) == "rule of thumb"
    problem = LogProblem(logs_of(600), GUESS)
    assert problem.lacks_ranges and problem.untuned["process_noise_cov"] == (GUESS.process_noise_cov[0, 0],)
    assert not LogProblem(logs_of(600), GUESS, untuned={"process_noise_cov": (1.0,)}).lacks_ranges


def test_true_states_in_the_logs_give_a_scale_and_runs_of_their_own_for_the_ensemble_size():
    logs = logs_of(600, 500, truth=True)
    problem = checked_problem(LogProblem(logs, MODEL, lead=LEAD, blocks=12))
    data = problem.data(problem.training_seeds(0, 32))
    assert problem.scale[0] == pytest.approx(data.states[data.scored].std(), rel=1e-12)
    assert problem.parts.sizes and not {*problem.parts.sizes} & {*problem.parts.training, *problem.parts.held_out}
    np.testing.assert_array_equal(np.isnan(data.measurements[..., 0]), ~data.counted)  # nothing but padding
    block = problem.parts.blocks[1]
    first = logs[block.run].references["state:x_1"][block.first]
    assert data.states[1, 0, 0] == first
    hidden = LogProblem(logs, MODEL, truth=False)
    assert hidden.scale is None and hidden.data([0]).states is None


def test_an_ensemble_without_a_truth_is_the_smallest_whose_estimates_are_close_to_the_largest_one_s():
    problem = LogProblem(logs_of(300), MODEL, blocks=8)
    plan, data = Plan("enkf", (problem,), objectives=("likelihood",)), problem.data(problem.parts.training)
    noise = {"process_noise_cov": (Q,), "measurement_noise_cov": R}
    choice = untuned_choice("enkf", problem)._replace(model=noise)

    def means_of(size):
        filter_ = choice.with_size(size).filter(problem)
        found = run(filter_, data.filter_keys, data.inputs, data.measurements)
        return found.means[:, data.late, 0], found.covs[:, data.late, 0, 0]

    size = close_size(choice, plan, [data])
    ladder = [n for n in size_ladder("enkf") if n < 200]
    largest, variances = means_of(200)
    excess = {n: ((means_of(n)[0] - largest) ** 2 / variances).mean() for n in ladder}
    assert size == min(n for n in ladder if excess[n] < 0.0201) and 20 < size < 200
    assert close_size(choice.with_size(10), plan._replace(budget=1.0), [data]) <= 10


def test_a_study_that_never_saw_the_truth_comes_close_to_one_that_did():
    problem = find_problem("nominal")
    model, data = problem.model(), problem.data(problem.training_seeds(0, 12))
    pairs = enumerate(zip(data.inputs, data.measurements, strict=True))
    logs = [Log(f"run{i}", problem.dt, u, z, model.input_quantities, model.measurements) for i, (u, z) in pairs]
    plans = Plan("ekf", (problem,)), Plan("ekf", (LogProblem(logs, model, blocks=1),), objectives=("likelihood",))
    seen, blind = (run_in_memory(plan, 22).choice for plan in plans)
    data = problem.data(problem.held_out_seeds(0, 24))
    by_seen, by_blind = (evaluate(choice.filter(problem), data, problem.scale) for choice in (seen, blind))
    assert score_ratio(by_blind, by_seen).value < 1.02 and seen != blind


DT = 0.05
LOG = {"t": DT * np.arange(400), "z": np.cumsum(np.random.default_rng(0).normal(size=400))}


class Constants(NamedTuple):
    dt: float


def move(x, u, c):
    return x[0] + c.dt * x[1], x[1]


def look(x, c):
    return (x[0],)


def model(dt=0.02):
    noise = {"q": [1e-3, 1.0], "r": [0.1], "mean": [0.0, 0.0], "cov": [1.0, 1.0]}
    return state_space(move, look, **noise, constants=Constants(dt), measurements=["z"], inputs=None)


def of_one_dt():
    return model()


def matrices(dt):
    return filters.affine_model(F=[[1.0]], H=[[1.0]], Q=[1.0], R=[0.1], P0=[1.0], measurements=["z"], dt=dt)


REFUSED = r"sample time of the model must be that of log .*, 0.05 s, but is 0.02 s: give a function of dt"


@pytest.mark.parametrize("source", [of_one_dt, model(), matrices(0.02)])
def test_a_model_of_another_sample_time_than_its_log_is_refused(source):
    refused(REFUSED, tuning.estimate, tuning.read_logs(LOG, model=source), filter="ekf")
    refused(REFUSED, tuning.identify, tuning.read_logs(LOG, model=source), free="R")
    refused(REFUSED, ReplayEnv, LOG, source)


@pytest.mark.parametrize("source", [model, model(DT * 1.001), matrices(DT), matrices(None)])
def test_a_model_of_the_sample_time_of_its_log_or_of_none_is_taken(source):
    assert ReplayEnv(LOG, source).log.dt == pytest.approx(DT)
