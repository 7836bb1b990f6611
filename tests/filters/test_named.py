"""Models by name: settings, plants against their equations, logs of them, inertial navigation and heave."""

import math
import pickle

import gymnasium as gym
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import filters
from docs.scripts.attitude import errors, model_of, sea
from filters import plants
from filters.logs.findings import is_sparse
from filters.models import NAMED, named_model
from filters.named import axes_named, is_model_name, model_named, text_of
from filters.plants import pendulum
from filters.wrappers.arguments import model_for_step
from tests.filters.checks import refused
from tests.oracles import each_close, each_equal
from thruster_env.model import poses, rotations
from thruster_env.model.turns import difference
from tuning.logs.read import model_of_logs, read_named


@pytest.mark.parametrize(
    ("text", "values", "axes"),
    [
        ("constant-velocity", {}, 1),
        ("Constant-Velocity:axes=2, R=0.25", {"R": 0.25}, 2),
        ("oscillator:std=2 + ornstein-uhlenbeck:std=1e+3,time_constant=4", {}, 1),
        ("constant:drift=2e-3 + harmonic:period=24,harmonics=2", {"constant_drift": 2e-3}, 1),
    ],
)
def test_settings_are_numbers_of_the_model_its_axes_or_those_of_its_name(text, values, axes):
    maker = model_named(text)
    assert len(maker.quantities) == axes and set(maker.values) <= set(maker.names)
    assert {name: maker.values[name] for name in values} == values
    assert model_named(maker.name).names == maker.names


SUMS = "constant + harmonic", "constant + harmonic:period=86400,harmonics=2", "harmonic + ar:2", "ar:1 + harmonic"
SUMS += "constant-velocity + oscillator", "ornstein-uhlenbeck + oscillator", "oscillator + seasonal:period=12"


@pytest.mark.parametrize("name", [*NAMED, *SUMS, "ar:3", "harmonic", "seasonal:period=1.2e+01,seasons=12"])
def test_a_text_of_numbers_gives_the_model_of_these_numbers(name):
    model = named_model(name)
    values = {number.name: 1.234567e5 / 7.0**i for i, number in enumerate(model.free)}
    values |= {number.name: -0.4 for number in model.free if not number.log}
    values |= {"frequency": 1e-5} if "frequency" in values else {}
    text = text_of(name, {**values, "R": 2e-7}, 2, -3.5)
    expected = model.model(values, 2e-7, 1.0, offset=-3.5, quantities=axes_named("z", 2))
    assert is_model_name(text) and "e+" not in text.replace(name, "")
    model = model_named(text)(dt=1.0)
    each_close(model.matrices(), expected.matrices(), rtol=1e-5, atol=1e-9)
    q = expected.process_noise_cov
    np.testing.assert_allclose(model.process_noise_cov, q, rtol=1e-5, atol=1e-6 * np.abs(q).max())
    np.testing.assert_allclose(model.measurement_noise_cov, expected.measurement_noise_cov, rtol=1e-5)


def test_a_text_with_numbers_is_the_named_model_of_these():
    model = model_for_step("constant-velocity:axes=2,acceleration=0.04,R=0.25", 0.1)()
    axes = axes_named("z", 2)
    expected = named_model("constant-velocity").model({"acceleration": 0.04}, 0.25, 0.1, quantities=axes)
    for name in ("process_noise_cov", "measurement_noise_cov", "prior_cov", "constants"):
        np.testing.assert_array_equal(getattr(model, name), getattr(expected, name))
    swinging = model_for_step("pendulum:length=0.4", 0.01)(damping=0.2)
    assert swinging.digest == pendulum(length=0.4, damping=0.2).at(0.01).digest


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("constant:axes=0", "axes of constant must be positive"),
        ("constant:drift=x", "drift of constant must be"),
        ("constant-velocity:jerk=1", "a setting of constant-velocity must be one of acceleration, R"),
        ("pendulum:long=1", "a setting of pendulum must be one of length"),
        ("pendulum:length=", "length of pendulum must be a finite number"),
        ("pendulum:length=1,length=2", "KEY=VALUE, each once"),
        ("constant:drift=1,drift=2", "settings of constant must be KEY=VALUE, each once"),
        ("constant:R=1 + oscillator:R=2", "each once, but got 'R=2' again"),
        ("harmonic:period=24,period=12", "may have period=SECONDS"),
        ("oscillator:axes=2,mean_1=3", "one for each axis, mean_1, mean_2, or one for all"),
    ],
)
def test_a_wrong_setting_is_named_with_those_that_are_right(text, message):
    refused(message, model_named, text)


