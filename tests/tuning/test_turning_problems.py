"""Problems whose truth or measurements turn: errors, R, innovations and likelihood in the tangent."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation as Turned

import filters
import tuning
from filters.bounds import posterior_bound
from filters.inertial import attitude, attitude_imu
from filters.logs.estimate import estimate_with
from filters.logs.findings import alarms_of
from filters.monitoring import Monitor
from filters.registry import make_filter
from tests.filters.checks import refused
from tests.models import state_space
from thruster_env.core.streams import episode_keys
from thruster_env.env.model_env import ModelEnv
from thruster_env.logs.read import read_log
from thruster_env.model import rotations
from thruster_env.model.quantities import Quantity
from thruster_env.model.simulate import simulate
from thruster_env.model.turns import Rotation
from tuning.evaluation.evaluate import check_consistency, evaluate
from tuning.evaluation.residuals import residuals
from tuning.likelihood.identify import identify, validate
from tuning.likelihood.recorded import of_changed
from tuning.logs.problem import log_problem, of_gyroscope
from tuning.plants.auv import SCENARIOS as VEHICLES
from tuning.problems.check import checked_problem
from tuning.problems.find import read_scenario
from tuning.problems.model_problem import ModelProblem, log_of
from tuning.problems.problem import Parameter
from tuning.search.parameters import model_parameters

DT, UP, NORTH = 0.1, (0.0, 0.0, 1.0), (0.0, 0.6, -0.8)
SCALE = (0.02, 0.013, 0.013, 0.006, 0.005, 0.006)


def turn(x, u, c):
    q, bias = x[:4], x[4:]
    angles = tuple((u[i] - bias[i]) * DT for i in range(3))
    return *rotations.product(q, rotations.exponential(angles)), *bias


def look(x, c):
    return *rotations.to_body(x[:4], UP), *rotations.to_body(x[:4], NORTH)


BIASES = "b_x", "b_y", "b_z"
MEAN, PRIOR = [1.0] + [0.0] * 6, [np.deg2rad(5.0) ** 2] * 3 + [0.02**2] * 3


def turning(side="body"):
    noise = {"q": [0.01**2 * DT] * 3 + [0.001**2 * DT] * 3, "r": [0.05**2] * 6, "mean": MEAN, "cov": PRIOR}
    return state_space(turn, look, **noise, states=(Rotation("attitude", side=side), *BIASES), inputs=3)


def rates(seeds, steps):
    k = np.arange(steps)
    return np.repeat(np.stack([0.3 * np.sin(0.2 * k), 0.2 + 0.0 * k, 0.1 + 0.0 * k], -1)[None], len(seeds), 0)


def problem():
    return ModelProblem(turning(), inputs=rates, steps=80, dt=DT, name="turning", scale=SCALE)


def test_errors_are_on_the_tangent():
    """Against SciPy's rotations: errors of the body, their RMSE, the angle in degrees and the NEES."""
    data = checked_problem(problem()).data(range(40))
    ekf = make_filter("ekf", turning())
    evaluation = evaluate(ekf, data, SCALE)
    means, covs, *_ = filters.run(ekf, data.filter_keys, data.inputs, data.measurements)
    late = slice(data.first_scored, None)
    estimated, true = (Turned.from_quat(x[:, late, [1, 2, 3, 0]].reshape(-1, 4)) for x in (means, data.states))
    turned = (true.inv() * estimated).as_rotvec().reshape(40, -1, 3)
    errors = np.concatenate([turned, (means - data.states)[:, late, 4:]], -1)
    rmse = [interval.value for interval in evaluation.rmse]
    np.testing.assert_allclose(rmse, np.sqrt((errors**2).mean((0, 1))), rtol=1e-9)
    squares = np.einsum("bki,bki->bk", errors, np.linalg.solve(covs[:, late], errors[..., None])[..., 0])
    np.testing.assert_allclose(evaluation.nees.value, squares.mean(), rtol=1e-9)
    assert 5.0 < evaluation.nees.value < 7.0
    angle = np.rad2deg(np.sqrt((turned**2).sum(-1).mean()))
    assert evaluation.output_rmse["q_angle"].value == pytest.approx(angle, rel=1e-9)
    assert [state.short_label for state in evaluation.states[:4]] == ["q_1 [rad]", "q_2 [rad]", "q_3 [rad]", "b_x"]
    report = check_consistency(ekf, data, DT)
    np.testing.assert_allclose(report.nees.mean.value, evaluation.nees.value, rtol=1e-9)


