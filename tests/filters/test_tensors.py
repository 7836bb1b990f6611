"""Filters on tensors: the estimates of `run`, the gradients of `likelihood`, networks and functions of floats."""

import copy
import math
import pickle

import numpy as np
import pytest
import torch

import filters
from filters import make_filter, run, thruster_model
from filters.sensitivity import likelihood
from tests.filters.checks import refused
from tests.filters.test_c import ENSEMBLES, KEPT, OWN, made
from tests.filters.test_filter_paths import diverging
from tests.filters.test_likelihood import directions, two_channels
from tests.filters.test_pages import wide_pendulum
from tests.models import lonely_model, plane_model, random_affine, scalar_model, simulated, state_space, wide_model
from tests.slow import slow_but
from thruster_env.auv.model import auv_model
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import filter_keys
from tuning.cli.templates.filter import Template

NAMES = ("kf", "ekf", "iekf", "ukf", "ckf")
MODELS = {
    "thruster": thruster_model,
    "pendulum": wide_pendulum,
    "vehicle": lambda: auv_model(states="velocities"),
    "affine": wide_model,
    "no input": lonely_model,
    "large": lambda: random_affine(12, 10, 1),
}
LARGE = ("vehicle", "large")  # what is done with tensors does not depend on sizes, so a few filters run on these
ON_LARGE = ("kf information", "ekf square-root", "ukf square-root", "ckf", "vb")
EACH_MODEL = [
    (name, which)
    for name in OWN
    for which in MODELS
    if not name.endswith(" ud") and (name in ON_LARGE or which not in LARGE)
]


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def assert_same(found, expected, accuracy=1e-10):
    """Each array to an accuracy relative to its largest number."""
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(np.asarray(one), other, rtol=0, atol=accuracy * max(abs(other).max(), 1e-300))


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize(("name", "which"), slow_but(EACH_MODEL, {one for one in EACH_MODEL if one[1] != "large"}))
def test_estimates_are_those_of_run(name, which):
    model = MODELS[which]()
    if name.startswith("kf") and MODELS[which] is wide_pendulum:
        model = model.replace(operating_state=[0.3, 0.0], operating_input=[0.5])
    inputs, z = simulated(model, 12, count=3, level=1.0, missing=0.3)
    filter_ = made(name, model)
    assert_same(filters.torch(filter_).run(inputs, z), run(filter_, None, inputs, z))


@pytest.mark.usefixtures("as_python")
def test_a_schedule_of_gains_is_that_of_run():
    filter_ = make_filter("kf", thruster_model(), schedule=5)
    inputs, z = simulated(filter_.model, 12, count=3, level=15.0, missing=0.3)
    assert_same(filters.torch(filter_).run(inputs, z), run(filter_, None, inputs, z))


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("name", [name for name in KEPT if not name.endswith(" ud")])
def test_what_a_filter_keeps_is_that_of_its_belief(name):
    filter_ = made(name, wide_model())
    inputs, z = simulated(filter_.model, 6, missing=0.3)
    tensors = filters.torch(filter_)
    belief, beliefs = filter_.init(), tensors.init(2)
    for u, seen in zip(inputs[0], z[0, 1:], strict=True):
        belief, beliefs = filter_.predict(belief, u), tensors.predict(beliefs, u)
        (belief, _), (beliefs, _) = filter_.update(belief, seen), tensors.update(beliefs, seen)
    kept = {key: one for key, one in beliefs.extras.items() if key != "members"}
    assert list(kept) == KEPT[name]
    found = torch.cat([one.expand(2, *one.shape[1:]).reshape(2, -1) for one in kept.values()], -1)
    assert_same(found, np.array([belief.extras] * 2))


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("which", ["thruster", "pendulum", "affine"])
def test_estimates_of_a_users_filter_are_those_of_run(which):
    filter_ = Template(model=MODELS[which](), bandwidth=2.0)
    inputs, z = simulated(filter_.model, 12, count=3, level=1.0, missing=0.3)
    assert_same(filters.torch(filter_).run(inputs, z), run(filter_, None, inputs, z))


