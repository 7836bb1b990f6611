"""Angles: a turn more or less changes nothing, and the cut at pi is a place like any other."""

import math
from contextlib import nullcontext
from functools import cache

import numpy as np
import pytest

from filters import FILTERS, StateSpaceModel, Unknown, augmented_model, make_filter, run, smooth
from filters.baselines import component_solver
from filters.consistency.report import consistency_report
from filters.ensembles.square_root import record_members
from filters.gaussian.blending import Parts, part_aligner
from filters.sensitivity import likelihood
from tests.models import affine, simulated, small
from thruster_env.core.angles import difference, row_aligner, wrapped, wrapped_where
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import filter_keys
from thruster_env.graphs.loops import Loops
from thruster_env.model.quantities import Quantity
from thruster_env.model.shape import observation_slopes, transition_slopes

DT = 0.1
RATE = Quantity("rate of turn", "r", "rad/s")
HEADING = Quantity("heading", "psi", "rad", True)
COMPASS = Quantity("compass", "z", "rad", True)
GYRO = Quantity("gyro", "g", "rad/s")
ON_AFFINE_MODELS = ("kf", "kf-steady", "fuzzy")
CLOSE = {"rtol": 1e-9, "atol": 1e-9}
STEPS = 25


def turned(angle):
    """An angle as many models give it: between -pi and pi."""
    return math.atan2(math.sin(angle), math.cos(angle))


def turn(x, u, c):
    rate = x[0] + DT * (u[0] - c[0] * x[0] * abs(x[0]))
    return (rate, x[1] + DT * rate)


def turn_and_wrap(x, u, c):
    rate, heading = turn(x, u, c)
    return (rate, turned(heading))


def sight(x, c):
    return (x[1] + 0.1 * x[0] * x[0], x[0])


def sight_and_wrap(x, c):
    return (turned(x[1] + 0.1 * x[0] * x[0]), x[0])


def turning(heading=0.0, angles=True, wraps=False, **changes):
    """A vehicle that turns, n = m = 2, with a compass and a gyro; its functions may wrap angles by themselves."""
    names = {"states": (RATE, HEADING), "measurements": (COMPASS, GYRO)} if angles else {}
    arguments = {
        "transition": turn_and_wrap if wraps else turn,
        "observe": sight_and_wrap if wraps else sight,
        "process_noise_cov": [[2e-3, 1e-4], [1e-4, 1e-3]],
        "measurement_noise_cov": [[0.04, 0.003], [0.003, 0.02]],
        "prior_mean": [0.2, heading],
        "prior_cov": [[0.05, 0.01], [0.01, 0.1]],
        "constants": (0.3,),
    }
    return StateSpaceModel(**{**arguments, **names, **changes})


def turntable(heading=0.0, angles=True):
    """The same, affine: n = 2, p = m = 1."""
    names = {"states": (RATE, HEADING), "measurements": (COMPASS,)} if angles else {}
    noise = {"q": [[2e-3, 1e-4], [1e-4, 1e-3]], "r": [0.04]}
    prior = {"mean": [0.2, heading], "cov": [[0.05, 0.01], [0.01, 0.1]]}
    return affine([[0.95, 0.0], [DT, 1.0]], [[DT], [0.0]], [[0.0, 1.0]], **noise, **prior, **names)


def data_of(model, seed=3):
    """Keys, inputs and measurements of two runs that stay within a quarter of a turn of the heading 0."""
    with interpreted():
        inputs, measurements = simulated(model, STEPS, count=2, seed=seed, level=0.5)
    measurements[0, 7] = measurements[1, 20:22, 0] = np.nan
    assert np.nanmax(np.abs(measurements[..., 0])) < 0.5 * math.pi
    return filter_keys(range(2)), inputs, measurements


@pytest.fixture(params=list(FILTERS))
def name(request):
    return request.param


def makers(name):
    """Models of a heading of 0 and of another one, for a filter."""
    if name in ON_AFFINE_MODELS:
        return turntable(), turntable(angles=False), turntable
    return turning(), turning(angles=False), lambda heading: turning(heading, wraps=True)


def rotated(measurements, angle, turns=0.0):
    """What the compass says of a scene that is rotated, channel 0, with whole turns added here and there."""
    found = measurements.copy()
    found[..., 0] = wrapped(found[..., 0] + angle) + 2 * math.pi * turns
    return found


