"""The thruster as logs show it, preset files, and the thruster in continuous time."""

import gymnasium as gym
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import thruster_env  # noqa: F401 - registers the env
from filters import ExtendedKalmanFilter, run
from thruster_env.core.streams import episode_keys
from thruster_env.model.continuous import noise_for_dt
from thruster_env.model.simulate import simulate
from thruster_env.thruster.dynamics import rates
from thruster_env.thruster.model import (
    Recorder,
    continuous_thruster,
    lag_weights,
    logged_model,
    model_of_plant,
    thruster_model,
    with_recorder,
)
from thruster_env.thruster.parameters import (
    PRESETS,
    T200,
    PresetFile,
    preset_parameters,
    read_preset,
    write_preset,
)
from thruster_env.thruster.plant import make_plant

PLANT = {"preset": "tunnel_physical", "sensors": ["thrust", "speed"], "substeps": 4}


def stepped(model, x, u):
    for _ in range(model.substeps):
        x = model.transition(x, u, model.constants)
    return np.array(x)


def test_without_anything_shown_it_is_the_thruster_to_the_last_bit():
    base, plant = thruster_model(**PLANT), make_plant(**PLANT)
    assert logged_model(**PLANT).transition is base.transition
    neutral = with_recorder(base, plant, Recorder(), always=True)
    for x in ((80.0, 1.2), (-30.0, 0.4), (0.0, 0.0)):
        for u in ((12.0,), (-0.3,), (0.0,)):
            assert (stepped(neutral, x, u) == stepped(base, x, u)).all()
            assert neutral.transition_jacobian(x, u, neutral.constants) == base.transition_jacobian(
                x, u, base.constants
            )
        assert neutral.observe(x, neutral.constants) == base.observe(x, base.constants)
    assert np.array_equal(neutral.prior_mean, base.prior_mean) and np.array_equal(
        neutral.prior_cov, base.prior_cov
    )
    assert np.array_equal(neutral.operating_state, base.operating_state)


def test_dead_band_bias_and_lag_are_what_they_say():
    base = thruster_model(**PLANT)
    model = logged_model(dead_band=(-0.5, 0.8), bias={"thrust": 0.3}, lag={"speed": 0.05}, **PLANT)
    x = (50.0, 0.6, 40.0)
    for given, driving in ((3.0, 2.2), (0.7, 0.0), (-0.4, 0.0), (-2.0, -1.5)):
        np.testing.assert_array_equal(stepped(model, x, (given,))[:2], stepped(base, x[:2], (driving,)))
    thrust, speed = model.observe(x, model.constants)
    _, share = lag_weights(0.05, 0.01 / 4)
    assert thrust == base.observe(x[:2], base.constants)[0] + 0.3
    assert speed == pytest.approx((1 - share) * 40.0 + share * 50.0, rel=1e-14)
    assert [one.symbol for one in model.states] == ["omega_m", "U_a", "speed_lag"]
    settled = (*base.operating_state, 0.0)
    for _ in range(20):
        settled = tuple(np.array(stepped(model, settled, (12.8,))))
    shown = model.observe(settled, model.constants)[1]
    assert shown == pytest.approx(base.operating_state[0] * (1 - np.exp(-0.2 / 0.05)), rel=1e-3)


def test_jacobians_are_those_of_differences():
    model = logged_model(dead_band=0.6, lag={"speed": 0.03, "thrust": 0.02}, **PLANT)
    x, u, h = np.array([60.0, 0.9, 4.0, 55.0]), (9.0,), 1e-5

    def slopes(function):
        sides = ([np.array(function(tuple(x + sign * h * one))) for sign in (1, -1)] for one in np.eye(4))
        return np.column_stack([(above - below) / (2 * h) for above, below in sides])

    found = model.transition_jacobian(tuple(x), u, model.constants)
    np.testing.assert_allclose(found, slopes(lambda y: model.transition(y, u, model.constants)), atol=1e-8)
    found = model.observe_jacobian(tuple(x), model.constants)
    np.testing.assert_allclose(found, slopes(lambda y: model.observe(y, model.constants)), atol=1e-8)


def test_a_lag_is_exact_where_its_input_is_a_straight_line():
    lag, step = 0.05, 0.02
    kept, after = lag_weights(lag, step)
    h0, h1, y0 = 2.0, 3.0, 1.0
    slope = (h1 - h0) / step
    exact = h0 + slope * (step - lag) + (y0 - h0 + slope * lag) * np.exp(-step / lag)
    held = kept * y0 + (1 - kept) * h0
    assert (1 - after) * held + after * h1 == pytest.approx(exact, rel=1e-12)
    assert lag_weights(0.0, step) == (0.0, 1.0)
    for small in (1e-3 * step, 1e-9 * step):  # continuous where the lag goes
        np.testing.assert_allclose(lag_weights(small, step), (0.0, 1.0 - small / step), atol=1e-15)


