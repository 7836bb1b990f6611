"""Models whose functions branch or cannot be traced, far from zero and in any unit: the same numbers.

A body is moved by an input, and ranged from a point beside its way. Far from zero both are moved together.
"""

import math

import numpy as np
import pytest
import torch

import filters
from filters import make_filter, run
from filters.c.project import c_filter
from filters.sensitivity import ModelSlopes, sensitivity
from tests.models import simulated, state_space
from thruster_env.core.compiled import interpreted
from thruster_env.core.derivatives import jacobian, step_growth, step_of
from thruster_env.model.affine import linearize

DT = 0.1
LINEARISING = ("ekf", "iekf", "ekf-robust", "vb", "sage-husa", "fading", "h-infinity", "schmidt", "mhe", "gsf")
KEYS = np.arange(4.0).reshape(2, 2)


def moved(x, u, c):
    speed = x[1]
    if speed >= 0.0:
        drag = 0.2 * speed * speed / c[1]
    else:
        drag = -0.2 * speed * speed / c[1]
    return x[0] + DT * speed, speed + DT * (u[0] * c[1] - drag)


def ranged(x, c):
    along = (x[0] - c[0]) / c[1]
    if along > 30.0:
        return (along * c[1],)
    return (math.sqrt(along * along + 4.0) * c[1],)


def moved_called(x, u, c):
    """The same, in a form that cannot be traced."""
    drag = 0.2 * x[1] * (x[1] if int(x[1] >= 0.0) else -x[1]) / c[1]
    return x[0] + DT * x[1], x[1] + DT * (u[0] * c[1] - drag)


def ranged_called(x, c):
    along = (x[0] - c[0]) / c[1]
    return (math.sqrt(along * along + (4.0 if int(along < 1e9) else 0.0)) * c[1],)


def body(offset=0.0, unit=1.0, called=False, **changes):
    return state_space(
        moved_called if called else moved,
        ranged_called if called else ranged,
        q=[1e-3 * unit**2, 1e-3 * unit**2],
        r=[0.01 * unit**2],
        mean=[offset + 1.0 * unit, 0.5 * unit],
        cov=[unit**2, 0.1 * unit**2],
        **{"inputs": 1, "constants": (offset, unit), **changes},
    )


def data():
    return simulated(body(), 25, count=2, level=1.0)


def estimates(name, model, inputs, z):
    offset, unit = model.constants
    found = run(make_filter(name, model), KEYS, inputs, z * unit)
    assert not found.divergences.any()
    return (found.means - [offset, 0.0]) / unit


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("called", [False, True])
@pytest.mark.parametrize("name", LINEARISING)
def test_estimates_far_from_zero_are_those_near_zero(name, called):
    inputs, z = data()
    expected = estimates(name, body(), inputs, z)
    for offset, unit in ((5e6, 1.0), (-5.0, 1e-6), (1e9, 1e6)):
        found = estimates(name, body(offset, unit, called), inputs, z)
        np.testing.assert_allclose(found, expected, atol=1e-5)


def by_hand(inputs, z):
    """The extended filter of the body, as a textbook has it."""
    model, means = body(), []
    x, p = model.prior_mean, model.prior_cov
    for k, seen in enumerate(z[:, 0]):
        if k:
            f = np.array([[1.0, DT], [0.0, 1.0 - DT * 0.4 * abs(x[1])]])
            x, p = np.array(moved(x, inputs[k - 1], model.constants)), f @ p @ f.T + model.process_noise_cov
        h = np.array([[1.0 if x[0] > 30.0 else x[0] / math.hypot(x[0], 2.0), 0.0]])
        gain = p @ h.T / (h @ p @ h.T + 0.01)
        x, p = x + gain[:, 0] * (seen - ranged(x, model.constants)[0]), p - gain @ h @ p
        means.append(x)
    return np.array(means)


@pytest.mark.usefixtures("as_python")
def test_a_branch_has_the_slope_of_its_side():
    inputs, z = data()
    found = run(make_filter("ekf", body()), None, inputs, z).means
    for k in range(2):
        np.testing.assert_allclose(found[k], by_hand(inputs[k], z[k]), atol=1e-11)