@pytest.mark.parametrize("text", ["oscillator:frequency=1,damping=0.1", "ornstein-uhlenbeck:time_constant=3"])
def test_a_signal_about_a_mean_begins_there_with_its_stationary_covariance(text):
    model = model_named(f"{text},std=2,R=1,axes=2,mean_1=100,mean_2=-300")(dt=0.1)
    each_equal((model.prior_mean, model.matrices()[4]), (np.zeros(model.n), [100.0, -300.0]))
    for order in ("ornstein-uhlenbeck + constant", "constant + ornstein-uhlenbeck"):
        values = {"drift": 0.1, "time_constant": 3.0, "std": 2.0}
        model = named_model(order).model(values, 1.0, 0.1, first=1000.0, spread=5.0)
        of = {state.symbol: i for i, state in enumerate(model.states)}
        assert model.prior_mean[of["level"]] == 1000.0 and model.prior_mean[of["deviation"]] == 0.0
        assert model.prior_cov[of["deviation"], of["deviation"]] == pytest.approx(4.0)
    with pytest.raises(ValueError, match="partial_1 must be between -1 and 1, but got 1.5"):
        named_model("ar:1").model({"partial_1": 1.5, "std": 1.0}, 1.0, 1.0)


def test_every_cosine_of_a_season_has_the_same_noise_and_its_rows_are_a_season_apart():
    signal = named_model("seasonal:period=12,seasons=4").signal({"drift": 0.3})
    noise = np.diag(signal.noise(3.0))
    assert noise[[0, 1, 2]] == pytest.approx(0.9)
    with pytest.raises(ValueError, match="must be 3 s apart, or multiples, .* but got 1 s: harmonic:per"):
        named_model("seasonal:period=12,seasons=4").model({"drift": 0.3}, 1.0, 1.0)
    days = np.array([31.0, 28.0, 31.0, 30.0, 59.0])
    named_model(f"seasonal:period={365.25 * 86400},seasons=12").check_steps(86400.0 * days)


def test_texts_that_are_no_names_are_left_to_others():
    assert [model_named(text) for text in ("oscillator:plant", "my_module:model", "mine", 3)] == [None] * 4
    with pytest.raises(ValueError, match="constant must come with drift, R, as constant:drift=...,R=..., but"):
        model_named("constant")(dt=0.1)


class Drifting(gym.Env):
    """A level that random steps move, whatever the action."""

    action_space = gym.spaces.Box(-1.0, 1.0, (2,))
    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.level = 0.0
        return np.zeros(1), {}

    def step(self, action):
        self.level += 0.1 * self.np_random.normal()
        return np.array([self.level + self.np_random.normal()]), 0.0, False, False, {}


def test_a_filter_of_a_model_without_inputs_ignores_the_actions(as_python):
    name = "constant:drift=0.01,R=1,dt=1"
    env = filters.EstimateState(Drifting(), "kf", model=name)
    assert env.observation_space.shape == (1,) and env.get_wrapper_attr("filter").model.inputs == 0
    copies = filters.EstimateStates(gym.vector.SyncVectorEnv([Drifting] * 2), "kf", model=name)
    copies.reset(seed=3)
    env.reset(seed=3)
    for _ in range(3):
        single = env.step(np.zeros(2))[4]["estimate"]
        several = copies.step(np.ones((2, 2)))[4]["estimate"]
    np.testing.assert_allclose(several[0], single, rtol=1e-12)
    env = filters.EstimateState(gym.make("BowThruster-v0"), "kf", model="constant:drift=1,R=0.25")  # of its dt
    assert env.filter.model.process_noise_cov[0, 0] == pytest.approx(env.unwrapped.plant.dt)
    far = name + ",mean=-1e4"
    single_env = filters.EstimateState(Drifting(), "kf", model=far)
    for wrapped in (single_env, filters.EstimateStates(copies.env, "kf", model=far)):
        with pytest.warns(UserWarning, match="the first measurement is 100 standard deviations from where"):
            wrapped.reset(seed=3)
    with pytest.raises(ValueError, match="must have a sample time, but .* has no dt here: constant:dt=..."):
        filters.EstimateState(Drifting(), model="constant:drift=0.01,R=1")


