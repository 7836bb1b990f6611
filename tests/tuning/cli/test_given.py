"""What a model came with, at the command line: `evaluate --given`, and a preset that is tuned on logs."""

import pytest

from tests import altitude_problem
from thruster_env.logs.write import write_log
from tuning.evaluation.baselines import given_noise
from tuning.evaluation.held_out import evaluate_held_out
from tuning.experiments.identification import TRUTH, record

ALTITUDE = "tests.altitude_problem:problem"


def test_what_the_model_came_with_is_evaluated_and_is_no_rule_of_thumb(as_json, thruster):
    told = as_json("evaluate", "--given", "--problem", ALTITUDE, "--seeds", 12)
    problem = altitude_problem.problem()
    mine = given_noise("ekf", problem)
    assert told["filter"]["name"] == "ekf" and told["filter"]["model"] == altitude_problem.GIVEN == mine.model
    found = evaluate_held_out(mine, problem, 0, 12).tuned
    assert told["given"]["score"] == pytest.approx(list(found.score), rel=1e-9)
    assert told["noise"]["score"][0] < told["given"]["score"][0]
    done = thruster("evaluate", "--given", "--problem", ALTITUDE, "--filter", "ukf", "--seeds", 3)
    assert done.returncode == 0 and "Parameters of the ukf filter" in done.stdout and "given" in done.stdout


def test_the_covariance_of_what_was_given_is_checked(as_json, tmp_path):
    options = "evaluate", "--given", "--problem", ALTITUDE, "--seeds", 8, "--consistency"
    told = as_json(*options, "c.png")
    assert told["consistency"] and (tmp_path / "c.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("options", "said"),
    (
        (
            ("--scenario", "nominal"),
            "given (--given) must be used with a problem whose model has a given Q and R, but got nominal",
        ),
        (("tuned.json",), "given (--given) must come without a tuned file, but got both, with 'tuned.json'"),
        (
            ("--problem", ALTITUDE, "--filter", "low-pass"),
            "given (--given) must be used with a filter that has a Q and R, but got low-pass",
        ),
    ),
)
def test_where_nothing_was_given_one_line_says_so(thruster, options, said):
    done = thruster("evaluate", "--given", *options)
    assert done.returncode == 2 and said in " ".join(done.stderr.split())


@pytest.mark.slow
def test_a_preset_that_was_identified_is_not_made_worse_by_tuning(as_json, tmp_path):
    for place, log in enumerate(record(0, 3, 300)):
        write_log(tmp_path / f"run{place}.csv", log)
    logs = [f"run{place}.csv" for place in range(3)]
    of_logs = ("--sensor", "thrust", "--sensor", "speed")
    free = ("--free", ",".join(name for name in TRUTH if not name.startswith(("Q", "R"))), "--starts", 1)
    as_json("identify", *logs, "--preset", "tunnel_physical", *of_logs, *free, "--out", "mine.toml")
    options = [part for log in logs for part in ("--log", log)]
    told = as_json("tune", "--filter", "ekf", *options, "--preset", "mine.toml", *of_logs, "--trials", 12)
    (held_out,) = told["held_out"].values()
    assert held_out["tuned"]["log_likelihood"] >= held_out["given"]["log_likelihood"]
    assert {"given"} <= {one["name"] for one in told["choice"]["met"]}