@pytest.mark.parametrize("name", ["ekf", "enkf"])
def test_estimates_are_those_of_compiled_code_over_many_steps(name):
    filter_ = made(name, thruster_model())
    inputs, z = simulated(filter_.model, 60, count=4, missing=0.2)
    assert_same(filters.torch(filter_).run(torch.tensor(inputs), torch.tensor(z)), run(filter_, None, inputs, z))


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("make", [two_channels, wide_pendulum])
@pytest.mark.parametrize("name", [*NAMES[1:], "ekf-robust", "sage-husa", "vb"])
def test_gradients_along_q_and_r_are_those_of_the_likelihood(name, make):
    model = make()
    inputs, z = simulated(model, 6, count=2, missing=0.3)
    expected = likelihood(model, inputs, z, *directions(model), filter=made(name, model))
    theta = torch.zeros(len(expected.gradients[0]), dtype=torch.float64, requires_grad=True)
    q, r = (
        torch.tensor(at) + torch.tensordot(theta, torch.tensor(slopes), 1)
        for at, slopes in zip(
            (model.process_noise_cov, model.measurement_noise_cov), directions(model), strict=True
        )
    )
    changed = filters.torch(made(name, model)).replace(process_noise_cov=q, measurement_noise_cov=r)
    for values in (changed.run(inputs, z).log_likelihoods.sum(-1), changed.log_likelihood(inputs, z)):
        np.testing.assert_allclose(values.detach(), expected.values, rtol=1e-11)
        gradients = np.array([torch.autograd.grad(one, theta, retain_graph=True)[0].numpy() for one in values])
        np.testing.assert_allclose(
            gradients, expected.gradients, rtol=1e-8, atol=1e-8 * abs(expected.gradients).max()
        )


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("name", [*NAMES[1:], "ekf-robust", "sage-husa", "vb"])
def test_everything_that_is_a_tensor_has_derivatives(name):
    model = wide_pendulum(start=0.5, spread=0.2)
    inputs, z = map(torch.tensor, simulated(model, 2, count=2, level=0.3))
    z[0, 1, 1] = math.nan
    plain = filters.torch(made(name, model))
    numbers = {key: getattr(plain, key) for key in ("prior_mean", "prior_cov", "constants", "process_noise_cov")}

    def score(u, seen, *values):
        values = (0.5 * (one + one.mT) if one.ndim == 2 else one for one in values)
        given = torch.where(torch.isnan(z), z, seen)
        found = plain.replace(**dict(zip(numbers, values, strict=True))).run(u, given)
        return found.log_likelihoods.sum(), found.means[:, -1], found.covs[:, -1]

    arguments = inputs, torch.nan_to_num(z), *numbers.values()
    assert torch.autograd.gradcheck(
        score, [one.clone().requires_grad_() for one in arguments], eps=1e-5, atol=1e-5, fast_mode=True
    )


@pytest.mark.usefixtures("as_python")
def test_numbers_may_differ_between_trajectories_and_batches_have_any_shape():
    model = wide_model()
    inputs, z = simulated(model, 6, count=6)
    factors = torch.arange(1.0, 7.0, dtype=torch.float64)[:, None, None]
    batch = filters.torch(made("ekf", model)).replace(
        process_noise_cov=factors * torch.tensor(model.process_noise_cov)
    )
    found = batch.run(inputs, z)
    for k in range(6):
        alone = made("ekf", model.replace(process_noise_cov=(k + 1) * model.process_noise_cov))
        expected = run(alone, None, inputs[k : k + 1], z[k : k + 1])
        assert_same([one[k] for one in found], [one[0] for one in expected])
        assert_same(filters.torch(alone).run(inputs[k], z[k]), [one[0] for one in expected])
    plain = filters.torch(made("ukf", model))
    grid, rows = plain.run(inputs.reshape(2, 3, 6, 2), z.reshape(2, 3, 7, 2)), plain.run(inputs, z)
    assert torch.equal(grid.covs.reshape(rows.covs.shape), rows.covs) and grid.divergences.shape == (2, 3)


class Drag(torch.nn.Module):
    """A network in place of a friction term."""

    def __init__(self):
        super().__init__()
        self.layers = torch.nn.Sequential(torch.nn.Linear(2, 3), torch.nn.Tanh(), torch.nn.Linear(3, 1)).double()

    def forward(self, x, u, c):
        angle, rate = whirl_of_tensors(x, u, c)
        return angle, rate + 0.1 * self.layers(torch.stack(x, -1))[..., 0]