@pytest.mark.slow
def test_a_lag_that_goes_to_zero_leaves_the_likelihood_of_the_model_without():
    base, plant = thruster_model(**PLANT), make_plant(**PLANT)
    inputs = np.repeat(np.random.default_rng(0).uniform(-9, 9, (4, 20, 1)), 10, axis=1)
    runs = simulate(base, episode_keys(range(4)), inputs).measurements

    def likelihood(model):
        found = run(ExtendedKalmanFilter(model=model), inputs=inputs, measurements=runs)
        return found.log_likelihoods.sum()

    whole = likelihood(base)
    for lag in (0.0, 1e-9, 1e-6):
        lagging = with_recorder(base, plant, Recorder(lag=(("speed", lag), ("thrust", lag))))
        assert likelihood(lagging) == pytest.approx(whole, abs=1e-6 + 1e5 * lag)


def test_the_process_noise_of_a_preset_file_is_that_of_the_sample_time(tmp_path):
    recorder = {"dt": 0.01, "sensors": ["speed"], "process_noise_cov": [2.0, 0.003]}
    write_preset(tmp_path / "mine.toml", PresetFile(PRESETS["tunnel_physical"], (0.0, 0.0), recorder))
    for dt, factor in ((None, 1.0), (0.01, 1.0), (0.01 * (1 + 1e-9), 1.0), (0.02, 2.0), (0.005, 0.5)):
        given = {} if dt is None else {"dt": dt}
        model = logged_model(preset=tmp_path / "mine.toml", **given)
        np.testing.assert_allclose(np.diag(model.process_noise_cov), [2.0 * factor, 0.003 * factor], rtol=1e-12)


def test_a_preset_file_does_not_become_the_description_of_a_log(tmp_path):
    (tmp_path / "run.csv").write_text("t_s\n0\n")
    with pytest.raises(
        ValueError, match="must not take the name of the description of a log, but got .*run.toml beside"
    ):
        write_preset(tmp_path / "run.toml", PresetFile(T200, (0.0, 0.0)))
    assert not (tmp_path / "run.toml").exists()


def test_a_preset_file_comes_back_as_it_was_written(tmp_path):
    path = tmp_path / "mine.toml"
    recorder = {
        "dt": 0.02,
        "sensors": ["speed"],
        "bias": {"speed": -0.25},
        "measurement_noise_cov": {"speed": 2.0},
    }
    whole = PresetFile(
        T200._replace(lift_coefficient=1 / 3), (-0.7, 0.9), recorder, {"about": 'a "b" \\ \n', "n": 3}
    )
    write_preset(path, whole, "mine")
    assert read_preset(path) == whole
    assert preset_parameters(str(path)) == whole.parameters
    model = logged_model(preset=path)
    assert model.constants.bias_0 == -0.25 and model.measurement_noise_cov.tolist() == [[2.0]]
    env = gym.make("BowThruster-v0", preset=str(path)).unwrapped
    assert env.plant.dead_band == (-0.7, 0.9)
    env.reset(seed=0, options=None)
    same = {"preset": whole.parameters._asdict() | {"dead_band": [-0.7, 0.9]}}
    assert model_of_plant(make_plant(**same)).constants == env.state_space_model().constants
    still = make_plant(**same, process_noise_cov=[0, 0], initial_state=[0, 0])
    assert still.amplifier[0].as_mapping() == {"name": "dead-band", "width": 0.9, "astern": 0.7}


def test_the_env_of_a_preset_file_moves_as_its_model_says(tmp_path):
    write_preset(tmp_path / "mine.toml", PresetFile(PRESETS["tunnel_physical"], (-0.5, 0.8)))
    quiet = {"process_noise_cov": [0.0, 0.0], "measurement_noise_cov": [0.01], "initial_state": [0.0, 0.0]}
    env = gym.make("BowThruster-v0", preset=str(tmp_path / "mine.toml"), **quiet)
    env.reset(seed=0)
    model, x = env.unwrapped.state_space_model(measurement_noise_cov=[0.01]), (0.0, 0.0)
    for voltage in (0.5, -0.25, 6.0, -9.0):
        *_, info = env.step(np.array([voltage]))
        x = tuple(stepped(model, x, (voltage,)))
        np.testing.assert_allclose(info["state"], x, rtol=1e-6, atol=1e-9)