def test_an_env_and_a_simulation_turn_alike():
    """The noise moves on the tangent: quaternions keep length 1, and steps from f(x) have the covariance Q."""
    model, u = turning("world"), rates(range(60), 50)
    truth = simulate(model, episode_keys(range(60)), u)
    q, expected = truth.states[..., :4], np.zeros((60, 50, 4))
    np.testing.assert_allclose((q**2).sum(-1), 1.0, rtol=1e-14)
    angles = (u - truth.states[:, :-1, 4:]) * DT
    step = np.stack(rotations.exponential(np.moveaxis(angles, -1, 0)))
    expected = np.stack(rotations.product(np.moveaxis(q[:, :-1], -1, 0), step))
    noise = rotations.logarithm(rotations.product(np.moveaxis(q[:, 1:], -1, 0), rotations.inverse(expected)))
    np.testing.assert_allclose(np.cov(np.reshape(noise, (3, -1))), 1e-5 * np.eye(3), atol=1e-6)
    env = ModelEnv(model, low=-1.0, high=1.0)
    _, info = env.reset(seed=7)
    for k in range(50):
        _, _, _, _, info = env.step(u[7, k])
    np.testing.assert_allclose(info["state"], truth.states[7, -1], atol=1e-11)
    np.testing.assert_allclose(info["measurement"], truth.measurements[7, -1], atol=1e-11)


def test_the_bound_of_small_errors():
    """Where errors are small it is about the covariance of the extended filter, on each side in its axes."""
    for side in ("body", "world"):
        model, u = turning(side), rates([0], 30)
        bound = posterior_bound(model, u, truths=20)[0, -1]
        truth = simulate(model, episode_keys(range(20)), np.repeat(u, 20, 0))
        ekf = make_filter("ekf", model)
        covs = filters.run(ekf, inputs=np.repeat(u, 20, 0), measurements=truth.measurements).covs
        np.testing.assert_allclose(np.diag(bound), np.diag(covs[:, -1].mean(0)), rtol=0.1)


def table(columns):
    """A second of an IMU that turns about z, with a quaternion under some names."""
    time = np.arange(100) / 100.0
    q = np.stack(rotations.exponential((0.0 * time, 0.0 * time, time)))
    wave = np.sin(7.0 * time)
    motion = {f"{name}_{axis}": 0.01 * wave for name in ("gyr", "acc", "mag") for axis in "xyz"}
    return {"time": time, **motion, **columns(q)}


def test_quaternions_of_logs():
    """Names tell the order; lengths and signs are repaired in words, and numbers are not read."""

    def of_ros(q):
        sign = np.where(np.arange(100) < 60, 1.03, -1.03)
        return {f"orientation.{axis}": sign * q["wxyz".index(axis)] for axis in "xyzw"}

    log = read_log(table(of_ros), attitude())
    states = log.true_states(attitude())
    np.testing.assert_allclose(states[:, 3], np.sin(0.5 * log.times), atol=1e-12)
    said = " ".join(finding.sentence for finding in log.findings)
    assert "100 of 100 have a length of 1.03 to 1.03" in said
    assert "the sign changes 1 times" in said
    log = read_log(table(lambda q: {f"q{i}": q[i] for i in range(4)}), attitude())
    assert log.true_states(attitude()) is None
    assert "q0, q1, q2, q3 may be a quaternion" in " ".join(finding.sentence for finding in log.findings)
    with pytest.raises(ValueError, match="four columns, but there is none for q_z"):
        read_log(table(lambda q: {f"q_{axis}": q["wxyz".index(axis)] for axis in "wxy"}), attitude())
    with pytest.raises(ValueError, match=r"length 1, but its median is 3"):
        read_log(table(lambda q: {f"q_{axis}": 3.0 * q["wxyz".index(axis)] for axis in "wxyz"}), attitude())