def whirl_of_tensors(x, u, c):
    angle = x[0] + 0.1 * x[1]
    rate = x[1] - 0.1 * (c.stiffness * torch.sin(x[0]) + c.damping * x[1] - c.drive * u[0])
    return torch.atan2(torch.sin(angle), torch.cos(angle)), rate


def gaze_of_tensors(x, c):
    return torch.atan2(torch.sin(x[0]), torch.cos(x[0]) + 0.4), x[1] + c.offset + 0.3 * torch.cos(x[0])


def gaze_slopes_of_tensors(x, c):
    cosine = torch.cos(x[0])
    return ((1.0 + 0.4 * cosine) / (1.16 + 0.8 * cosine), 0.0), (-0.3 * torch.sin(x[0]), 1.0)


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("name", NAMES[1:])
def test_functions_of_tensors_are_differentiated_as_traced_ones_are(name):
    model = wide_pendulum()
    inputs, z = simulated(model, 12, count=3, missing=0.3)
    filter_ = made(name, model)
    expected = run(filter_, None, inputs, z)
    given = {"transition": whirl_of_tensors, "observe": gaze_of_tensors}
    with torch.no_grad():
        assert_same(filters.torch(filter_, **given).run(inputs, z), expected)
        assert_same(
            filters.torch(filter_, **given, observe_jacobian=gaze_slopes_of_tensors).run(inputs, z), expected
        )


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("name", [*NAMES[1:], "etkf"])
def test_a_network_in_a_model_has_a_gradient(name):
    torch.manual_seed(0)
    drag, model = Drag(), wide_pendulum(start=0.5, spread=0.2)
    inputs, z = simulated(model, 4, count=2, level=0.3)
    learning = filters.torch(made(name, model), transition=drag)

    def score():
        return learning.run(inputs, z).log_likelihoods.sum()

    score().backward()
    weights = drag.layers[0].weight
    for at in ((0, 0), (2, 1)):
        with torch.no_grad():
            sides = []
            for step in (1e-5, -2e-5):
                weights[at] += step
                sides.append(score())
            weights[at] += 1e-5
        assert float(weights.grad[at]) == pytest.approx(float(sides[0] - sides[1]) / 2e-5, rel=1e-6)


@pytest.mark.parametrize("name", ["ekf", "ukf", "kf-steady", "ekf-robust", "sage-husa", "vb", *ENSEMBLES])
def test_a_belief_that_is_lost_becomes_the_prior(name):
    filter_, inputs, z = diverging(name.split()[0])
    with interpreted(), np.errstate(all="ignore"):
        expected = run(filter_, None, inputs, z)
    found = filters.torch(filter_).run(inputs, z)
    assert found.divergences.tolist() == expected.divergences.tolist() != [0]
    assert_same(found, expected)


@pytest.mark.usefixtures("as_python")
def test_steps_are_those_of_the_filter():
    model = wide_model()
    filter_, (inputs, z) = made("ukf", model), simulated(model, 1, count=1)
    tensors = filters.torch(filter_)
    expected, of_expected = filter_.update(filter_.predict(filter_.init(), inputs[0, 0]), z[0, 1])
    found, of_found = tensors.update(tensors.predict(tensors.init(5), inputs[0, 0]), z[0, 1])
    assert found.mean.shape == (5, 3) and of_found.value.shape == (5, 2) and found.divergences.tolist() == [0] * 5
    assert_same([found.mean[4], found.cov[4]], [expected.mean, expected.cov])
    assert_same(of_found, [np.broadcast_to(one, (5, *np.shape(one))) for one in of_expected])


