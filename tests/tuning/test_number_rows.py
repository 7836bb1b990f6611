"""Rows of the numbers of filters: equal variances of many states share one; nobody invents correlations."""

import numpy as np

from filters import affine_model
from tuning.problems.model_problem import ModelProblem
from tuning.reporting.units import number_rows
from tuning.search.space import Choice


def test_variances_that_are_the_same_share_a_row_and_correlations_stand_where_q_does():
    model = affine_model(
        a=0.5 * np.eye(5),
        b=np.zeros((5, 1)),
        c=np.eye(5)[:2],
        process_noise_cov=np.ones(5),
        measurement_noise_cov=[1.0, 1.0],
        prior_mean=np.zeros(5),
        prior_cov=np.ones(5),
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
    assert found["correlation 12"] == ["0.5", "0.0", "None"]
    assert found["correlation 13 to correlation 45"] == ["0.0", "0.0", "None"]