@pytest.mark.parametrize(
    "text",
    [
        "constant-velocity:acceleration=0.4,R=0.25,axes=2",
        "oscillator:frequency=0.3,damping=0.1,std=2,R=0.1,mean=3",
        "constant:drift=1,R=1 + ornstein-uhlenbeck:time_constant=2,std=1",
    ],
)
def test_steps_of_any_length_have_the_transition_and_noise_of_that_length(text, as_python):
    maker, rng = model_named(text), np.random.default_rng(2)
    plant, prior = maker.continuous(dt=0.1), maker(dt=0.1)
    z, steps = np.cumsum(rng.normal(size=(12, prior.m)), axis=0), rng.uniform(0.05, 0.25, 11)
    x, cov = prior.prior_mean, prior.prior_cov
    _, _, _, c, offset = prior.matrices()
    for k, measured in enumerate(z):
        if k:
            step = maker(dt=steps[k - 1])
            a = step.matrices()[0]
            x, cov = a @ x, a @ cov @ a.T + step.process_noise_cov
        gain = np.linalg.solve(c @ cov @ c.T + prior.measurement_noise_cov, c @ cov).T
        x, cov = x + gain @ (measured - c @ x - offset), cov - gain @ c @ cov
    filter_ = pickle.loads(pickle.dumps(filters.make_filter("ekf", plant.at(0.1))))
    estimates = filters.run(filter_, z, dt=steps, noise=plant.noise)
    each_close((estimates.means[-1], estimates.covs[-1]), (x, cov), rtol=1e-5, atol=1e-6)


CASES = {  # an input, a state, and the rates there by hand
    "coordinated-turn": ([], [3.0, -2.0, 4.0, 0.3, 0.2], [4 * math.cos(0.3), 4 * math.sin(0.3), 0.0, 0.2, 0.0]),
    "unicycle": ([2.0, 0.4], [3.0, -2.0, 0.3], [2 * math.cos(0.3), 2 * math.sin(0.3), 0.4]),
    "bicycle": ([2.0, 0.1], [0.0, 0.0, 0.3], [2 * math.cos(0.3), 2 * math.sin(0.3), 2 * math.tan(0.1) / 2.7]),
    "pendulum": ([0.7], [0.5, -0.2], [-0.2, -9.81 * math.sin(0.5) + 0.02 + 0.7]),
    "dc-motor": ([3.0], [0.1, 5.0], [5.0, (30.0 - 5.0 - 0.5 * math.tanh(5.0)) / 0.1]),
    "battery": ([2.0], [0.5, 0.03], [-2.0 / 9000.0, (0.04 - 0.03) / 30.0]),
    "tank": ([0.02], [1.5], [0.02 - 0.01 * math.sqrt(2 * 9.81 * 1.5)]),
    "rc-thermal": ([2000.0, 5.0], [21.0], [((5.0 - 21.0) / 0.005 + 2000.0) / 5e6]),
}


@pytest.mark.parametrize("name", CASES)
def test_rates_and_a_step_are_those_of_the_equations(name):
    u, x, rates = CASES[name]
    plant = plants.PLANTS[name]()
    model = plant.at(plant.longest)
    np.testing.assert_allclose(plant.rates(x, u, plant.constants), rates, rtol=1e-12)
    exact = solve_ivp(
        lambda t, at: plant.rates(at, u, plant.constants), (0.0, plant.longest), x, rtol=1e-11, atol=1e-12
    ).y[:, -1]
    np.testing.assert_allclose(model.transition(tuple(x), tuple(u), model.constants), exact, rtol=1e-5, atol=1e-6)
    assert model.n == len(x) and model.inputs == len(u)