@pytest.mark.usefixtures("as_python")
def test_a_state_that_is_known_has_a_root():
    model = plane_model(process_noise_cov=[0.3, 0.0], prior_cov=[1.0, 0.0], a=[[0.9, 0.3], [0.0, 1.0]])
    inputs, z = simulated(model, 6)
    q = torch.tensor(model.process_noise_cov, requires_grad=True)
    for name in ("ukf", "ckf"):
        filter_ = made(name, model)
        found = filters.torch(filter_).replace(process_noise_cov=q).run(inputs, z)
        assert_same([one.detach() for one in found], run(filter_, None, inputs, z))
        slope = torch.autograd.grad(found.log_likelihoods.sum(), q)[0][0, 0]
        expected = likelihood(
            model, inputs, z, [np.diag([1.0, 0.0])], np.zeros((1, 2, 2)), filter=filter_
        ).gradients
        assert float(slope) == pytest.approx(expected[0, 0], rel=1e-8)


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("name", [*NAMES[1:], "ekf-robust", "sage-husa", "vb", *ENSEMBLES])
def test_single_precision_and_devices(name):
    at_rest = () if name in ENSEMBLES else (thruster_model(),)  # where a constant of 1e-200 matters
    for model in (wide_pendulum(), *at_rest):
        inputs, z = simulated(model, 20, count=3, missing=0.3)
        single = filters.torch(made(name, model), dtype=torch.float32, device="cpu").run(inputs, z)
        double = filters.torch(made(name, model), device=torch.device("cpu")).run(inputs, z)
        assert {one.dtype for one in single[:5]} == {torch.float32} and single.means.device.type == "cpu"
        assert_same([one.double() for one in single[:5]], [one.numpy() for one in double[:5]], 1e-3)
        assert not single.divergences.any()
        assert float((single.means.double() - double.means).abs().max()) > 1e-9


@pytest.mark.usefixtures("as_python")
def test_copies_and_pickles_go_on():
    model = wide_pendulum()
    inputs, z = simulated(model, 4, count=2)
    torch.manual_seed(0)
    changed = {"process_noise_cov": 2.0 * torch.tensor(model.process_noise_cov)}
    first = filters.torch(made("ukf", model), transition=Drag()).replace(**changed)
    with torch.no_grad():
        expected = first.run(inputs, z)
        for other in (copy.copy(first), copy.deepcopy(first), pickle.loads(pickle.dumps(first))):
            assert torch.equal(other.run(inputs, z).means, expected.means)
            assert torch.equal(other.process_noise_cov, changed["process_noise_cov"])


def if_fast(x, u, c):
    return (x[0] + u[0] if x[0] > 0.0 else x[0],)


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: filters.torch(make_filter("pf", scalar_model())),
            "on tensors must have a page without resampling, as 'ekf' and 'enkf' have, but got 'pf'",
        ),
        (lambda: filters.torch(made("ekf", scalar_model()), dtype=torch.int64), "torch.float64 or torch.float32"),
        (lambda: filters.torch(made("kf", thruster_model()), transition=if_fast), "a filter on the model itself"),
        (lambda: filters.torch(made("ekf", scalar_model()), observe_jacobian=if_fast), "must come with observe"),
        (lambda: plain().replace(q=1.0), "must be one of process_noise_cov, "),
        (
            lambda: plain().replace(process_noise_cov=torch.eye(2)),
            r"process_noise_cov must have shape \(..., 1, 1\)",
        ),
        (lambda: plain().replace(prior_mean="x"), "prior_mean must be a tensor of numbers"),
        (lambda: plain().run(np.zeros((1, 3, 1)), np.zeros((1, 3, 1))), r"but got \(1, 3, 1\) and \(1, 3, 1\)"),
        (lambda: plain().run(np.zeros((1, 3, 1))), "measurements must be a tensor of numbers, but got None"),
        (lambda: plain().replace(prior_mean=[2.0]).log_likelihood(*DATA), "but got others: use run"),
        (lambda: deciding().run(np.zeros((2, 1, 1)), np.zeros((2, 2, 1))), "transition must accept tensors"),
    ],
)
def test_an_error_says_the_rule(make, message):
    refused(message, make)


DATA = np.zeros((1, 3, 1)), np.zeros((1, 4, 1))


def plain():
    return filters.torch(made("ekf", scalar_model()))


def truncated(x, u, c):
    return (x[0] + u[0] * int(x[0]),)


def deciding():
    model = state_space(truncated, lambda x, c: (x[0],), q=[0.1], r=[0.1], mean=[1.0], cov=[1.0], inputs=1)
    return filters.torch(made("ekf", model))


@pytest.mark.usefixtures("as_python")
def test_a_lost_trajectory_restarts_where_that_is_asked_once_a_run(monkeypatch):
    """As on a GPU: the run without restarts is repeated with them."""
    filter_, inputs, z = diverging("ekf")
    expected = filters.torch(filter_).run(inputs, z)
    monkeypatch.setattr("filters.tensors.filter.SYNCHRONOUS", set())
    assert expected.divergences.any()
    assert_same(filters.torch(filter_).run(inputs, z), [part.numpy() for part in expected])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ekf", "enkf"])
