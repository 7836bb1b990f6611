"""Problems whose truth turns: simulation, errors on the tangent, their bound, and logs with a quaternion."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation as Turned

import filters
import tuning
from filters.bounds import posterior_bound
from filters.inertial import attitude, attitude_imu
from filters.registry import make_filter
from thruster_env.core.streams import episode_keys
from thruster_env.env.model_env import ModelEnv
from thruster_env.logs.read import read_log
from thruster_env.model import rotations
from thruster_env.model.simulate import simulate
from thruster_env.model.turns import Rotation
from tuning.evaluation.evaluate import check_consistency, evaluate
from tuning.logs.problem import log_problem, of_gyroscope
from tuning.plants.auv import SCENARIOS as VEHICLES
from tuning.problems.check import checked_problem
from tuning.problems.find import read_scenario
from tuning.problems.model_problem import ModelProblem, log_of

DT, UP, NORTH = 0.1, (0.0, 0.0, 1.0), (0.0, 0.6, -0.8)
SCALE = (0.02, 0.013, 0.013, 0.006, 0.005, 0.006)


def turn(x, u, c):
    q, bias = x[:4], x[4:]
    angles = tuple((u[i] - bias[i]) * DT for i in range(3))
    return *rotations.product(q, rotations.exponential(angles)), *bias


def look(x, c):
    return *rotations.to_body(x[:4], UP), *rotations.to_body(x[:4], NORTH)


def turning(side="body"):
    return filters.StateSpaceModel(
        transition=turn,
        observe=look,
        states=(Rotation("attitude", side=side), "b_x", "b_y", "b_z"),
        inputs=3,
        prior_mean=[1.0] + [0.0] * 6,
        prior_cov=[np.deg2rad(5.0) ** 2] * 3 + [0.02**2] * 3,
        process_noise_cov=[0.01**2 * DT] * 3 + [0.001**2 * DT] * 3,
        measurement_noise_cov=[0.05**2] * 6,
    )


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
        covs = filters.run(
            make_filter("ekf", model), inputs=np.repeat(u, 20, 0), measurements=truth.measurements
        ).covs
        np.testing.assert_allclose(np.diag(bound), np.diag(covs[:, -1].mean(0)), rtol=0.1)


@pytest.mark.slow
def test_a_study_of_what_turns(undrawn, tmp_path):
    study = tuning.tune(problem(), filter="ekf", method="gradient", out=tmp_path / "tuned.json")
    comparison = (
        study.result.held_out.comparison if hasattr(study.result, "held_out") else study.held_out.comparison
    )
    assert comparison.tuned.score.value < 1.02 * comparison.true.score.value
    tuning.report(str(tmp_path / "tuned.json"), problem=problem(), out=tmp_path / "report")
    assert "q_angle" in (tmp_path / "report" / "tuned.html").read_text(encoding="utf-8")


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
    return evaluate(
        make_filter("ekf", scenario.model(**scenario.true)), scenario.data(range(runs)), scenario.scale
    )


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
    with pytest.raises(ValueError, match="sensors must be one of"):
        scenario.replace(attitude="euler").data([0])
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
