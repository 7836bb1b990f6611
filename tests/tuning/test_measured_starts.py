"""Recorded runs that begin where their first measurement says, and not where the prior has all of them."""

import json

import numpy as np
import pytest

import tuning
from filters import StateSpaceModel, make_filter, run
from filters.starts import WIDE, cov_of_measured_starts, wide_cov
from tests.tuning.cli.test_cli_log_findings import OWN
from thruster_env.logs.write import write_columns
from thruster_env.model.affine import affine_model
from tuning.evaluation.evaluate import evaluate
from tuning.logs.problem import log_problem
from tuning.problems.log_problem import MEASURED, LogProblem
from tuning.problems.model_problem import RunsProblem, log_of
from tuning.search.space import untuned_choice

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
    assert along @ cov @ along == pytest.approx(WIDE**2 * 0.04 + 25.0) and across @ cov @ across == pytest.approx(
        0.04
    )


def test_each_run_begins_where_a_kalman_update_with_the_wide_prior_has_it():
    problem = RunsProblem(runs_far_off(), CART, start="measurement")
    data = problem.data(range(9))
    found = run(make_filter("kf", problem.model()), data.filter_keys, data.inputs, data.measurements)
    wide = problem.model().prior_cov[0, 0]
    z = data.measurements[:, 0, 0]
    np.testing.assert_allclose(found.means[:, 0, 0], wide / (wide + 0.04) * z, rtol=1e-9)
    np.testing.assert_allclose(found.means[:, 0, 1], 0.5, rtol=1e-12)
    np.testing.assert_allclose(
        found.covs[:, 0], np.diag([1 / (1 / wide + 25.0), 0.09])[None].repeat(9, 0), rtol=1e-9
    )


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
    with pytest.raises(ValueError, match="start must be one of"):
        tuning.read_logs("run.csv", start="nowhere")


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
