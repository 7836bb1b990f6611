"""The tuned filter as a MATLAB function: its f and h are the model's, operation by operation."""

import re
from math import exp, sin

import numpy as np
import pytest

from plants.affine import AffineModel
from plants.state_space import StateSpaceModel
from tuning.problems.find import find_problem
from tuning.reporting.matlab import function_name, matlab_function
from tuning.reporting.traced import traced
from tuning.search.space import Choice, untuned_choice


def value_of(lines, x, u):
    """What lines of MATLAB come to, by Python's operators."""
    named = {"x": lambda i: x[i - 1], "u": lambda i: u[i - 1], "abs": abs, "sin": sin, "exp": exp}
    named["mod"] = lambda a, b: a % b
    for line in lines[:-1]:
        name, _, told = line.rstrip(";").partition(" = ")
        named[name] = eval(told.replace("^", "**"), named)
    return [eval(name, named) for name in lines[-1].strip("[]").split("; ")]


@pytest.mark.parametrize("name", ["outliers", "auv:motion"])
def test_traced_functions_are_those_of_the_model(name):
    model = find_problem(name).model()
    x = [0.3, -0.2, 0.05, 0.1, -0.15, 0.2, 0.12, -0.07][: model.n]
    u, c = [1.5, 0.1, -0.05][: model.inputs], model.given_constants
    names = [f"x({i + 1})" for i in range(model.n)], [f"u({i + 1})" for i in range(model.inputs)]
    f, h = traced(model.transition, names, c), traced(model.observe, names[:1], c)
    np.testing.assert_allclose(value_of(f, x, u), model.transition(tuple(x), tuple(u), c), rtol=1e-12)
    np.testing.assert_allclose(value_of(h, x, u), model.observe(tuple(x), c), rtol=1e-12)


def test_elementary_functions_are_traced_and_branches_are_not():
    lines = traced(lambda x, c: (np.sin(x[0]) - c[0] * np.exp(-x[1]), 2.0), [["x(1)", "x(2)"]], (3.0,))
    np.testing.assert_allclose(value_of(lines, [0.4, 0.5], []), [sin(0.4) - 3.0 * exp(-0.5), 2.0])
    assert traced(lambda x, c: (x[0] if x[0] > 0 else 0.0,), [["x(1)"]], ()) is None
    assert traced(lambda x, c: (sin(x[0]),), [["x(1)"]], ()) is None


def test_the_function_holds_the_model_and_the_step_of_a_kalman_filter():
    problem = find_problem("outliers")
    choice = untuned_choice("ekf", problem)
    model = problem.model(**choice.model)
    text = matlab_function(choice, model, problem.name, problem.dt)
    assert text.startswith("function [x, P, e, S] = ekf_outliers(x, P, z, u)\n%EKF_OUTLIERS  ")
    found = re.search(r"m\.Q = diag\(\[(.*), (.*)\]\);", text).groups()
    np.testing.assert_array_equal(np.array(found, float), model.process_noise_cov.diagonal())
    assert f"m.R = {model.measurement_noise_cov[0, 0]:.17g};" in text and "for part = 1:2\n" in text
    assert text.count("function ") - text.count("  function ") == len(re.findall(r"^end$", text, re.M)) - 4
    other = matlab_function(Choice("ukf", {}, choice.model), model, problem.name, problem.dt)
    assert "unscentedKalmanFilter(m.f, m.h" in other and "slopes" not in other


def test_an_affine_model_is_its_matrices():
    problem = find_problem("published_tunnel")
    choice = untuned_choice("kf", problem)
    model = problem.model(**choice.model)
    assert isinstance(model, AffineModel)
    text = matlab_function(choice, model, problem.name, problem.dt)
    rows = re.search(r"m\.A = \[(.*)\];", text)[1].split("; ")
    np.testing.assert_array_equal([np.array(row.split(", "), float) for row in rows], model.matrices()[0])


def test_a_model_that_cannot_be_written_out_says_so():
    model = StateSpaceModel(
        transition=lambda x, u, c: (x[0] if x[0] > 0 else 0.5 * x[0],),
        observe=lambda x, c: (x[0],),
        process_noise_cov=[1.0],
        measurement_noise_cov=[1.0],
        prior_mean=[0.0],
        prior_cov=[1.0],
    )
    text = matlab_function(Choice("ekf", {}, {}), model, "mine", None)
    assert "m.f and m.h are yours to add" in text and "@transition" not in text and "m.dt" not in text


def test_names_are_those_that_matlab_takes():
    assert function_name("ekf", "auv:motion") == "ekf_auv_motion" and function_name("1.csv") == "f_1_csv"