def test_range_and_bearing_are_those_from_the_sensor():
    for make in (plants.coordinated_turn, plants.unicycle, plants.bicycle):
        plant = make(sensors="range-bearing", sensor_x=1.0, sensor_y=2.0)
        model, x = plant.at(0.1), (4.0, 6.0, 0.0, 0.0, 0.0)
        np.testing.assert_allclose(model.observe(x, model.constants), (5.0, math.atan2(4.0, 3.0)), rtol=1e-12)
        assert model.measurements[1].angle and plant.arguments["measurement_noise_cov"][1] == 1e-4
    refused("sensors must be one of position, range-bearing", plants.unicycle, sensors="radar")


def test_the_voltage_of_a_battery_is_that_of_its_table_and_current():
    plant = plants.battery(open_circuit=[(0.0, 3.0), (1.0, 4.0)])
    model = plant.at(1.0)
    assert model.observe((0.25, 0.1), (2.0,), model.constants)[0] == pytest.approx(3.25 - 0.1 - 0.06, rel=1e-12)
    assert model.functions == plants.battery(open_circuit=[(0.0, 3.0), (1.0, 4.0)]).at(1.0).functions
    refused("open_circuit must ascend", plants.battery, open_circuit=[(0.0, 3.0), (0.5, 2.9)])


def test_noise_has_the_density_of_what_it_moves():
    model = plants.pendulum(length=0.5, mass=2.0, torque=0.3).at(1e-4)
    np.testing.assert_allclose(model.process_noise_cov[1, 1], 1e-4 * (0.3 / 0.5) ** 2, rtol=1e-3)
    room = plants.rc_thermal().at(60.0)
    np.testing.assert_allclose(room.process_noise_cov[0, 0], 60.0 * (1e4 / 5e6) ** 2, rtol=0.01)


def test_a_filter_follows_a_swinging_pendulum(as_python):
    plant = plants.pendulum(length=0.8, torque=0.02)
    model, rng = plant.at(0.05), np.random.default_rng(1)
    x, z, truth = (1.2, 0.0), [], []
    for _ in range(60):
        truth.append(x)
        z.append(x[0] + 0.01 * rng.normal())
        for _ in range(model.substeps):
            x = model.transition(x, (0.0,), model.constants)
    estimates = filters.run(filters.make_filter("ekf", model), inputs=np.zeros(59), measurements=z)
    np.testing.assert_allclose(estimates.means[10:], truth[10:], atol=0.1)


def test_matrices_have_the_letters_that_users_know():
    f, h, q, r, p = [[1.0, 0.1], [0.0, 1.0]], [[1.0, 0.0]], [0.01, 0.1], [0.25], [10.0, 1.0]
    written = filters.affine_model(F=f, H=h, Q=q, R=r, P0=p)
    plain = filters.affine_model(
        a=f,
        b=np.zeros((2, 0)),
        c=h,
        process_noise_cov=q,
        measurement_noise_cov=r,
        prior_mean=[0.0, 0.0],
        prior_cov=p,
    )
    np.testing.assert_array_equal(written.numbers, plain.numbers)
    driven = filters.affine_model(A=f, B=[[0.0], [0.1]], C=h, D=[[0.0]], Q=q, R=r, x0=[1.0, 0.0], P0=p)
    assert driven.inputs == 1 and driven.prior_mean[0] == 1.0
    refused("a must be given once, but got F, too", filters.affine_model, a=f, F=f, H=h, Q=q, R=r, P0=p)


def read_log_of(log, model):
    return read_named(log, model=model_of_logs(log, model, None)[1])[0]


