"""Problems whose measurements turn: R, innovations, likelihood and studies in the tangent of the measurement."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation as Turned

import filters
import tuning
from filters.logs.estimate import estimate_with
from filters.logs.findings import alarms_of
from filters.monitoring import Monitor
from filters.registry import make_filter
from tests.tuning.test_turning_problems import DT, rates, turn
from thruster_env.core.streams import episode_keys
from thruster_env.model.quantities import Quantity
from thruster_env.model.simulate import simulate
from thruster_env.model.turns import Rotation
from tuning.evaluation.evaluate import check_consistency, evaluate
from tuning.evaluation.residuals import residuals
from tuning.likelihood.identify import identify, validate
from tuning.likelihood.recorded import of_changed
from tuning.problems.model_problem import ModelProblem, log_of
from tuning.problems.problem import Parameter
from tuning.search.parameters import model_parameters

SENSOR = np.array([0.01, 0.02, 0.05])  # rad, about the axes of the camera
Q, R = 0.01**2 * DT, 0.05**2
SCALE = (0.005, 0.008, 0.014, 0.005, 0.005, 0.005)


def tracker(q=Q, r=R, side="body", across=SENSOR[:2]):
    """Attitude, a bias of the gyroscope, and a star tracker with deviations `across` its third axis."""
    return filters.StateSpaceModel(
        transition=turn,
        observe=lambda x, c: x[:4],
        states=(Rotation("attitude"), "b_x", "b_y", "b_z"),
        measurements=(Rotation("star tracker", "s", side),),
        inputs=3,
        prior_mean=[1.0] + [0.0] * 6,
        prior_cov=[np.deg2rad(5.0) ** 2] * 3 + [0.02**2] * 3,
        process_noise_cov=[Q, Q, q] + [0.001**2 * DT] * 3,
        measurement_noise_cov=[*np.square(across), r],
    )


def about_z(q=Q, r=R):
    """The same of an angle."""
    return filters.StateSpaceModel(
        transition=lambda x, u, c: (x[0] + (u[0] - x[1]) * DT, x[1]),
        observe=lambda x, c: (x[0],),
        states=(Quantity("yaw", "yaw", "rad", angle=True), "b_z"),
        measurements=(Quantity("tracked yaw", "s", "rad", angle=True),),
        inputs=1,
        prior_mean=[0.0, 0.0],
        prior_cov=[np.deg2rad(5.0) ** 2, 0.02**2],
        process_noise_cov=[q, 0.001**2 * DT],
        measurement_noise_cov=[r],
    )


def of_third_axis(q=Q, r=R):
    """The tracker without measurements of the two other axes, whose S would change a little with each turn."""
    return tracker(q, r, across=(1e3, 1e3))


def fixed_axis(model, flips=False):
    """A turn of more than a round about z with its noise, as a log of a model: four numbers, or the angle."""
    draw, steps = np.random.default_rng(4).normal, 300
    u = 0.4 + 0.2 * np.sin(0.1 * np.arange(steps))
    angle = np.concatenate([[0.0], np.cumsum((u + 0.01) * DT + Q**0.5 * draw(size=steps))])
    z, zero = angle + R**0.5 * draw(size=steps + 1), np.zeros((steps, 1))
    if model.m == 1:
        return log_of((u[:, None], z[:, None]), model, DT)
    half, sign = 0.5 * z, np.where(flips * (np.arange(steps + 1) % 3 > 0), -1.0, 1.0)
    q = sign[:, None] * np.stack([np.cos(half), 0.0 * half, 0.0 * half, np.sin(half)], -1)
    return log_of((np.hstack([zero, zero, u[:, None]]), q), model, DT)


FREE = [Parameter("q", 0.01 * Q, 100 * Q, default=3 * Q), Parameter("r", 0.01 * R, 100 * R, default=0.3 * R)]


@pytest.fixture(scope="module")
def of_angle():
    return identify(fixed_axis(about_z()), about_z, FREE, starts=1)


@pytest.mark.parametrize("flips", [False, True])
def test_about_one_axis_it_is_the_angle(of_angle, flips):
    """The objective of Q and R, its gradient and information, from the prior; q and -q are one measurement."""
    turned = identify(fixed_axis(of_third_axis(), flips), of_third_axis, FREE, starts=1)
    angle, turning = (of_changed(of.objective, starts=None) for of in (of_angle, turned))
    points = [turning.coordinates.of([q, r]) for q, r in ((Q, R), (3 * Q, 0.3 * R), (0.2 * Q, 2 * R))]
    first, second = ([of(point) for point in points] for of in (angle, turning))
    for a, b in zip(first, second, strict=True):
        np.testing.assert_allclose(b.gradient, a.gradient, rtol=1e-8, atol=1e-7)
        np.testing.assert_allclose(b.information, a.information, rtol=1e-8, atol=1e-7)
        assert b.value - second[0].value == pytest.approx(a.value - first[0].value, abs=1e-8)
    for name in ("q", "r"):  # a run of rotations begins at its first measurement and counts after its first rows
        assert turned.values[name] == pytest.approx(of_angle.values[name], rel=0.1)
    metrics = validate(turned)["identified"]
    assert list(metrics.one_step) == ["s_1", "s_2", "s_3"]
    assert metrics.one_step["s_1"] < 1e-9
    assert metrics.one_step["s_3"] == pytest.approx(validate(of_angle)["identified"].one_step["s"], rel=0.05)
    if flips:
        plain = identify(fixed_axis(of_third_axis()), of_third_axis, FREE, starts=1)
        assert [*turned.values.values()] == pytest.approx([*plain.values.values()], rel=1e-9)


def test_innovations_about_one_axis():
    """To 1e-9: innovations and NIS, and the log-likelihood but for the two other axes."""
    runs = [fixed_axis(model) for model in (about_z(), tracker())]
    angle, turned = (
        filters.run(make_filter("ekf", model), inputs=log.inputs, measurements=log.measurements)
        for model, log in zip((about_z(), tracker()), runs, strict=True)
    )
    np.testing.assert_allclose(turned.innovations[:, 2], angle.innovations[:, 0], atol=1e-9)
    S = turned.innovation_covs
    np.testing.assert_allclose(S[:, 2, 2], angle.innovation_covs[:, 0, 0], rtol=1e-9)
    np.testing.assert_allclose(S[:, 2, :2], 0.0, atol=1e-12)
    rest = 0.5 * np.linalg.slogdet(2.0 * np.pi * S[:, :2, :2])[1]
    np.testing.assert_allclose(turned.log_likelihoods + rest, angle.log_likelihoods, atol=1e-9)


def problem(side="body"):
    return ModelProblem(tracker(side=side), inputs=rates, steps=80, dt=DT, name="tracked", scale=SCALE)


@pytest.mark.parametrize("side", ["body", "world"])
def test_a_simulated_study_is_consistent(side):
    """NEES, NIS and whiteness of the truth's own filter, and residuals of the truth with the covariance R."""
    tracked = problem(side)
    data, ekf = tracked.data(range(200)), make_filter("ekf", tracker(side=side))
    evaluation = evaluate(ekf, data, SCALE)
    assert evaluation.channels == 3
    assert evaluation.expected_nis == 3.0
    assert 2.85 < evaluation.nis.value < 3.15
    assert 5.3 < evaluation.nees.value < 6.7
    v = residuals(tracked.model(), data).measurement
    deviations = np.sqrt([*SENSOR[:2] ** 2, R])
    np.testing.assert_allclose(np.cov((v / deviations).T), np.eye(3), atol=0.08)
    x, z = (
        Turned.from_quat(values[:, data.late, :4].reshape(-1, 4), scalar_first=True)
        for values in (data.states, data.measurements)
    )
    error = (x.inv() * z if side == "body" else z * x.inv()).as_rotvec()
    np.testing.assert_allclose(v, error, atol=1e-12)
    report = check_consistency(ekf, tracked.data(range(20)), DT)
    assert report.whiteness.correlations.shape[1:] == (3, 3)
    assert np.abs(report.whiteness.correlations).max() < 0.2


