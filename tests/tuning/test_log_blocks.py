"""Blocks of logs: cut at gaps, shorter for short logs, begun where a measurement says; what is held out of all."""

import json
import shutil

import numpy as np
import pytest

import tuning
from filters import StateSpaceModel, make_filter, run
from filters.starts import WIDE, cov_of_measured_starts, wide_cov
from tests.filters.checks import refused
from tests.tuning.cli.test_cli_logs import OWN
from tests.tuning.test_log_problem import GUESS, MODEL, logs_of
from thruster_env.logs.findings import Recording
from thruster_env.logs.log import Log
from thruster_env.logs.read import read_log
from thruster_env.logs.write import write_columns
from thruster_env.model.affine import affine_model
from tuning.evaluation.evaluate import evaluate
from tuning.logs.problem import cut_at_gaps, log_problem, split_runs
from tuning.problems.log_parts import parts_of
from tuning.problems.log_problem import MEASURED, LogProblem
from tuning.problems.model_problem import RunsProblem, log_of
from tuning.search.space import untuned_choice


def table_of(log, rows=slice(None)):
    inputs = np.append(log.inputs[:, 0], np.nan)
    return {"t": log.times[rows], "u_1": inputs[rows], "z_1": log.measurements[rows, 0]}


def with_gap(pause, steps=600, at=240):
    """A log whose recorder paused for some rows."""
    table = table_of(*logs_of(steps))
    keep = np.r_[0:at, at + pause : steps + 1]
    return {name: values[keep] for name, values in table.items()}


@pytest.mark.parametrize("hold", [False, True])
def test_blocks_without_measurements_are_in_no_score_and_their_number_is_said(hold):
    (log,) = logs_of(3000)
    quiet = log.measurements.copy()
    quiet[400:2600] = np.nan  # the sensor is lost, the recorder goes on
    quiet[2500] = 1.0
    lost = Log("run", log.dt, log.inputs, quiet, log.input_quantities, log.measured)
    problem = LogProblem(lost, GUESS, hold_gaps=hold)
    data = problem.data(range(len(problem.parts.blocks)))
    scored = (~np.isnan(data.measurements[:, data.first_scored :, 0])).sum(axis=1)
    assert scored.min() >= np.median(scored) / 4 and len(problem.parts.blocks) + problem.parts.empty == 73
    assert problem.parts.empty >= 50
    assert f"{problem.parts.empty} of 73 blocks are left out and in no score" in " ".join(problem.remarks)
    held = problem.data(problem.parts.held_out)
    evaluation = evaluate(untuned_choice("kf", problem).filter(problem), held, None)
    assert (evaluation.log_likelihoods != 0.0).all()


def test_a_run_is_cut_at_a_gap_unless_its_input_is_to_be_held():
    table = with_gap(pause=1200, steps=3000)
    cut, held = (log_problem(table, model=MODEL, hold_gaps=hold) for hold in (False, True))
    (log,) = cut.logs
    assert log.recording.gaps == ((240, 1200),) and log.pieces == ((0, 240), (1440, 1561))
    for block in cut.parts.blocks:
        assert block.first + block.rows <= 240 or block.first >= 1440
    assert cut.parts.empty == 0 and held.parts.empty > 5 and cut.digest != held.digest
    assert any("Runs are cut at gaps" in said for said in cut.remarks)
    assert any("a gap: 1200 rows (120 s) are missing" in said for said in cut.remarks)
    assert any("the last input is held" in said for said in held.remarks)


def test_an_identification_has_the_pieces_of_a_run_as_runs():
    options = {"model": MODEL, "use_all": True}
    (first, second), _ = split_runs(with_gap(100), **options)
    (log,), _ = split_runs(with_gap(100), **options, hold_gaps=True)
    assert (first.steps, second.steps, log.steps) == (239, 260, 600)
    assert second.name == "run1, rows 340 to 600" and second.start == pytest.approx(34.0)
    np.testing.assert_array_equal(second.measurements, log.measurements[340:])
    np.testing.assert_array_equal(second.inputs, log.inputs[340:])
    assert cut_at_gaps(second) == [second]
    few, _ = split_runs(with_gap(100, steps=345), **options)  # five rows after the gap tell nothing
    assert [one.steps for one in few] == [239]


