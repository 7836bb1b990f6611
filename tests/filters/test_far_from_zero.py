"""Models that branch, cannot be traced, have kinks at rest or lie far from zero, in any unit: the same numbers."""

import math

import numpy as np
import pytest
import torch

import filters
from filters import make_filter, run
from filters.c.project import c_filter
from filters.sensitivity import ModelSlopes, likelihood, sensitivity
from tests.filters.textbooks import extended_filter
from tests.models import simulated, state_space
from tests.oracles import each_close
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


def moved_slopes(x, u, c):
    return (1.0, DT), (0.0, 1.0 - DT * 0.4 * abs(x[1]))


def ranged_slopes(x, c):
    return ((1.0 if x[0] > 30.0 else x[0] / math.hypot(x[0], 2.0), 0.0),)


@pytest.mark.usefixtures("as_python")
def test_a_branch_has_the_slope_of_its_side():
    inputs, z = data()
    found = run(make_filter("ekf", body()), None, inputs, z).means
    by_hand = body(transition_jacobian=moved_slopes, observe_jacobian=ranged_slopes)
    each_close(found, [extended_filter(by_hand, *run_)[0] for run_ in zip(inputs, z, strict=True)], atol=1e-11)


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
    each_close((near[0], near[1]), ([[1.0, DT], [0.0, 1.0 - DT * 0.2]], [[0.0], [DT]]), atol=1e-9)


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


def drag(x, u, c):
    """A body in a plane, with a drag that grows with the square of its speed: position, velocity."""
    speed = math.sqrt(x[2] * x[2] + x[3] * x[3])
    ahead, abeam = (DT * (u[k] - c[0] * speed * x[2 + k]) for k in range(2))
    return x[0] + DT * x[2], x[1] + DT * x[3], x[2] + ahead, x[3] + abeam


def drag_slopes(x, u, c):
    """By hand, with the limit at rest."""
    speed = math.sqrt(x[2] * x[2] + x[3] * x[3])
    if speed == 0.0:
        by_velocity = (0.0, 0.0, 0.0)
    else:
        by_velocity = speed + x[2] * x[2] / speed, x[2] * x[3] / speed, speed + x[3] * x[3] / speed
    a, b, d = (DT * c[0] * one for one in by_velocity)
    return (1.0, 0.0, DT, 0.0), (0.0, 1.0, 0.0, DT), (0.0, 0.0, 1.0 - a, -b), (0.0, 0.0, -b, 1.0 - d)


def place(x, c):
    return x[0], x[1]


def at_rest(**changes):
    noise = {"q": [1e-4, 1e-4, 1e-3, 1e-3], "r": [0.01, 0.01]}
    prior = {"mean": [0.0] * 4, "cov": [0.01] * 4}
    return state_space(drag, place, **noise, **prior, **{"inputs": 2, "constants": (0.3,), **changes})


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("name", LINEARISING)
def test_a_body_at_rest_is_estimated_as_with_slopes_by_hand(name):
    inputs, z = simulated(at_rest(), 25, count=2, level=2.0)
    keys = np.arange(4.0).reshape(2, 2)
    found, expected = (
        run(make_filter(name, at_rest(transition_jacobian=one)), keys, inputs, z) for one in (None, drag_slopes)
    )
    assert not found.divergences.any() and abs(found.means[:, -1, 2:]).max() > 0.5
    np.testing.assert_allclose(found.means, expected.means, atol=1e-9)


def powered(x, u, c):
    """A speed, with a drag of any exponent."""
    return (x[0] + DT * (u[0] - c[0] * np.sign(x[0]) * abs(x[0]) ** c[1]),)


def tank(x, u, c):
    """A level that falls as Torricelli says."""
    return (x[0] + DT * (u[0] - c[0] * math.sqrt(max(x[0], 0.0))),)


def one_state(transition, constants, start=0.0):
    noise = {"q": [1e-4], "r": [0.01]}
    prior = {"mean": [start], "cov": [0.04]}
    return state_space(transition, lambda x, c: (x[0],), **noise, **prior, inputs=1, constants=constants)


@pytest.mark.usefixtures("as_python")
def test_an_exponent_is_identified_from_rest():
    model = one_state(powered, (0.5, 1.8))
    inputs, z = simulated(model, 60, count=2, level=2.0)
    none = np.zeros((2, 1, 1))
    found = sensitivity(model, inputs, z, ModelSlopes(np.eye(2), none, none, np.zeros((2, 1)), none))
    assert (np.linalg.eigvalsh(found.information) > 0.0).all()
    step = 1e-5
    for k in range(2):
        sides = []
        for sign in (1.0, -1.0):
            c = np.array(model.constants) + sign * step * np.eye(2)[k]
            sides.append(likelihood(model.replace(constants=tuple(c)), inputs, z, none[:1], none[:1]).values.sum())
        assert found.gradients.sum(axis=0)[k] == pytest.approx((sides[0] - sides[1]) / (2 * step), rel=1e-4)


@pytest.mark.usefixtures("as_python")
def test_a_tank_that_empties_does_not_restart():
    model = one_state(tank, (0.5,), start=0.1)
    z = np.zeros((1, 41, 1))
    found = run(make_filter("ekf", model), None, np.zeros((1, 40, 1)), z)
    assert not found.divergences.any() and np.isfinite(found.means).all()


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize(
    "make", [at_rest, lambda: one_state(tank, (0.5,)), lambda: one_state(powered, (0.5, 1.8))]
)
def test_tensors_have_finite_derivatives_at_rest(make):
    model = make()
    inputs, z = simulated(model, 8, count=2, level=1.0)
    inputs[:, :3] = 0.0
    on_tensors = filters.torch(make_filter("ekf", model))
    q = torch.tensor(model.process_noise_cov, requires_grad=True)
    c = torch.tensor(model.constants, dtype=torch.float64, requires_grad=True)
    means = on_tensors.replace(process_noise_cov=q, constants=c).run(inputs, z).means
    np.testing.assert_allclose(
        means.detach(), run(make_filter("ekf", model), None, inputs, z).means, rtol=0, atol=1e-10
    )
    (means**2).sum().backward()
    assert torch.isfinite(q.grad).all() and torch.isfinite(c.grad).all() and c.grad.any()


def drag_of_tensors(x, u, c):
    """The same for torch, whose root at rest has an infinite slope."""
    speed = torch.sqrt(x[2] * x[2] + x[3] * x[3])
    low = (x[2] ** 2) ** 0.5 + torch.hypot(x[2], x[3]) + torch.atan2(x[2], x[3]) * torch.acos(1.0 + 0.0 * x[3])
    ahead, abeam = (DT * (u[k] - (c[0] + 0.0 * low) * speed * x[2 + k]) for k in range(2))
    return x[0] + DT * x[2], x[1] + DT * x[3], x[2] + ahead, x[3] + abeam


def test_functions_of_tensors_have_finite_slopes_at_rest():
    inputs, z = simulated(at_rest(), 5, count=2, level=2.0)
    filter_ = make_filter("ekf", at_rest())
    graph, given = filters.torch(filter_), filters.torch(filter_, transition=drag_of_tensors)
    found = []
    for one in (graph, given):
        c = torch.tensor([0.3], dtype=torch.float64, requires_grad=True)
        estimates = one.replace(constants=c).run(inputs, z)
        assert not estimates.divergences.any()
        found.append((estimates.means.detach(), torch.autograd.grad(estimates.log_likelihoods.sum(), c)[0]))
    torch.testing.assert_close(*found, rtol=1e-10, atol=1e-12)