def assert_rotated(found, reference, angle):
    """Estimates are those of another run, but for an angle in the heading, which lies in (-pi, pi]."""
    means = reference.means + [0.0, angle]
    assert (np.abs(found.means[..., 1]) <= math.pi).all()
    np.testing.assert_allclose(difference(found.means, means, (False, True)), 0.0, atol=1e-9)
    for one, other in zip(found[1:], reference[1:], strict=True):
        np.testing.assert_allclose(one, other, **CLOSE)


@cache
def plain_run(name):
    """Estimates of a filter that knows nothing of angles, far from the cut."""
    _, plain, _ = makers(name)
    with interpreted():
        return run(small(name, plain), *data_of(plain))


@pytest.mark.usefixtures("as_python")
class TestEveryFilter:
    def test_far_from_the_cut_an_angle_is_a_number(self, name):
        model, plain, _ = makers(name)
        assert_rotated(run(small(name, model), *data_of(plain)), plain_run(name), 0.0)

    def test_across_the_cut_it_errs_as_far_from_it(self, name):
        angle = math.pi - 0.2
        _, plain, make = makers(name)
        keys, inputs, measurements = data_of(plain)
        found = run(small(name, make(angle)), keys, inputs, rotated(measurements, angle))
        assert np.ptp(np.sign(found.means[..., 1])) == 2.0  # it did cross
        assert_rotated(found, plain_run(name), angle)

    def test_whole_turns_change_nothing(self, name):
        _, plain, make = makers(name)
        keys, inputs, measurements = data_of(plain)
        turns = np.random.default_rng(5).integers(-3, 4, size=measurements.shape[:2])
        found = run(small(name, make(2.9 - 4 * math.pi)), keys, inputs, rotated(measurements, 2.9, turns))
        assert_rotated(found, plain_run(name), 2.9)


def compare_rotated(filter_, other, angle, find):
    """What `find` makes of a filter far from the cut, and of another one across it, by the same scene."""
    keys, inputs, measurements = data_of(
        turning(angles=False) if filter_.model.m == 2 else turntable(angles=False)
    )
    return find(filter_, keys, inputs, measurements), find(other, keys, inputs, rotated(measurements, angle))


OTHERS = [
    ("kf", {"form": "information"}),
    ("kf", {"form": "square-root"}),
    ("fuzzy", {"blending": "moments"}),
    ("fuzzy", {"blending": "output"}),
    ("ienkf", {"ensemble_size": 12, "inflation": 1.1, "relaxation": 0.5}),
    ("ienkf", {"ensemble_size": 12, "inflation": 1.1, "window": 2}),
    ("etkf", {"ensemble_size": 12, "inflation": 1.1, "relaxation": 0.5}),
    ("ensrf", {"ensemble_size": 12, "rotations": 1}),
    ("pf", {"ensemble_size": 12, "proposal": "optimal"}),
    ("pf", {"ensemble_size": 12, "resampling": "gaussian"}),
    ("pf", {"ensemble_size": 12, "smoothed": [1], "regularisation": 0.5}),
    ("sage-husa", {"process_forgetting_factor": 0.9}),
]


@pytest.mark.parametrize(("name", "numbers"), OTHERS)
@pytest.mark.usefixtures("as_python")
def test_other_forms_of_filters_err_alike_across_the_cut(name, numbers):
    _, plain, make = makers(name)
    filters = (make_filter(name, model, **numbers) for model in (plain, make(3.0)))
    assert_rotated(*reversed(compare_rotated(*filters, 3.0, run)), 3.0)


def test_slopes_are_those_of_an_angle_at_the_cut():
    """Of functions that jump there, by central differences."""
    model = turning(wraps=True)
    x = (0.2, math.pi - 0.02)
    assert turn_and_wrap(x, (0.0,), (0.0,))[1] == pytest.approx(math.pi)
    found = transition_slopes(model.functions, model.shape)(x, (1.0, 1.0), (0.0,), (0.0,))
    np.testing.assert_allclose(found, [[1.0, 0.0], [DT, 1.0]], atol=1e-8)
    found = observation_slopes(model.functions, model.shape)((0.0, math.pi), (1.0, 1.0), (0.0,))
    np.testing.assert_allclose(found, [[0.0, 1.0], [1.0, 0.0]], atol=1e-8)