def test_a_log_is_read_with_a_plant_by_name_or_a_file_of_matrices(tmp_path):
    log, file = tmp_path / "swing.csv", tmp_path / "matrices.toml"
    rows = [f"{0.1 * k:.1f},{math.sin(k):.3f},{math.cos(k):.3f}" for k in range(30)]
    log.write_text("\n".join(["t,encoder,tau", *rows]))
    runs = read_log_of(log, "pendulum")
    assert runs.measurements[1, 0] == 0.841 and runs.inputs[1, 0] == 0.54 and runs.dt == pytest.approx(0.1)
    file.write_text(
        """
F = [[1.0, 0.1], [0.0, 1.0]]
B = [[0.0], [0.1]]
H = [[1.0, 0.0]]
Q = [0.01, 0.1]
R = [0.25]
P0 = [10.0, 1.0]
measurements = [["encoder", "z", "rad"]]
inputs = [["tau", "tau", "N m"]]
"""
    )
    runs = read_log_of(log, file)
    assert runs.measurements[1, 0] == 0.841 and runs.inputs[1, 0] == 0.54
    file.write_text("F = [[1.0, 0.1]]\nH = [[1.0]]\nQ = [1.0]\nR = [1.0]\nP0 = [1.0]\n")
    refused(r"a, b, c must have shapes .*matrices.toml", read_log_of, log, file)


DT, ROWS, RUNS = 0.02, 1500, 24


def flights(rng):
    """True states, inputs and measurements of turns with changing forces, by the sensors' own equations."""
    t = DT * np.arange(ROWS)
    rates = np.column_stack([0.1 * np.sin(0.3 * t), 0.08 * np.cos(0.2 * t), 0.25 + 0.1 * np.sin(0.1 * t)])
    forces = np.column_stack([np.sin(0.25 * t), 0.5 * np.cos(0.4 * t), 9.81 + 0.3 * np.sin(0.5 * t)])
    turn = rotations.exponential(np.deg2rad([2.0, 2.0, 5.0])[:, None] * rng.normal(size=(3, RUNS)))
    x = np.array([*turn, *(5.0 * rng.normal(size=(3, RUNS))), *(4.5 * rng.normal(size=(3, RUNS)))])
    bias = rng.normal(size=(RUNS, 7)) * [*[0.005] * 3, *[0.05] * 3, 20.0]
    walk = np.sqrt(DT) * np.array([*[1e-5] * 3, *[1e-4] * 3, 0.02])
    states, inputs = [], []
    for rate, force in zip(rates, forces, strict=True):
        states.append(np.hstack([x.T, bias]))
        noise = rng.normal(size=(RUNS, 6)) * np.repeat([2e-4, 2e-3], 3) / np.sqrt(DT)
        inputs.append([*rate, *force] + bias[:, :6] + noise)
        x = np.array(poses.strapdown(x, rate, force, (0.0, 0.0, -9.81), DT))
        bias = bias + walk * rng.normal(size=(RUNS, 7))
    states = np.stack(states, axis=1)
    heights = states[..., 9:10] + states[..., 16:] + 0.3 * rng.normal(size=(RUNS, ROWS, 1))
    z = np.concatenate([states[..., 7:10] + 1.5 * rng.normal(size=(RUNS, ROWS, 3)), heights], axis=-1)
    z[:, np.arange(ROWS) % 10 != 0, :3], z[:, np.arange(ROWS) % 5 != 0, 3] = np.nan, np.nan
    return states, np.stack(inputs[:-1], axis=1), z


@pytest.fixture(scope="module")
def model():
    return model_named("inertial-navigation")(dt=DT)


def test_errors_have_the_stated_covariance(model):
    """NEES of 16 within four deviations of its mean over runs, with a tenth for linearisation."""
    states, inputs, z = flights(np.random.default_rng(0))
    estimates = filters.run(filters.make_filter("ekf", model), inputs=inputs, measurements=z)
    for row, yaw in ((100, 6.0), (-1, 2.0)):
        errors = np.array(
            [
                difference(list(a[row]), list(b[row]), model.turns)
                for a, b in zip(states, estimates.means, strict=True)
            ]
        )
        covs = estimates.covs[:, row]
        nees = np.einsum("ri,ri->r", errors, np.linalg.solve(covs, errors[..., None])[..., 0]).mean()
        assert 16.0 - 4.0 * np.sqrt(32.0 / RUNS) < nees < 17.6 + 4.0 * np.sqrt(32.0 / RUNS)
        assert np.rad2deg(np.sqrt((errors[:, 2] ** 2).mean())) < yaw
        assert np.sqrt((errors[:, 6:9] ** 2).mean()) < 1.5  # of one position of GPS