def test_the_last_quarter_of_a_recording_is_held_out_unless_it_is_short():
    (first, second), (late,) = split_runs(with_gap(100), model=MODEL)
    assert (first.steps, second.steps + 1, late.steps + 1) == (239, 111, 150)  # of 601 rows
    (early,), (late,) = split_runs(with_gap(100), model=MODEL, hold_gaps=True)
    assert early.steps + 1 == 451 and late.name == "run1, rows 451 to 600"
    assert split_runs({name: values[:150] for name, values in with_gap(100).items()}, model=MODEL)[1] == []


def test_pieces_keep_the_samples_of_their_own_times():
    table = with_gap(100)
    table["z_1"][1::2] = np.nan
    log = read_log(table, MODEL)
    first, second = cut_at_gaps(log)
    series = second.series("measurement:z_1")
    assert series.times[0] == pytest.approx(0.0) and len(first.series("measurement:z_1").times) == 120
    np.testing.assert_array_equal(series.values, second.measurements[~np.isnan(second.measurements[:, 0]), 0])


def test_what_is_held_out_is_never_learnt_from_however_it_is_named(tmp_path):
    a, b, c = (table_of(log) for log in logs_of(200, 200, 200))
    copy = {name: values.copy() for name, values in c.items()}
    for held in (c, copy):
        problem = log_problem([a, b, c], held_out=held, model=MODEL)
        assert len(problem.logs) == 3
        learnt = {problem.parts.blocks[i].run for i in problem.parts.training}
        digests = [read_log(one, MODEL).digest for one in (a, b)]
        assert sorted(problem.logs[run].digest for run in learnt) == sorted(digests)
        learning, proving = split_runs([a, b, c], held, model=MODEL)
        assert sorted(log.digest for log in learning) == sorted(digests) and len(proving) == 1
    for name, table in zip("abc", (a, b, c), strict=True):
        write_columns(tmp_path / f"{name}.csv", table, "exact")
    files = [str(tmp_path / f"{name}.csv") for name in "abc"]
    shutil.copy(files[2], tmp_path / "d.csv")
    (tmp_path / "sub").mkdir()
    for other in (tmp_path / "sub" / ".." / "c.csv", tmp_path / "d.csv"):
        problem = log_problem(files, held_out=str(other), model=MODEL)
        names = {problem.logs[problem.parts.blocks[i].run].name for i in problem.parts.training}
        assert names == set(files[:2]) and len(problem.logs) == 3
    refused("at least one log must be left to learn from", log_problem, [c], held_out=copy, model=MODEL)


def test_a_part_of_a_training_run_cannot_be_held_out():
    (log,) = logs_of(600)
    whole, part, other = table_of(log), table_of(log, slice(100, 400)), table_of(logs_of(10, 300)[1])
    part["t"] = part["t"] + 7.0  # another clock does not hide it
    said = "held-out runs must have no rows in common with the others, but run2 has some of run1"
    refused(said, log_problem, [whole], held_out=part, model=MODEL)
    refused(said, split_runs, [whole], part, model=MODEL)
    assert len(log_problem([whole], held_out=other, model=MODEL).logs) == 2
    still = {name: values * (name == "t") for name, values in other.items()}
    still["z_1"][0] = 1.0  # two runs that begin at rest have nothing in common
    again = {name: values.copy() for name, values in still.items()}
    again["z_1"][1] = 2.0
    log_problem([still], held_out=again, model=MODEL)


@pytest.mark.parametrize("rows, lead", [((24,), 2), ((50,), 12), ((21, 20, 22), 6), ((20,) * 9, 12), ((199,), 25)])
def test_short_logs_have_shorter_lead_ins_and_blocks_and_it_is_said(rows, lead):
    problem = LogProblem(logs_of(*(count - 1 for count in rows)), GUESS)
    assert problem.parts.lead == problem.first_scored_step == lead
    assert len(problem.parts.training) >= 2 and len(problem.parts.held_out) >= 2
    assert f"The logs are short: a lead-in has {lead} rows" in problem.remarks[-1]
    assert LogProblem(logs_of(200), GUESS).remarks == () and LogProblem(logs_of(200), GUESS).parts.lead == 50


def test_a_lead_in_that_is_given_stays_and_logs_that_were_not_read_have_no_recording():
    problem = LogProblem(logs_of(23, 24, 20), GUESS, lead=0)
    assert problem.parts.lead == 0 and [block.rows for block in problem.parts.blocks] == [6] * 11  # of 70 rows
    assert logs_of(100)[0].recording == Recording() and logs_of(100)[0].pieces == ((0, 101),)