@pytest.mark.usefixtures("as_python")
def test_a_model_that_branches_runs_as_a_program_on_tensors_and_in_c():
    model, (inputs, z) = body(), data()
    filter_ = make_filter("ekf", model)
    assert filter_.kernels().vectors
    on_tensors = filters.torch(filter_)
    constants = torch.tensor(model.constants, dtype=torch.float64, requires_grad=True)
    found = on_tensors.replace(constants=constants).run(inputs, z).means
    np.testing.assert_allclose(found.detach(), run(filter_, None, inputs, z).means, atol=1e-11)
    found.sum().backward()
    assert torch.isfinite(constants.grad).all() and constants.grad.all()
    assert "?" in c_filter(filter_).source


@pytest.mark.slow
def test_machine_code_has_the_numbers_of_python():
    inputs, z = data()
    for name, called in (("ekf", True), ("ukf", False)):
        filter_ = make_filter(name, body(5e6, called=called))
        found = run(filter_, KEYS, inputs, z).means
        with interpreted():
            np.testing.assert_allclose(found, run(filter_, KEYS, inputs, z).means, rtol=0, atol=1e-6)


def flow(x, u, c):
    """Forty states, of which each pulls at the next; in an array, too many for a program."""
    out = np.empty_like(x)
    for i in range(40):
        pull = x[i - 1] - x[i]
        out[i] = x[i] + 0.05 * pull * (1.0 + (pull * pull if int(pull > 0.0) else 0.0) / (c[1] * c[1]))
    return out


@pytest.mark.usefixtures("as_python")
def test_many_states_far_from_zero():
    found, (inputs, z) = [], (np.zeros((1, 6, 0)), np.sin(np.arange(7.0 * 40)).reshape(1, 7, 40))
    for offset, unit in ((0.0, 1.0), (5e6, 1.0), (1e9, 1e3)):
        noise = {"q": [0.01 * unit**2] * 40, "r": [0.1 * unit**2] * 40}
        prior = {"mean": offset + unit * np.cos(np.arange(40.0)), "cov": [unit**2] * 40}
        model = state_space(flow, lambda x, c: x, **noise, **prior, inputs=0, constants=(offset, unit))
        found.append((run(make_filter("ekf", model), None, inputs, offset + unit * z).means - offset) / unit)
    for other in found[1:]:
        np.testing.assert_allclose(other, found[0], atol=1e-5)


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("called", [False, True])
@pytest.mark.parametrize("unit", [1e-9, 1e-6, 1.0, 1e6])
def test_a_position_that_is_known_at_first_has_the_scale_of_its_velocity(unit, called):
    inputs, z = data()
    changes = {"process_noise_cov": [0.0, 1e-3 * unit**2], "prior_cov": [0.0, 0.1 * unit**2]}
    model = body(0.0, unit, called, **changes)
    assert model.scales[0] == pytest.approx(DT * model.scales[1], rel=0.5)
    expected = estimates("ekf", body(process_noise_cov=[0.0, 1e-3], prior_cov=[0.0, 0.1]), inputs, z)
    np.testing.assert_allclose(estimates("ekf", model, inputs, z), expected, atol=1e-6)


def test_scales_of_states_without_variance():
    def step(x, u, c):
        return x[0] + x[1], x[1], x[2] + 0.25, x[3], x[4]

    prior = {"mean": [7.0, 0.0, 3.0, -40.0, 0.0], "cov": [0.0, 0.01, 0.0, 0.0, 0.0]}
    model = state_space(step, lambda x, c: (x[0],), q=[0.0] * 5, r=[1.0], **prior, inputs=0)
    np.testing.assert_allclose(model.scales, [0.1 * (0.75 + 0.25 * math.cos(1.0)), 0.1, 0.25, 40.0, 1.0])


