"""Models whose slopes have kinks where a run begins: filters that linearise go on as with the limits by hand."""

import math

import numpy as np
import pytest
import torch

import filters
from filters import make_filter, run
from filters.sensitivity import ModelSlopes, likelihood, sensitivity
from tests.models import simulated, state_space

DT = 0.1
LINEARISING = ("ekf", "iekf", "ekf-robust", "vb", "sage-husa", "fading", "h-infinity", "schmidt", "mhe", "gsf")


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