def test_the_noise_is_that_of_white_sensors_and_walking_biases(model):
    """Closed forms of a step: angle, velocity and position; errors of biases move them by minus dt."""
    q, walk = model.process_noise_cov, 1e-4**2
    assert q[0, 0] == pytest.approx(2e-4**2 * DT + 1e-5**2 * DT**3 / 3.0)
    assert q[3, 3] == pytest.approx(2e-3**2 * DT + walk * DT**3 / 3.0)
    assert q[6, 6] == pytest.approx(2e-3**2 * DT**3 / 3.0 + walk * DT**5 / 20.0)
    assert q[3, 12] == pytest.approx(-walk * DT**2 / 2.0) and q[3, 4] == 0.0
    assert np.linalg.eigvalsh(q).min() > 0.0
    turned = model_named("inertial-navigation:heading=90")(dt=DT).prior_mean[:4]
    np.testing.assert_allclose(rotations.to_world(turned, (1.0, 0.0, 0.0)), (0.0, 1.0, 0.0), atol=1e-15)


def test_innovations_of_slow_sensors_are_drawn_as_dots(model):
    """A line between rows without a neighbour has no length."""
    rng, z = np.random.default_rng(1), np.full((201, 4), np.nan)
    z[::10, :3], z[::5, 3] = rng.normal(size=(21, 3)), rng.normal(size=41)
    figure = filters.run(filters.make_filter("ekf", model), inputs=np.zeros((200, 6)), measurements=z).plot()
    lines = [line for axis in figure.axes for line in axis.lines if line.get_label() == "innovation"]
    assert [(line.get_marker(), len(line.get_xdata())) for line in lines] == [(".", 21)] * 3 + [(".", 41)]
    for measured, sparse in ((np.array([True] * 9 + [False]), False), (np.arange(12) % 3 == 0, True)):
        assert is_sparse(measured) is sparse


@pytest.fixture(scope="module")
def waves():
    """Five minutes of a JONSWAP sea of 1.5 m and 6 s."""
    return sea(1.5, 6.0, 3.3, seed=0, seconds=300.0)


def test_heave_in_real_time(waves):
    """Within 2 % of the significant height, as its deviation says to 30 %; roll and pitch to the sensors' bias."""
    result = errors(model_of(1.5, 6.0), waves)
    assert result["heave"] < 0.02 * 1.5
    assert 0.7 < result["stated"] / result["heave"] < 1.3
    assert max(result["roll"], result["pitch"]) < 0.5


def test_a_wrong_period_costs_some_accuracy(waves):
    """A quarter of it, to either side, less than a high-pass filter's 10 %."""
    assert all(errors(model_of(1.5, 6.0 * factor), waves)["heave"] < 0.05 * 1.5 for factor in (0.8, 1.25))


def test_the_prior_is_that_of_the_sea():
    """A quarter of the significant height; the wave is stationary: F P F' + Q = P."""
    model = model_of(2.0, 8.0)
    x, c = model.prior_mean, model.constants
    F = np.array([model.transition(x + unit, np.zeros(3), c) for unit in np.eye(16)[11:15]])[:, 11:15].T
    P, Q = model.prior_cov[10:14, 10:14], model.process_noise_cov[10:14, 10:14]
    np.testing.assert_allclose(F @ P @ F.T + Q, P, rtol=1e-9, atol=1e-15)
    assert P[0, 0] ** 0.5 == pytest.approx(2.0 / 4.0 / (1.0 + (2 * np.pi / 8.0 / 2.5) ** 2))
