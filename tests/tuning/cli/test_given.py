"""What a model came with, at the command line: `evaluate --given`, and a preset that is tuned on logs."""

import pytest

from tests import altitude_problem
from tests.tuning.cli.test_cli import as_json, thruster  # noqa: F401 - fixtures
from tuning.evaluation.baselines import given_noise
from tuning.evaluation.held_out import evaluate_held_out

ALTITUDE = "tests.altitude_problem:problem"


def test_what_the_model_came_with_is_evaluated_and_is_no_rule_of_thumb(as_json, thruster):  # noqa: F811
    told = as_json("evaluate", "--given", "--problem", ALTITUDE, "--seeds", 12)
    problem = altitude_problem.problem()
    mine = given_noise("ekf", problem)
    assert told["filter"]["name"] == "ekf" and told["filter"]["model"] == altitude_problem.GIVEN == mine.model
    found = evaluate_held_out(mine, problem, 0, 12).tuned
    assert told["given"]["score"] == pytest.approx(list(found.score), rel=1e-9)
    assert told["noise"]["score"][0] < told["given"]["score"][0]
    done = thruster("evaluate", "--given", "--problem", ALTITUDE, "--filter", "ukf", "--seeds", 3)
    assert done.returncode == 0 and "Parameters of the ukf filter" in done.stdout and "given" in done.stdout


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
def test_where_nothing_was_given_one_line_says_so(thruster, options, said):  # noqa: F811
    done = thruster("evaluate", "--given", *options)
    assert done.returncode == 2 and said in " ".join(done.stderr.split())