def test_signs_and_missing_numbers():
    """-q changes no metric; a quaternion without one number is not measured."""
    tracked = problem()
    data, ekf = tracked.data(range(4)), make_filter("ekf", tracker())
    flipped = data._replace(measurements=data.measurements * np.where(np.arange(81) % 2, 1.0, -1.0)[:, None])
    first, second = (evaluate(ekf, part, SCALE) for part in (data, flipped))
    np.testing.assert_allclose(second.log_likelihoods, first.log_likelihoods, rtol=1e-12)
    gone, part = data.measurements.copy(), data.measurements.copy()
    gone[:, 60:70], part[:, 60:70, 3] = np.nan, np.nan
    first, second = (evaluate(ekf, data._replace(measurements=z), SCALE) for z in (gone, part))
    assert first.nis == second.nis
    assert second.expected_nis == 3.0


def test_parameters_are_of_the_tangent():
    """Three variances of R in rad^2, as Q has."""
    names = {parameter.name: parameter.unit for parameter in model_parameters(problem())}
    assert [name for name in names if name.startswith("R")] == ["R11", "R22", "R33"]
    assert names["R33"] == "rad^2"
    assert [quantity.short_label for quantity in problem().innovations] == ["s_1 [rad]", "s_2 [rad]", "s_3 [rad]"]


def test_alarms_of_a_log():
    """A jump of the tracker about one axis is its alarm; a healthy log has none."""
    u = rates([0], 400)
    drawn = simulate(tracker(), episode_keys([5]), u)
    z = drawn.measurements[0]
    ekf, monitor = make_filter("ekf", tracker()), Monitor(steps_between=1e5)
    assert not alarms_of(estimate_with(ekf, log_of((u[0], z), tracker(), DT)), monitor).alarms
    jumped = Turned.from_quat(z[300:], scalar_first=True) * Turned.from_rotvec([0.0, 0.2, 0.0])
    z[300:] = jumped.as_quat(scalar_first=True)
    alarms = alarms_of(estimate_with(ekf, log_of((u[0], z), tracker(), DT)), monitor).alarms
    assert {alarm.channel for alarm in alarms} == {1}
    assert alarms[0].step == 300


@pytest.mark.slow
def test_a_study_of_a_measured_rotation(undrawn, tmp_path):
    file = tmp_path / "tuned.json"
    study = tuning.tune(problem(), filter="ekf", method="likelihood", out=file)
    comparison = study.held_out.comparison if hasattr(study, "held_out") else study.result.held_out.comparison
    assert comparison.tuned.score.value < 1.03 * comparison.true.score.value
    assert tuning.verify(str(file), problem=problem())
    tuning.report(str(file), problem=problem(), out=tmp_path / "report")
    page = (tmp_path / "report" / "tuned.html").read_text(encoding="utf-8")
    assert "s_3" in page
    tuning.compare(["ekf", "ukf"], problem=problem(), seeds=4)