def test_a_log_with_its_reference():
    """The error is an angle, for q and -q alike, and the truth of a problem is the quaternion alone."""
    columns = table(lambda q: {f"q_{axis}": -q["wxyz".index(axis)] for axis in "wxyz"})
    columns |= {
        "acc_z": 9.81 + columns["acc_x"],
        "mag_y": 25.0 + columns["mag_x"],
        "mag_z": columns["mag_x"] - 43.3,
    }
    columns |= {"gyr_z": 1.0 + columns["gyr_x"]}
    estimate = tuning.estimate(tuning.read_logs(columns, model="attitude"), filter="ekf")
    angle = next(r for r in estimate.findings.references if r.quantity.symbol == "q_angle")
    q = np.moveaxis(estimate.means[:, :4], -1, 0)
    off = Turned.from_quat(q[[1, 2, 3, 0]].T) * Turned.from_rotvec([[0, 0, t] for t in columns["time"]]).inv()
    first = estimate.findings.first
    assert angle.rmse == pytest.approx(np.rad2deg(np.sqrt((off.magnitude()[first:] ** 2).mean())), rel=1e-9)
    frame = estimate.to_frame()
    np.testing.assert_allclose(frame["yaw_deg"], np.rad2deg(rotations.euler(q)[2]), rtol=1e-12)
    assert "reference_yaw_deg" in frame
    assert "std_roll_deg" in frame


def test_without_a_magnetometer_yaw_is_not_measured():
    """Consistent over runs; at rest the deviation of yaw grows, and with it that of no other angle."""
    model = attitude_imu(dt=0.05, gyroscope=2e-3, acceleration=0.3)
    near = np.diag([0.1**2] * 2 + [0.01**2] + [0.3**2] * 6 + [0.02**2] * 3)
    model = model.replace(prior_cov=near)  # the model's own knows no tilt
    unmeasured = ModelProblem(model, inputs=rates, steps=120, first_scored_step=60, scale=[1.0] * 12)
    evaluation = evaluate(make_filter("ekf", model), unmeasured.data(range(40)), [1.0] * 12)
    assert 10.5 < evaluation.nees.value < 14.0
    still = {"inputs": np.zeros((400, 3)), "measurements": np.tile([0.0, 0.0, 9.81], (401, 1))}
    deviations = filters.run(make_filter("ekf", model), **still).stds
    assert (np.diff(deviations[:, 2]) > 0.0).all()
    assert (deviations[-1, :2] < 0.02).all()
    columns = table(lambda q: {})
    log = tuning.read_logs(columns | {"acc_z": 9.81 + columns["acc_x"]}, model="attitude-imu")
    words = " ".join(tuning.estimate(log, filter="ekf").sentences())
    assert "The deviation of yaw grows from 0." in words


def test_the_trap_of_a_free_gyroscope():
    """Where the motion is the model's innovations are white; of another frequency they are not, which is said."""
    model = attitude(dt=0.05, frequency=2.0)
    model = model.replace(prior_cov=np.diag([0.05**2] * 3 + [0.001**2] * 3 + [1.0] * 6))
    u = rates([0], 1500)
    drawn = simulate(model, episode_keys([3]), u)
    log = log_of((u[0], drawn.measurements[0]), model, 0.05)
    assert of_gyroscope(["gyroscope", "dip"], model, [log]) == []
    wrong = attitude(dt=0.05, frequency=0.3)
    assert of_gyroscope(["dip"], wrong, [log]) == []
    (sentence,) = of_gyroscope(["gyroscope", "dip"], wrong, [log])
    assert sentence.startswith("Beware of gyroscope: innovations of acc_")


def of_oracle(scenario, runs):
    """The EKF that knows Q and R, on the seeds 0, 1, ..."""
    ekf = make_filter("ekf", scenario.model(**scenario.true))
    return evaluate(ekf, scenario.data(range(runs)), scenario.scale)


