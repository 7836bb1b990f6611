"""The likelihood's gradient and information along parameters of a whole model: constants, noise and prior."""

import math
from typing import NamedTuple

import numpy as np
import pytest
from scipy.stats import multivariate_t, norm

from filters import ExtendedKalmanFilter, StateSpaceModel, affine_model, run
from filters.sensitivity import ModelSlopes, likelihood, sensitivity
from tests.filters.textbooks import extended_filter
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import episode_keys
from thruster_env.model import simulate
from thruster_env.model.quantities import Quantity
from thruster_env.thruster.model import thruster_model
from thruster_env.thruster.parameters import TUNNEL_PHYSICAL


class Constants(NamedTuple):
    """Of a pendulum whose angle wraps."""

    stiffness: float
    damping: float
    drive: float
    offset: float


def turn(x, u, c):
    """One step of 0.1 s."""
    return x[0] + 0.1 * x[1], x[1] - 0.1 * (c.stiffness * np.sin(x[0]) + c.damping * x[1] - c.drive * u[0])


def look(x, c):
    """The angle, and the rate with a bias."""
    return x[0], x[1] + c.offset


def pendulum(stiffness=9.0, damping=0.3, drive=2.0, offset=0.2, q=0.01, r=0.05, start=0.4, spread=0.2):
    return StateSpaceModel(
        transition=turn,
        observe=look,
        constants=Constants(stiffness, damping, drive, offset),
        process_noise_cov=[1e-4, q],
        measurement_noise_cov=[r, 2 * r],
        prior_mean=[start, 0.0],
        prior_cov=[spread, 0.1],
        states=[Quantity("angle", "a", "rad", angle=True), Quantity("rate", "w", "rad/s")],
        measurements=[Quantity("angle", "a", "rad", angle=True), Quantity("rate", "w", "rad/s")],
        analytic=True,
    )


def thruster(voltage_gain=1133.2, motor_damping=70.0, lift_coefficient=1.75, ambient_velocity=0.3, q=1.0, r=0.2):
    preset = TUNNEL_PHYSICAL._replace(
        voltage_gain=voltage_gain, motor_damping=motor_damping, lift_coefficient=lift_coefficient
    )
    noise = {"process_noise_cov": [q, 4e-4], "measurement_noise_cov": [r, 4 * r]}
    return thruster_model(
        preset=preset, ambient_velocity=ambient_velocity, substeps=4, sensors=["thrust", "speed"], **noise
    )