def test_slopes_along_a_joint_parameter_are_those_of_an_angle_at_the_cut():
    model = turning(
        observe=lambda x, c: (turned(x[1] + c[0]), x[0]),
        observe_jacobian=lambda x, c: ((0.0, 1.0), (1.0, 0.0)),
        transition=lambda x, u, c: (x[0], turned(x[1] + c[0])),
        transition_jacobian=lambda x, u, c: ((1.0, 0.0), (0.0, 1.0)),
    )
    joint = augmented_model(model, {0: Unknown(0.1)})
    x = (0.0, math.pi - 0.3, 0.3)
    np.testing.assert_allclose(joint.observe_jacobian(x, joint.constants)[0], [0.0, 1.0, 1.0], atol=1e-8)
    np.testing.assert_allclose(
        joint.transition_jacobian(x, (0.0,), joint.constants)[1], [0.0, 1.0, 1.0], atol=1e-8
    )


@pytest.mark.parametrize("name", ["kf", "ekf", "ukf", "ckf", "enkf", "etkf"])
@pytest.mark.parametrize("lag", [3, None])
@pytest.mark.usefixtures("as_python")
def test_smoothers_err_alike_across_the_cut(name, lag):
    _, plain, make = makers(name)

    def find(filter_, *data):
        return smooth(filter_, *data, lag=lag)

    reference, found = compare_rotated(small(name, plain), small(name, make(3.0)), 3.0, find)
    assert_rotated(found, reference, 3.0)


@pytest.mark.usefixtures("as_python")
def test_the_likelihood_and_its_slopes_are_alike_across_the_cut():
    _, plain, make = makers("ekf")
    keys, inputs, measurements = data_of(plain)
    slopes = np.array([plain.process_noise_cov, np.eye(2)]), np.array([plain.measurement_noise_cov, np.eye(2)])
    reference = likelihood(plain, inputs, measurements, *slopes)
    found = likelihood(make(3.0), inputs, rotated(measurements, 3.0), *slopes)
    np.testing.assert_allclose(found.values, reference.values, rtol=1e-9)
    np.testing.assert_allclose(found.gradients, reference.gradients, rtol=1e-4)  # of differences of differences
    estimates = run(make_filter("ekf", make(3.0)), keys, inputs, rotated(measurements, 3.0))
    np.testing.assert_allclose(found.values, estimates.log_likelihoods.sum(axis=1), rtol=1e-9)


@pytest.mark.usefixtures("as_python")
def test_joint_estimation_of_a_parameter_is_alike_across_the_cut():
    filters = (
        make_filter("ekf", augmented_model(model, {0: Unknown(0.1, 0.01)}))
        for model in (turning(angles=False), turning(3.0, wraps=True))
    )
    reference, found = compare_rotated(*filters, 3.0, run)
    flags = (False, True, False)
    np.testing.assert_allclose(
        difference(found.means, reference.means + [0.0, 3.0, 0.0], flags), 0.0, atol=1e-8, rtol=0.0
    )


def test_compiled_and_interpreted_agree_across_the_cut():
    keys, inputs, measurements = data_of(turntable(angles=False))
    filter_, measurements = make_filter("ckf", turntable(3.0)), rotated(measurements, 3.0)
    compiled_run = run(filter_, keys, inputs, measurements)
    with interpreted():
        as_python = run(filter_, keys, inputs, measurements)
    assert_rotated(compiled_run, as_python, 0.0)


def of_columns(table, size):
    """A table (rows, size) on one branch, its last row weights."""
    Loops(align_columns)(table, size)
    return table


def of_parts(table, size):
    """The same as a mixture of as many parts."""
    row = np.concatenate((table.T.ravel(), table[2]))
    Loops(align_parts)(row, 3 * size)
    return row[: 3 * size].reshape(size, 3).T


align_columns = row_aligner(0, (False, True), 2)
align_parts = part_aligner(Parts(0, 3, 50), 0, (False, True))