def test_the_vehicle_loops_in_a_scenario():
    """Its nose points up, then it lies on its back; the filter is consistent, near the bound along the path."""
    scenario = VEHICLES["auv:loop"].replace(steps=180)
    data = scenario.data(range(12))
    q = np.moveaxis(data.states[..., 6:10], -1, 0)
    assert (rotations.to_world(q, (1.0, 0.0, 0.0))[2].min(axis=1) < -0.99).all()
    assert (rotations.to_world(q, UP)[2].min(axis=1) < -0.2).all()
    evaluation = of_oracle(scenario, 12)
    assert 10.0 < evaluation.nees.value < 14.5
    rmse = [interval.value for interval in evaluation.rmse]
    np.testing.assert_allclose(rmse[:6], scenario.bound(data)[:6], rtol=0.12)
    refused("sensors must be one of", scenario.replace(attitude="euler").data, [0])
    with pytest.raises(ValueError, match="states of an attitude 'quaternion' must be one of motion, navigation"):
        scenario.replace(states="current")


@pytest.mark.slow
def test_both_forms_of_the_vehicle_have_the_same_errors(tmp_path):
    """On the same seeds, where pitch stays small: attitude, NEES and NIS; a file's scale is of nine errors."""
    base = 'plant = "auv"\nbase = "auv:motion"\nattitude = "quaternion"\n'
    (tmp_path / "turning.toml").write_text(base + "steps = 150\nfirst_scored_step = 50\n")
    assert len(read_scenario(tmp_path / "turning.toml").scale) == 9
    euler = VEHICLES["auv:navigation"].replace(steps=300)
    first, second = (of_oracle(euler.replace(attitude=attitude), 12) for attitude in ("euler", "quaternion"))
    pairs = [(part.nees.value, part.nis.value, part.output_rmse["U"].value) for part in (first, second)]
    np.testing.assert_allclose(*pairs, rtol=3e-3)
    angles = np.rad2deg(np.sqrt(sum(interval.value**2 for interval in first.rmse[6:9])))
    assert second.output_rmse["q_angle"].value == pytest.approx(angles, rel=0.02)


def test_a_quaternion_alone_is_no_truth_of_a_pose():
    """A study says that it is not used, and `estimate` states the errors of its angles."""
    columns = table(lambda q: {f"q_{axis}": q["wxyz".index(axis)] for axis in "wxyz"})
    columns |= {"acc_z": 9.81 + columns["acc_x"]}
    (sentence,) = [text for text in log_problem(columns, model="attitude-imu").remarks if "reference" in text]
    assert sentence.startswith("The reference of 'attitude' is not used: an error of this state needs o_e, o_n, ")
    estimate = tuning.estimate(tuning.read_logs(columns, model="attitude-imu"), filter="ekf")
    assert {"roll", "pitch", "yaw", "q_angle"} == {r.quantity.symbol for r in estimate.findings.references}
    used = log_problem(columns, model="attitude")
    assert not any("reference" in text for text in used.remarks)


SENSOR = np.array([0.01, 0.02, 0.05])  # rad, about the axes of the camera
Q, R = 0.01**2 * DT, 0.05**2
TRACKED_SCALE = (0.005, 0.008, 0.014, 0.005, 0.005, 0.005)


def tracker(q=Q, r=R, side="body", across=SENSOR[:2]):
    """Attitude, a bias of the gyroscope, and a star tracker with deviations `across` its third axis."""
    noise = {"q": [Q, Q, q] + [0.001**2 * DT] * 3, "r": [*np.square(across), r], "mean": MEAN, "cov": PRIOR}
    quantities = {"states": (Rotation("attitude"), *BIASES)}
    quantities["measurements"] = (Rotation("star tracker", "s", side),)
    return state_space(turn, lambda x, c: x[:4], **noise, **quantities, inputs=3)


def about_z(q=Q, r=R):
    """The same of an angle."""
    yaw, tracked = (Quantity(*name, "rad", angle=True) for name in (("yaw", "yaw"), ("tracked yaw", "s")))
    noise = {"q": [q, 0.001**2 * DT], "r": [r], "mean": [0.0, 0.0], "cov": [PRIOR[0], 0.02**2]}
    functions = (lambda x, u, c: (x[0] + (u[0] - x[1]) * DT, x[1])), (lambda x, c: (x[0],))
    return state_space(*functions, **noise, states=(yaw, "b_z"), measurements=(tracked,))


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
    both = zip(
        (about_z(), tracker()),
        ({"inputs": log.inputs, "measurements": log.measurements} for log in runs),
        strict=True,
    )
    angle, turned = (filters.run(make_filter("ekf", model), **log) for model, log in both)
    np.testing.assert_allclose(turned.innovations[:, 2], angle.innovations[:, 0], atol=1e-9)
    S = turned.innovation_covs
    np.testing.assert_allclose(S[:, 2, 2], angle.innovation_covs[:, 0, 0], rtol=1e-9)
    np.testing.assert_allclose(S[:, 2, :2], 0.0, atol=1e-12)
    rest = 0.5 * np.linalg.slogdet(2.0 * np.pi * S[:, :2, :2])[1]
    np.testing.assert_allclose(turned.log_likelihoods + rest, angle.log_likelihoods, atol=1e-9)