@pytest.mark.parametrize("size", [0.0, 1e-9, 1.0, 1e9])
@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_a_step_balances_rounding_and_curvature(size, scale):
    for x in (size, -size):
        h = step_of(x, scale, step_growth(1)((x,), (scale,)))
        assert abs(x) < h or (x + h) - x == h == x - (x - h)  # exact
        wanted = (2.0**-52 * min(1e9, 1.0 + abs(x) / scale)) ** (1 / 3) * scale
        assert 0.4 < h / max(wanted, 2.0**-42 * abs(x)) < 1.1


@pytest.mark.parametrize("rows", [1, 40])
def test_a_difference_at_the_end_of_a_function_is_one_sided(rows):
    def root(x, c):
        with np.errstate(invalid="ignore"):
            values = (np.sqrt(1.0 - x[0]) + 3.0 * x[1], np.sqrt(x[1] - 2.0 + 0.0 * x[0]) * (x[1] - 2.0))
        return np.array(values * (rows // 2)) if rows > 1 else values[:1]

    found = np.array(jacobian(root, None, rows, 2, "c")((0.5, 2.0), (1.0, 1.0), ()))
    expected = [[-0.5 / math.sqrt(0.5), 3.0], [0.0, 0.0]]
    np.testing.assert_allclose(found, (expected * rows)[:rows], atol=0.01)


NOT_FINITE = {
    "division": lambda x, c: ((x[0] / math.sqrt(x[0] * x[0]), 0.0),),
    "logarithm": lambda x, c: ((math.log(x[0]), 0.0),),
    "NaN": lambda x, c: ((math.nan, 0.0),),
    "infinity": lambda x, c: ((math.inf, 0.0),),
}


@pytest.mark.parametrize("name", NOT_FINITE)
def test_a_jacobian_that_is_not_finite_at_the_prior_mean_is_refused(name):
    changes = {"prior_mean": [0.0, 0.0], "observe": lambda x, c: (math.sqrt(x[0] * x[0]),)}
    with pytest.raises(ValueError, match="observe_jacobian must be finite at the prior mean .* or leave it out"):
        body(**changes, observe_jacobian=NOT_FINITE[name])
    body(**changes, observe_jacobian=lambda x, c: ((0.0, 0.0),))


@pytest.mark.parametrize("called", [False, True])
def test_an_approximation_far_from_zero_is_that_near_zero(called):
    near, far = (
        linearize(body(offset, called=called), [offset + 1.0, 0.5], [0.0]).matrices() for offset in (0.0, 5e6)
    )
    for k in (0, 1, 3):  # A, B, C
        np.testing.assert_allclose(far[k], near[k], atol=1e-6)
    np.testing.assert_allclose(near[0], [[1.0, DT], [0.0, 1.0 - DT * 0.2]], atol=1e-9)
    np.testing.assert_allclose(near[1], [[0.0], [DT]], atol=1e-9)


@pytest.mark.usefixtures("as_python")
def test_slopes_along_constants_of_called_functions_far_from_zero():
    def gradient(offset, unit, called):
        def dragged(x, u, c):
            ahead = int(x[1] >= 0.0) if called else x[1] >= 0.0
            drag = c[0] * x[1] * x[1] / unit * (2.0 * ahead - 1.0)
            return x[0] + DT * c[1] * x[1], x[1] + DT * (u[0] * unit - drag)

        model = body(offset, unit, called, transition=dragged, observe=lambda x, c: (x[0],), constants=(0.2, 1.0))
        inputs, z = data()
        by_noise = [np.zeros((2, *shape)) for shape in ((2, 2), (1, 1), (2,), (2, 2))]
        slopes = ModelSlopes(np.eye(2), *by_noise)
        return sensitivity(model, inputs, offset + z * unit, slopes).gradients.sum(axis=0)

    expected = gradient(0.0, 1.0, called=False)
    for offset, unit, called in ((5e6, 1.0, False), (0.0, 1.0, True), (5e6, 1.0, True), (-5.0, 1e-6, True)):
        np.testing.assert_allclose(gradient(offset, unit, called), expected, rtol=0.01)