def ring(n, gain=0.8, turn=0.1, drive=0.3, offset=0.0, q=0.1, r=0.2, start=0.5):
    return affine_model(
        a=np.eye(n) * gain + np.roll(np.eye(n), 1, 0) * turn,
        b=np.full((n, 1), drive),
        c=np.eye(n)[::2] + 0.1,
        measurement_offset=np.full((n + 1) // 2, offset),
        process_noise_cov=np.full(n, q),
        measurement_noise_cov=np.full((n + 1) // 2, r),
        prior_mean=np.full(n, start),
        prior_cov=np.ones(n),
    )


FAMILIES = {
    "pendulum": (pendulum, dict(stiffness=9.0, damping=0.3, drive=2.0, offset=0.2, q=0.01, start=0.4, spread=0.2)),
    "thruster": (thruster, dict(voltage_gain=1133.2, lift_coefficient=1.75, ambient_velocity=0.3, r=0.2)),
    "eight": (lambda **v: ring(8, **v), dict(gain=0.8, turn=0.1, drive=0.3, offset=0.0, r=0.2, start=0.5)),
}


def slopes_of(make, values, sizes):
    """Central differences of a model along each value, counted in its size."""
    pairs = []
    for name, size in sizes.items():
        pairs.append([make(**{**values, name: values[name] + sign * 1e-4 * size}) for sign in (1, -1)])
    return ModelSlopes(
        *(
            np.array([(np.array(getattr(a, f)) - np.array(getattr(b, f))) / 2e-4 for a, b in pairs])
            for f in ModelSlopes._fields
        )
    )


def case(name, count=2, steps=40):
    make, values = FAMILIES[name]
    rng = np.random.default_rng(1)
    model = make(**values)
    inputs = rng.uniform(-10, 10, size=(count, steps, 1)) * (0.1 if name == "pendulum" else 1.0)
    measurements = simulate.simulate(model, episode_keys(range(count)), inputs).measurements
    measurements[0, 5, 0] = measurements[1, 0] = np.nan
    sizes = {one: abs(value) or 1.0 for one, value in values.items()}
    return make, values, sizes, inputs, measurements


@pytest.mark.parametrize("name", ["pendulum", "thruster", pytest.param("eight", marks=pytest.mark.slow)])
@pytest.mark.parametrize("degrees", [math.inf, 5.0])
def test_the_gradient_is_that_of_central_differences(name, degrees):
    make, values, sizes, inputs, measurements = case(name)
    found = sensitivity(make(**values), inputs, measurements, slopes_of(make, values, sizes), degrees=degrees)
    nothing = ModelSlopes(*(a[:0] for a in slopes_of(make, values, sizes)))

    def log_likelihoods(**changes):
        return sensitivity(make(**{**values, **changes}), inputs, measurements, nothing, degrees=degrees).values

    if degrees == math.inf:
        estimates = run(ExtendedKalmanFilter(model=make(**values)), episode_keys([0, 1]), inputs, measurements)
        np.testing.assert_allclose(found.values, estimates.log_likelihoods.sum(axis=1), rtol=1e-10)
    for j, (one, size) in enumerate(sizes.items()):
        above, below = (log_likelihoods(**{one: values[one] + sign * 2e-4 * size}) for sign in (1, -1))
        more, less = (log_likelihoods(**{one: values[one] + sign * 4e-4 * size}) for sign in (1, -1))
        slope = (8 * (above - below) - (more - less)) / (12 * 2e-4)
        np.testing.assert_allclose(found.gradients[:, j], slope, rtol=1e-6, atol=1e-6 * abs(slope).max())


def textbook(model, inputs, measurements):
    """Innovations and their covariances of an extended Kalman filter, channels that are NaN left out."""
    return list(zip(*extended_filter(model, inputs, measurements)[2:], strict=True))


@pytest.mark.parametrize("name", ["pendulum", "thruster"])
def test_values_and_information_are_those_of_a_textbook_recursion(name):
    make, values, sizes, inputs, measurements = case(name)
    found = sensitivity(make(**values), inputs, measurements, slopes_of(make, values, sizes))
    here = textbook(make(**values), inputs[0], measurements[0])
    normal = sum(-0.5 * (v @ np.linalg.solve(s, v) + np.linalg.slogdet(2 * np.pi * s)[1]) for v, s in here)
    assert found.values[0] == pytest.approx(normal, rel=1e-10)
    student = sum(multivariate_t(shape=s * 3 / 5, df=5).logpdf(v) for v, s in here if len(v))
    heavy = sensitivity(make(**values), inputs, measurements, slopes_of(make, values, sizes), degrees=5.0)
    assert heavy.values[0] == pytest.approx(student, rel=1e-10)
    sides = []
    for one, size in sizes.items():
        pair = [
            textbook(make(**{**values, one: values[one] + sign * 1e-5 * size}), inputs[0], measurements[0])
            for sign in (1, -1)
        ]
        sides.append([((a - c) / 2e-5, (b - d) / 2e-5) for (a, b), (c, d) in zip(*pair, strict=True)])
    expected = np.zeros((len(sizes),) * 2)
    for k, (_, s) in enumerate(here):
        for i, j in np.ndindex(*expected.shape):
            (dv, ds), (dw, dt) = sides[i][k], sides[j][k]
            expected[i, j] += dv @ np.linalg.solve(s, dw)
            expected[i, j] += 0.5 * np.trace(np.linalg.solve(s, ds) @ np.linalg.solve(s, dt))
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        found.information[0] / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-6
    )


@pytest.mark.parametrize("degrees", [math.inf, 5.0])
def test_a_predicted_channel_counts_but_corrects_nothing(degrees):
    make, values, sizes, inputs, measurements = case("pendulum")
    model, unseen = make(**values), measurements.copy()
    unseen[..., 1] = np.nan
    estimates = run(ExtendedKalmanFilter(model=model), episode_keys([0, 1]), inputs, unseen)
    errors = measurements[..., 1] - np.array(
        [[model.observe(x, model.constants)[1] for x in one] for one in estimates.means]
    )
    r = model.measurement_noise_cov[1, 1]
    density = multivariate_t(shape=r * 3 / 5, df=5) if degrees == 5.0 else norm(0.0, math.sqrt(r))
    expected = estimates.log_likelihoods.sum(axis=1)
    expected += [density.logpdf(one[~np.isnan(one)]).sum() for one in errors]
    options = {"degrees": degrees, "predicted": [False, True]}
    found = sensitivity(model, inputs, measurements, slopes_of(make, values, sizes), **options)
    np.testing.assert_allclose(found.values, expected, rtol=1e-10)
    nothing = ModelSlopes(*(a[:0] for a in slopes_of(make, values, sizes)))
    for j, (one, size) in enumerate(sizes.items()):
        steps = [2e-4 * size * factor for factor in (1, -1, 2, -2)]
        a, b, c, d = (
            sensitivity(
                make(**{**values, one: values[one] + step}), inputs, measurements, nothing, **options
            ).values
            for step in steps
        )
        slope = (8 * (a - b) - (c - d)) / (12 * 2e-4)
        np.testing.assert_allclose(found.gradients[:, j], slope, rtol=1e-6, atol=1e-6 * abs(slope).max())


def test_parameters_that_move_no_constants_have_the_gradient_of_the_noise_alone():
    make, values, sizes, inputs, measurements = case("thruster")
    slopes = slopes_of(make, values, {"r": 0.2})
    found = sensitivity(make(**values), inputs, measurements, slopes)
    noise = slopes.process_noise_cov, slopes.measurement_noise_cov
    alone = likelihood(make(**values), inputs, measurements, *noise)
    np.testing.assert_allclose(found.values, alone.values, rtol=1e-14)
    np.testing.assert_allclose(found.gradients, alone.gradients, rtol=1e-10)


def test_the_interpreted_sensitivity_is_the_compiled_one():
    make, values, sizes, inputs, measurements = case("pendulum", steps=15)
    arguments = make(**values), inputs, measurements, slopes_of(make, values, sizes)
    compiled = sensitivity(*arguments, degrees=4.0)
    with interpreted():
        plain = sensitivity(*arguments, degrees=4.0)
    for a, b in zip(compiled, plain, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * abs(b).max())


def test_shapes_and_degrees_that_do_not_fit_are_refused():
    make, values, sizes, inputs, measurements = case("pendulum")
    slopes = slopes_of(make, values, sizes)
    with pytest.raises(ValueError, match="prior_mean and prior_cov must have the shapes"):
        sensitivity(make(**values), inputs, measurements, slopes._replace(constants=slopes.constants[:, 1:]))
    with pytest.raises(ValueError, match="degrees of freedom must be above 2, but got 1.0"):
        sensitivity(make(**values), inputs, measurements, slopes, degrees=1.0)
    with pytest.raises(ValueError, match="predicted must be true or false for each of 2 channels"):
        sensitivity(make(**values), inputs, measurements, slopes, predicted=[True])