def tracked_problem(side="body"):
    return ModelProblem(tracker(side=side), inputs=rates, steps=80, dt=DT, name="tracked", scale=TRACKED_SCALE)


@pytest.mark.parametrize("side", ["body", "world"])
def test_a_simulated_study_is_consistent(side):
    """NEES, NIS and whiteness of the truth's own filter, and residuals of the truth with the covariance R."""
    tracked = tracked_problem(side)
    data, ekf = tracked.data(range(200)), make_filter("ekf", tracker(side=side))
    evaluation = evaluate(ekf, data, TRACKED_SCALE)
    assert evaluation.channels == 3
    assert evaluation.expected_nis == 3.0
    assert 2.85 < evaluation.nis.value < 3.15
    assert 5.3 < evaluation.nees.value < 6.7
    v = residuals(tracked.model(), data).measurement
    deviations = np.sqrt([*SENSOR[:2] ** 2, R])
    np.testing.assert_allclose(np.cov((v / deviations).T), np.eye(3), atol=0.08)
    late = (values[:, data.late, :4].reshape(-1, 4) for values in (data.states, data.measurements))
    x, z = (Turned.from_quat(values, scalar_first=True) for values in late)
    error = (x.inv() * z if side == "body" else z * x.inv()).as_rotvec()
    np.testing.assert_allclose(v, error, atol=1e-12)
    report = check_consistency(ekf, tracked.data(range(20)), DT)
    assert report.whiteness.correlations.shape[1:] == (3, 3)
    assert np.abs(report.whiteness.correlations).max() < 0.2


def test_signs_and_missing_numbers():
    """-q changes no metric; a quaternion without one number is not measured."""
    tracked = tracked_problem()
    data, ekf = tracked.data(range(4)), make_filter("ekf", tracker())
    flipped = data._replace(measurements=data.measurements * np.where(np.arange(81) % 2, 1.0, -1.0)[:, None])
    first, second = (evaluate(ekf, part, TRACKED_SCALE) for part in (data, flipped))
    np.testing.assert_allclose(second.log_likelihoods, first.log_likelihoods, rtol=1e-12)
    gone, part = data.measurements.copy(), data.measurements.copy()
    gone[:, 60:70], part[:, 60:70, 3] = np.nan, np.nan
    first, second = (evaluate(ekf, data._replace(measurements=z), TRACKED_SCALE) for z in (gone, part))
    assert first.nis == second.nis
    assert second.expected_nis == 3.0


def test_parameters_are_of_the_tangent():
    """Three variances of R in rad^2, as Q has."""
    names = {parameter.name: parameter.unit for parameter in model_parameters(tracked_problem())}
    assert [name for name in names if name.startswith("R")] == ["R11", "R22", "R33"]
    assert names["R33"] == "rad^2"
    labels = [quantity.short_label for quantity in tracked_problem().innovations]
    assert labels == ["s_1 [rad]", "s_2 [rad]", "s_3 [rad]"]


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
    study = tuning.tune(tracked_problem(), filter="ekf", method="likelihood", out=file)
    comparison = study.held_out.comparison
    assert comparison.tuned.score.value < 1.03 * comparison.true.score.value
    assert tuning.verify(str(file), problem=tracked_problem())
    tuning.report(str(file), problem=tracked_problem(), out=tmp_path / "report")
    page = (tmp_path / "report" / "tuned.html").read_text(encoding="utf-8")
    assert "s_3" in page and "q_angle" in page
    tuning.compare(["ekf", "ukf"], problem=tracked_problem(), seeds=4)
