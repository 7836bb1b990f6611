"""Rows of the numbers of filters: equal variances of many states share one; nobody invents correlations."""

import numpy as np
import pytest

from filters import affine_model
from tuning.problems.model_problem import ModelProblem
from tuning.reporting.choice_words import number_rows
from tuning.search.parameters import index_pairs
from tuning.search.space import Choice


def test_variances_that_are_the_same_share_a_row_and_correlations_stand_where_q_does():
    model = affine_model(
        A=0.5 * np.eye(5), B=np.zeros((5, 1)), C=np.eye(5)[:2], Q=np.ones(5), R=[1.0, 1.0], P0=np.ones(5)
    )
    problem = ModelProblem(model, inputs=[0.0] * 60, scale=np.ones(5))
    equal = Choice("ekf", {"process_noise_cov": (2.0,) * 5, "measurement_noise_cov": (1.0, 3.0)}, {})
    silent = Choice("ekf", {}, {})
    rows = number_rows([equal, silent], "ekf", problem, str)
    assert rows == [["Q11 to Q55", "2.0", "None"], ["R11", "1.0", "None"], ["R22", "3.0", "None"]]
    own = equal._replace(model={"process_noise_cov": tuple(map(tuple, np.diag([1.0, 2, 2, 2, 2]).tolist()))})
    assert number_rows([own], "ekf", problem, str)[:2] == [["Q11", "1.0"], ["Q22 to Q55", "2.0"]]
    tied = np.eye(5)
    tied[0, 1] = tied[1, 0] = 0.5
    tied = Choice("ekf", {"process_noise_cov": tuple(map(tuple, tied.tolist()))}, {})
    found = {row[0]: row[1:] for row in number_rows([tied, equal, silent], "ekf", problem, str)}
    assert found["largest of 10 Q correlations"] == ["0.5", "0.0", "None"]


@pytest.mark.parametrize(("m", "labels"), [(3, ["R correlation 12", "R correlation 13", "R correlation 23"]),
                                           (4, ["largest of 6 R correlations"])])  # fmt: skip
def test_correlations_of_r_of_four_channels_are_one_row_like_those_of_q(m, labels):
    model = affine_model(
        A=0.5 * np.eye(m),
        B=np.zeros((m, 1)),
        C=np.eye(m),
        Q=np.ones(m),
        R=np.ones(m),
        x0=np.zeros(m),
        P0=np.ones(m),
    )
    problem = ModelProblem(model, inputs=[0.0] * 60, scale=np.ones(m))
    r = np.eye(m)
    r[0, 1] = r[1, 0] = 0.5
    r[0, 2] = r[2, 0] = -0.6
    choice = Choice("ekf", {"measurement_noise_cov": tuple(map(tuple, r.tolist()))}, {})
    found = {row[0]: row[1:] for row in number_rows([choice], "ekf", problem, lambda v: f"{v:.2f}")}
    assert [label for label in found if "correlation" in label] == labels
    if m == 4:
        assert found[labels[0]] == ["-0.60"]


def test_correlations_of_many_states_are_one_row_and_two_digits_stand_apart():
    n = 11
    model = affine_model(
        A=0.5 * np.eye(n),
        B=np.zeros((n, 1)),
        C=np.eye(n)[:1],
        Q=np.ones(n),
        R=[1.0],
        x0=np.zeros(n),
        P0=np.ones(n),
    )
    problem = ModelProblem(model, inputs=[0.0] * 60, scale=np.ones(n))
    assert repr(problem) == f"ModelProblem({problem.name!r})"
    q = np.diag(1.0 + np.arange(n))
    q[0, 1] = q[1, 0] = -0.8 * np.sqrt(2.0)
    rows = number_rows(
        [Choice("ekf", {"process_noise_cov": tuple(map(tuple, q.tolist()))}, {})], "ekf", problem, str
    )
    assert [row[0] for row in rows if row[0].startswith("Q")][-2:] == ["Q10,10", "Q11,11"]
    (largest,) = [row for row in rows if "correlation" in row[0]]
    assert largest[0] == "largest of 55 Q correlations" and float(largest[1]) == pytest.approx(-0.8)
    assert index_pairs("Q11 and Q1010, R1111") == "Q11 and Q10,10, R11,11"