@pytest.mark.parametrize(("steps", "count"), [((1500, 1500, 1500), 72), ((900, 130, 400), 51), ((4000,), 73)])
def test_blocks_of_all_logs_have_one_length_and_few_rows_are_left_out(steps, count):
    parts = parts_of(logs_of(*steps), sizes=True)
    assert not parts_of(logs_of(*steps)).sizes
    lengths = {block.rows for block in parts.blocks}
    assert len(lengths) == 1 and len(parts.blocks) == count
    assert sum(steps) - 50 * len(steps) - count * (lengths.pop() - 50) <= 0.1 * sum(steps)
    assert len(parts.sizes) * 3 <= len(parts.training) + len(parts.sizes) < (len(parts.sizes) + 1) * 3
    assert {parts.blocks[i].run for i in parts.sizes} == {parts.blocks[i].run for i in parts.training}


CART = affine_model(
    a=[[1.0, 0.1], [0.0, 0.9]], b=[[0.0], [0.1]], c=[[1.0, 0.0]], process_noise_cov=[1e-4, 1e-3],
    measurement_noise_cov=[0.04], prior_mean=[0.0, 0.5], prior_cov=[[0.01, 0.004], [0.004, 0.09]],
)  # fmt: skip


def runs_far_off(count=9, rows=30):
    """Runs of the cart that begin at positions up to 40 m from the prior mean."""
    rng, made = np.random.default_rng(1), []
    for _ in range(count):
        x, u, states = np.array([rng.uniform(-40, 40), rng.normal(0.5, 0.3)]), rng.normal(size=(rows - 1, 1)), []
        for k in range(rows):
            states.append(x)
            noise = rng.normal(size=2) * [1e-2, 3e-2]
            x = np.array([x[0] + 0.1 * x[1], 0.9 * x[1] + (0.1 * u[k, 0] if k < rows - 1 else 0.0)]) + noise
        states = np.array(states)
        made.append((u, states[:, :1] + 0.2 * rng.normal(size=(rows, 1)), states))
    return made


def test_the_covariance_is_wide_where_a_measurement_sees_and_the_prior_s_elsewhere():
    first = np.array([[30.0], [-12.0], [np.nan]])
    found = cov_of_measured_starts(CART, first)
    np.testing.assert_allclose(found, np.diag([WIDE**2 * 0.01 + 30.0**2, 0.09]), rtol=1e-12)
    assert found[0, 0] == pytest.approx(wide_cov(CART, np.array([30.0, 0.0]))[0, 0])
    sums = CART.replace(prior_cov=[0.04, 0.04], process_noise_cov=[0.0, 0.0])
    both = affine_model(
        a=[[1.0, 0.0], [0.0, 1.0]], b=[[0.0], [0.0]], c=[[1.0, 1.0]], process_noise_cov=[0.0, 0.0],
        measurement_noise_cov=[0.04], prior_mean=[0.0, 0.0], prior_cov=sums.prior_cov,
    )  # fmt: skip
    cov = cov_of_measured_starts(both, np.array([[10.0]]))  # 5 each are the nearest states with that sum
    along, across = np.array([1.0, 1.0]) / 2**0.5, np.array([1.0, -1.0]) / 2**0.5
    assert along @ cov @ along == pytest.approx(WIDE**2 * 0.04 + 25.0)
    assert across @ cov @ across == pytest.approx(0.04)


def test_each_run_begins_where_a_kalman_update_with_the_wide_prior_has_it():
    problem = RunsProblem(runs_far_off(), CART, start="measurement")
    data = problem.data(range(9))
    found = run(make_filter("kf", problem.model()), data.filter_keys, data.inputs, data.measurements)
    wide = problem.model().prior_cov[0, 0]
    z = data.measurements[:, 0, 0]
    np.testing.assert_allclose(found.means[:, 0, 0], wide / (wide + 0.04) * z, rtol=1e-9)
    np.testing.assert_allclose(found.means[:, 0, 1], 0.5, rtol=1e-12)
    cov = np.diag([1 / (1 / wide + 25.0), 0.09])
    np.testing.assert_allclose(found.covs[:, 0], cov[None].repeat(9, 0), rtol=1e-9)