@pytest.mark.parametrize("compiling", [True, False])
def test_a_sample_is_put_on_the_branch_of_its_weighted_circular_mean(compiling):
    rng = np.random.default_rng(0)
    angles, weights = 3.0 + rng.normal(scale=0.8, size=50), rng.random(50)
    table = np.array([angles, wrapped(angles), weights])
    with nullcontext() if compiling else interpreted():
        for found in (of_columns(table.copy(), 50), of_parts(table, 50)):
            np.testing.assert_array_equal(found[[0, 2]], table[[0, 2]])  # no angle, and the weights
            np.testing.assert_allclose(wrapped(found[1] - angles), 0.0, atol=1e-14)
            middle = np.angle(weights @ np.exp(1j * angles))
            assert (np.abs(found[1] - middle) <= math.pi).all() and np.ptp(found[1]) < 2 * math.pi
            assert np.ptp(found[1] - angles) < 1e-12  # all within half a turn of 3 they stay together


@pytest.mark.parametrize(("name", "numbers"), [("pf", {"ensemble_size": 4000}), ("gsf", {"parts": 41})])
@pytest.mark.usefixtures("as_python")
def test_weights_decide_where_the_mean_is(name, numbers):
    """Nearly all weight lies opposite to where the belief was on average, on both sides of the cut there."""
    model = turning(prior_cov=[1e-4, 4.0], measurement_noise_cov=[0.04, 1.0])
    filter_ = make_filter(name, model, **numbers)
    belief, _ = filter_.update(filter_.init((1, 2)), [3.1, 0.2])
    assert abs(difference(belief.mean, [0.2, 3.1], (False, True))[1]) < 0.05
    assert belief.cov[1, 1] == pytest.approx(0.04, rel=0.3)


@pytest.mark.usefixtures("as_python")
def test_consistency_is_judged_alike_across_the_cut():
    """The truth may be of any turn: it is errors that are wrapped."""
    flags = turning().shape.state_angles

    def find(filter_, *data):
        keys, inputs, measurements = data
        heading = filter_.model.prior_mean[1] + (10 * math.pi if filter_.model.shape.state_angles[1] else 0.0)
        states = np.tile([0.2, heading], (2, STEPS + 1, 1))
        members = record_members(filter_, *data, every=3)
        return consistency_report(run(filter_, *data), states, measurements, members=members, angles=flags)

    filters = (make_filter("enkf", model, ensemble_size=8) for model in (turning(angles=False), turning(3.0)))
    reference, found = compare_rotated(*filters, 3.0, find)
    assert found.nees.mean == pytest.approx(reference.nees.mean, rel=1e-9)
    assert found.nis.mean == pytest.approx(reference.nis.mean, rel=1e-9)
    np.testing.assert_allclose(found.whiteness.correlations, reference.whiteness.correlations, atol=1e-9)
    np.testing.assert_allclose(found.crps, reference.crps, rtol=1e-9)
    np.testing.assert_allclose(found.ensemble.crps, reference.ensemble.crps, rtol=1e-9)
    for one, other in zip(found.ensemble.ranks, reference.ensemble.ranks, strict=True):
        np.testing.assert_array_equal(one.frequencies, other.frequencies)


def test_the_jump_of_a_measured_angle_is_not_taken_for_a_root():
    """From heading 0 a bearing of 3 is met at 3, though h - z changes its sign, by a jump, at 3 - pi."""
    solve = component_solver(sight, 2, 1, 0, True)
    assert solve((0.0, 0.0), 3.0, (), 4.0) == pytest.approx((0.0, 3.0))
    assert component_solver(sight_and_wrap, 2, 1, 0, True)((0.0, 0.0), 3.0, (), 4.0) == pytest.approx((0.0, 3.0))


def test_differences_of_angles_go_the_short_way_round():
    values = np.array([math.pi, -math.pi, 3.2, -3.2, 0.5, 2 * math.pi, 7 * math.pi])
    found = wrapped(values)
    expected = [math.pi, math.pi, 3.2 - 2 * math.pi, 2 * math.pi - 3.2, 0.5, 0.0, math.pi]
    np.testing.assert_allclose(found, expected, atol=1e-14)
    assert found[0] == math.pi and found[4] == 0.5
    a, b = np.array([[3.0, 3.0]]), np.array([[-3.0, -3.0]])
    np.testing.assert_allclose(difference(a, b, (True, False)), [[6.0 - 2 * math.pi, 6.0]])
    assert wrapped_where(a, (False, False)) is a
