"""The tuned filter as a MATLAB function: its f and h are the model's, operation by operation."""

import math
import re
from math import exp, sin
from pathlib import Path

import numpy as np
import pytest

import tuning.cli
from tests.models import state_space
from thruster_env.model.affine import AffineModel
from tuning.problems.find import find_problem
from tuning.reporting.matlab import function_name, lines_of, matlab_function
from tuning.search.space import Choice, untuned_choice


def value_of(lines, x, u):
    """What lines of MATLAB come to, by Python's operators."""
    named = {"x": lambda i: x[i - 1], "u": lambda i: u[i - 1], "abs": abs, "sin": sin, "exp": exp}
    named |= IN_PYTHON
    for line in lines[:-1]:
        name, _, told = line.rstrip(";").partition(" = ")
        named[name] = eval(told.replace("^", "**").replace("~=", "!="), named)
    return [eval(name, named) for name in lines[-1].strip("[]").split("; ")]


@pytest.mark.parametrize("name", ["outliers", "auv:motion"])
def test_traced_functions_are_those_of_the_model(name):
    model = find_problem(name).model()
    x = [0.3, -0.2, 0.05, 0.1, -0.15, 0.2, 0.12, -0.07][: model.n]
    u, c = [1.5, 0.1, -0.05][: model.inputs], model.given_constants
    names = [f"x({i + 1})" for i in range(model.n)], [f"u({i + 1})" for i in range(model.inputs)]
    f, h = lines_of(model.transition, names, c, model.n), lines_of(model.observe, names[:1], c, model.m)
    np.testing.assert_allclose(value_of(f, x, u), model.transition(tuple(x), tuple(u), c), rtol=1e-12)
    np.testing.assert_allclose(value_of(h, x, u), model.observe(tuple(x), c), rtol=1e-12)


def test_elementary_functions_and_branches_are_written_out():
    lines = lines_of(lambda x, c: (np.sin(x[0]) - c[0] * np.exp(-x[1]), 2.0), [["x(1)", "x(2)"]], (3.0,), 2)
    np.testing.assert_allclose(value_of(lines, [0.4, 0.5], []), [sin(0.4) - 3.0 * exp(-0.5), 2.0])
    lines = lines_of(branching, [["x(1)"], []], (), 1)
    for x in (0.0, -0.7, 1.3):
        np.testing.assert_allclose(value_of(lines, [x], []), branching((x,), (), ()), rtol=1e-15)


def helper(a, b):
    return math.hypot(a, b) + sin(a)


def scale_of(factor):
    return lambda value: factor * math.tanh(value)


def of_math(x, u, c):
    double = scale_of(2.0)
    first = math.exp(-x[0]) * math.log(x[1], 3) + math.atan2(x[0], x[1]) + exp(0.3) + math.pi
    second = helper(x[0], x[1]) + double(x[0]) + min(x[0], x[1], 0.2) - max([x[1], u[0]]) + abs(-x[1])
    third = math.fmod(-x[1], 0.3) + math.copysign(x[0], -x[1]) + math.floor(x[1]) + x[1] // 0.4 + (-x[1]) % 0.3
    fourth = math.sqrt(x[1]) + math.pow(x[1], 1.5) + math.radians(x[0]) + math.log10(x[1]) + math.fabs(x[0])
    return first, second, third, fourth, math.remainder(x[1], 0.9)


def of_numpy(x, u, c):
    first = np.arctan2(x[0], x[1]) + np.log1p(x[1]) + np.hypot(x[0], u[0]) + np.arcsin(x[0] / 3.0)
    return first, np.minimum(x[0], x[1]) + np.maximum(x[0], 0.9), np.clip(x[1], 0.0, 1.0) + np.mod(-x[1], 0.9)


IN_PYTHON = {
    "log": math.log, "atan2": math.atan2, "hypot": math.hypot, "tanh": math.tanh, "min": min, "max": max,
    "rem": math.fmod, "round": round, "floor": math.floor, "sqrt": math.sqrt, "log10": math.log10, "pi": math.pi,
    "log1p": math.log1p, "choose": lambda condition, a, b: a if condition else b,
}  # fmt: skip


@pytest.mark.parametrize("function", [of_math, of_numpy])
def test_functions_of_math_are_traced_as_those_of_numpy(function):
    x, u = [0.7, 1.3], [0.2]
    lines = lines_of(function, (["x(1)", "x(2)"], ["u(1)"]), (), len(function((0.7, 1.3), (0.2,), ())))
    np.testing.assert_allclose(value_of(lines, x, u), function(tuple(x), tuple(u), ()), rtol=1e-14)


def branching(x, u, c):
    if x[0] < 0.0 or x[0] != x[0]:
        return (1.0,)
    return (math.sin(x[0]) + 1.0,)


def truncating(x, u, c):
    return (float(int(x[0])),)


def test_what_cannot_be_written_out_says_where_and_why():
    with pytest.raises(ValueError, match=r"but truncating \(test_matlab.py, line \d+\) cannot be .*int") as caught:
        lines_of(truncating, (["x(1)"], []), (), 1)
    assert "\n" not in str(caught.value)
    model = state_space(truncating, lambda x, c: (x[0],), q=[1.0], r=[1.0], mean=[0.0], cov=[1.0])
    text = matlab_function(Choice("ekf", {}, {}), model, "mine", None)
    assert "%   Why: a function that is written out must" in text and "test_matlab.py, line" in text
    assert "m.f and m.h are yours to add" in text and "@transition" not in text and "m.dt" not in text
    assert function_name("ekf", "auv:motion") == "ekf_auv_motion" and function_name("1.csv") == "f_1_csv"


def test_the_template_that_thruster_new_writes_can_be_exported():
    names = {"__name__": "template"}
    source = (Path(tuning.cli.__file__).parent / "templates" / "problem.py").read_text()
    exec(compile(source, "problem.py", "exec"), names)
    model = names["model"](4.0)
    text = matlab_function(Choice("ekf", {}, {}), model, "mine", 0.1)
    assert "m.f = @transition;" in text and "cannot be written out" not in text


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