def test_short_runs_far_from_the_prior_are_estimated_from_the_first_row_on():
    errors = {}
    for start in ("prior", "measurement"):
        problem = RunsProblem(runs_far_off(), CART, start=start, scale=(1.0, 1.0))
        filter_ = untuned_choice("kf", problem)._replace(model=problem.given).filter(problem)
        errors[start] = evaluate(filter_, problem.data(problem.held_out_seeds(0, 0)), problem.scale).rmse[0].value
    assert errors["measurement"] < 0.2 < 20 * errors["measurement"] < errors["prior"]


def test_the_start_is_part_of_the_digest_said_and_refused_where_nothing_is_seen():
    one, other = (RunsProblem(runs_far_off(), CART, start=start) for start in ("prior", "measurement"))
    assert one.digest == RunsProblem(runs_far_off(), CART).digest != other.digest
    assert MEASURED in other.remarks and MEASURED not in one.remarks
    with pytest.raises(ValueError, match="start must be one of prior, measurement, but got 'there'"):
        RunsProblem(runs_far_off(), CART, start="there")
    blind = StateSpaceModel(
        transition=lambda x, u, c: (x[0] + u[0],), observe=lambda x, c: (x[0] * x[0],), process_noise_cov=[0.1],
        measurement_noise_cov=[0.1], prior_mean=[0.0], prior_cov=[1.0], inputs=1,
        observe_jacobian=lambda x, c: ((2.0 * x[0],),),
    )  # fmt: skip
    with pytest.raises(ValueError, match=r"depends on a state at the prior mean, but dh/dx there is \[\[0.0\]\]"):
        RunsProblem([one[:2] for one in runs_far_off()], blind, start="measurement")


def test_tune_offers_the_start_on_the_command_line_and_in_python(tmp_path, monkeypatch, thruster):
    (tmp_path / "own.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    for place, (u, z, _) in enumerate(runs_far_off(3, 60)):
        table = {"time_s": 0.1 * np.arange(60), "u": np.append(u[:, 0], 0.0), "z": z[:, 0]}
        write_columns(tmp_path / f"run{place}.csv", table, "exact")
    logs = [part for place in range(3) for part in ("--log", f"run{place}.csv")]
    options = ("--model", "own:model", "--trials", 3, "--no-consistency")
    done = thruster("tune", "--filter", "kf", *logs, *options, "--start", "measurement", "--out", "tuned.json")
    assert done.returncode == 0, done.stderr
    assert "begins where its first measurement says" in " ".join(done.stdout.split())
    (content,) = json.loads((tmp_path / "tuned.json").read_text())["problems"].values()
    assert content["content"]["options"]["start"] == "measurement"
    assert thruster("verify", "tuned.json", "--model", "own:model").returncode == 0
    assert thruster("tune", *logs, *options, "--start", "nowhere").returncode == 2
    files = [str(tmp_path / f"run{place}.csv") for place in range(3)]
    assert log_problem(files, model="own:model", start="measurement").digest == content["digest"]
    refused("start must be one of", tuning.read_logs, "run.csv", start="nowhere")


def test_the_robust_filter_begins_blocks_of_logs_where_their_first_measurement_does():
    rng, logs = np.random.default_rng(2), []
    for number in range(3):  # the cart goes further and further away from the prior
        x, z = np.array([0.0, 0.5]), []
        for _ in range(600):
            z.append([x[0] + 0.2 * rng.normal()])
            x = np.array([x[0] + 0.1 * x[1], 0.9 * x[1] + 0.1]) + rng.normal(size=2) * [1e-2, 3e-2]
        logs.append(log_of((np.ones((599, 1)), np.array(z)), CART, 0.1, f"log {number}"))
    problem, measured = LogProblem(logs, CART, lead=20), LogProblem(logs, CART, lead=20, start="measurement")
    by_prior = LogProblem(logs, CART, lead=20, start="prior")
    choice = untuned_choice("ekf-robust", problem)
    covs = [choice.filter(each).model.prior_cov for each in (problem, measured, by_prior)]
    assert (covs[0] == covs[1]).all() and (covs[2] == CART.prior_cov).all() and covs[0][0, 0] > 100.0
    assert (untuned_choice("ekf", problem).filter(problem).model.prior_cov == CART.prior_cov).all()
    assert problem.digest == by_prior.digest != measured.digest
    data = problem.data(problem.training_seeds(0, 32))
    values = [evaluate(choice.filter(each), data, None) for each in (problem, by_prior)]
    assert values[0].nis.value < 1.5 and values[1].nis.value > 10.0
    assert values[0].log_likelihood > values[1].log_likelihood + 10.0