WRONG = [
    ("[thruster", "a preset file must be TOML, but"),
    ("[engine]\nx = 1\n", "must have the tables thruster, dead_band, recorder, identified, but got .'engine'."),
    (
        "[thruster]\nmass = 1.0\n",
        "thruster of a preset file must have the fields lift_coefficient, .* mass is none",
    ),
    ("[thruster]\narea = 1.0\n", "but lift_coefficient is missing"),
    ("GOOD\n[dead_band]\nlow = -1.0\n", "dead_band of a preset file must have low and high"),
    ("GOOD\n[dead_band]\nlow = 1.0\nhigh = 2.0\n", "dead_band must be from low <= 0 to high >= 0"),
    ("GOOD\n[recorder]\ncolour = 1\n", "recorder of a preset file must have dt, sensors, .*, but got .'colour'."),
    ("GOOD\n[recorder]\ndt = 'x'\n", "dt of a preset file must be a finite number, but got 'x'"),
    ("GOOD\n[recorder]\nsensors = 'thrust'\n", "sensors of a preset file must be a list of channels"),
    ("GOOD\n[recorder]\nambient_velocity = nan\n", "ambient_velocity of a preset file must be a finite number"),
    (
        "GOOD\n[recorder]\nsensors = ['thrust']\nmeasurement_noise_cov = {speed = 1.0}\n",
        "measurement_noise_cov of a preset file must be of channels thrust, but got 'speed'",
    ),
    ("GOOD\n[recorder]\nlag = {thrust = -1.0}\n", "lag of thrust must be zero or positive, but got -1"),
    ("GOOD\n[dead_band]\nlow = false\nhigh = 1.0\n", "low must be a finite number, but got False"),
    ("GOOD\n[recorder]\nbias = {thrust = 'x'}\n", "bias of thrust must be a finite number"),
]


@pytest.mark.parametrize(("text", "message"), WRONG)
def test_a_wrong_preset_file_is_one_clear_line(tmp_path, text, message):
    path = tmp_path / "mine.toml"
    write_preset(path, PresetFile(T200))
    path.write_text(text.replace("GOOD", path.read_text()))
    with pytest.raises(ValueError, match=message) as error:
        make_plant(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_wrong_arguments_are_refused():
    with pytest.raises(
        ValueError, match="bias and lag must be of measured channels, thrust, speed, but got 'current'"
    ):
        logged_model(bias={"current": 1.0}, **PLANT)
    with pytest.raises(ValueError, match="lag of speed must be zero or positive, but got -1"):
        logged_model(lag={"speed": -1}, **PLANT)
    with pytest.raises(ValueError, match="a preset file must end in .toml"):
        write_preset("x.json", PresetFile(T200))


@pytest.mark.parametrize(
    "arguments",
    [{}, {"dt": 0.05}, {"dead_band": 0.5, "bias": {"thrust": 0.2}}, {"sensors": ["speed", "thrust"]}],
)
def test_at_its_sample_time_it_is_the_discrete_model(arguments):
    model, plant = logged_model(**arguments), continuous_thruster(**arguments)
    dt = model.constants.substep * model.substeps
    made = plant.at(dt)
    assert made.digest == model.digest
    assert (made.constants, made.substeps) == (model.constants, model.substeps)
    np.testing.assert_allclose(made.process_noise_cov, model.process_noise_cov, rtol=1e-12, atol=1e-15)
    for u in (-20.0, 0.3, 15.0):
        x = (40.0, 0.5)
        np.testing.assert_array_equal(
            made.transition(x, (u,), made.constants), model.transition(x, (u,), model.constants)
        )


@pytest.mark.parametrize("dt", [0.002, 0.013, 0.1])
def test_any_sample_time_follows_the_equations(dt):
    model = continuous_thruster().at(dt)
    x, c = (-60.0, -0.4), model.constants
    for _ in range(model.substeps):
        x = model.transition(x, (18.0,), c)
    exact = solve_ivp(
        lambda t, y: rates(tuple(y), (18.0, c.ambient_velocity), c),
        (0.0, dt),
        [-60.0, -0.4],
        rtol=1e-10,
        atol=1e-10,
    )
    np.testing.assert_allclose(x, exact.y[:, -1], rtol=1e-3)


def test_its_noise_is_that_of_the_definitions():
    plant, q = continuous_thruster(), logged_model().process_noise_cov
    for dt in (0.004, 0.03):
        np.testing.assert_allclose(plant.noise(dt), noise_for_dt(q, 0.01, dt, plant.slope), rtol=1e-9, atol=1e-15)
    small = plant.noise(1e-5)
    np.testing.assert_allclose(small, noise_for_dt(plant.densities, 1.0, 1e-5), rtol=5e-3)


def test_what_has_no_continuous_time_is_refused():
    with pytest.raises(ValueError, match="must have no lag"):
        continuous_thruster(lag={"thrust": 0.02})
    with pytest.raises(ValueError, match="process_noise_cov must be that of white noise in continuous time"):
        continuous_thruster(process_noise_cov=[1.0, 0.0])