def test_compiled_steps_have_the_estimates_and_gradients_of_others(name):
    filter_ = made(name, scalar_model())
    inputs, z = simulated(filter_.model, 3, count=3, missing=0.3)
    results = []
    for compiled in (False, True):
        tensors = filters.torch(filter_, compiled=compiled)
        q = tensors.process_noise_cov.clone().requires_grad_()
        estimates = tensors.replace(process_noise_cov=q).run(inputs, z)
        (gradient,) = torch.autograd.grad(estimates.log_likelihoods.sum(), q)
        results.append([*(part.detach().numpy() for part in estimates), gradient.numpy()])
    assert_same(*results)


def test_only_functions_that_can_be_traced_are_compiled():
    def drift(x, u, c):
        return (torch.tanh(x[0]),)

    with pytest.raises(ValueError, match="compiled=True must go with a model whose functions can be traced"):
        filters.torch(made("ekf", scalar_model()), transition=drift, compiled=True)


torch = pytest.importorskip("torch")
COLUMN = np.array([0.3, 1.1, 0.4, 0.9])[None, :, None]
TABLE = [0.5, 0.9]


def model_of(transition):
    return state_space(
        transition, lambda x, c: (x[0],), q=[0.1, 0.1], r=[0.1], mean=[0.3, 0.2], cov=[1.0, 1.0], inputs=0
    )


def rounds(x, u, c):
    k = 0.0
    while x[0] > k:
        k += 1.0
    return math.exp(-0.1 * x[0]) + 0.01 * k, x[1]


def looks_up(x, u, c):
    return TABLE[int(x[1] > 0)] * x[0], x[1]


def interpolates(x, u, c):
    return np.interp(x[0], [0.0, 1.0], [0.0, 1.0], period=2.0), x[1]


@pytest.mark.parametrize("function", [rounds, looks_up, interpolates])
@pytest.mark.parametrize("count", [1, 2])
def test_a_function_that_asks_a_tensor_for_a_number_is_refused(function, count):
    filter_ = filters.torch(make_filter("ekf", model_of(function)))
    for _ in range(2):  # the second time, too
        with pytest.raises(ValueError, match=r"transition must accept tensors[^\n]*asked for one number"):
            filter_.run(None, np.repeat(COLUMN, count, axis=0))


def exponential(x, u, c):
    return (math.exp(-0.1 * x[0]) if x[0] > -50.0 else x[0]), 0.5 * sum([x[0] > 0.5, x[1] > 0.1, x[0] > 0.2])


@pytest.mark.parametrize("count", [1, 2])
def test_branches_and_functions_of_math_have_their_numbers_and_derivatives(count, as_python):
    filter_ = make_filter("ekf", model_of(exponential))
    expected = run(filter_, filter_keys([0]), np.zeros((1, 3, 0)), COLUMN)
    found = filters.torch(filter_).run(None, np.repeat(COLUMN, count, axis=0))
    np.testing.assert_allclose(found.means, np.repeat(expected.means, count, axis=0), rtol=1e-12)
    assert found.means.dtype is torch.float64


@pytest.mark.parametrize("count", [1, 2])
def test_a_given_function_may_not_ask_either_but_may_leave_torch(count):
    filter_ = make_filter("ekf", model_of(exponential))
    asking = filters.torch(filter_, transition=lambda x, u, c: (math.exp(-0.1 * x[0]), x[1]))
    refused("asked for one number", asking.run, None, np.repeat(COLUMN, count, axis=0))
    given = filters.torch(filter_, transition=lambda x, u, c: (torch.exp(-0.1 * x[0]), x[1]))
    assert given.run(None, np.repeat(COLUMN, count, axis=0)).means.isfinite().all()


def test_a_sum_of_comparisons_that_tensors_have_otherwise_is_refused():
    def f(x, u, c):
        kinds = {0: 0.5}
        return kinds[0 if len(str(type(x[0]))) else 1] * x[0], ((x[0] > 0.5) + (x[1] > 0.5)) * hash_free(x[1])

    def hash_free(value):
        return {value: 1.0}[value]  # which keeps it from being traced

    with pytest.raises(ValueError, match="a sum of comparisons is no number"):
        filters.torch(make_filter("ekf", model_of(f))).run(None, COLUMN)
