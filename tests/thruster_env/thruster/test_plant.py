import math

import gymnasium as gym
import numpy as np
import pytest

import thruster_env  # noqa: F401 - registers the env
from thruster_env.core.checks import at_least, covariance, covariance_root, finite, one_of, positive, vector
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import draw_key, episode_keys
from thruster_env.thruster.analysis import run_substeps
from thruster_env.thruster.equations import copies_of, simulate
from thruster_env.thruster.parameters import PRESETS, TUNNEL
from thruster_env.thruster.plant import Task, make_plant

MAPPING = TUNNEL._asdict()
Q, R = [[1.0, 0.012], [0.012, 4e-4]], 0.25

# Argument, a wrong value, and what the message must say.
WRONG = [
    ("preset", "tunel", "preset must be one of tunnel, open_bladed"),
    ("preset", None, "preset must be one of"),
    ("preset", {"lift_coefficient": 1.75}, "a preset mapping must have the fields"),
    ("preset", MAPPING | {"colour": 1.0}, "a preset mapping must have the fields"),
    ("preset", MAPPING | {"area": -0.1}, "area must be positive, but got -0.1"),
    ("preset", MAPPING | {"gear_ratio": 0}, "gear_ratio must be positive, but got 0"),
    ("preset", MAPPING | {"density": math.nan}, "density must be a finite number, but got nan"),
    ("preset", MAPPING | {"angles": "printed"}, "angles must be one of as-printed"),
    ("preset", MAPPING | {"blade_angle": "steep"}, "blade_angle must be a finite number, but got 'steep'"),
    ("preset", TUNNEL._replace(drag_coefficient=-1.0), "drag_coefficient must be zero or positive"),
    ("dt", 0.0, "dt must be positive, but got 0.0"),
    ("dt", -0.01, "dt must be positive, but got -0.01"),
    ("dt", math.nan, "dt must be a finite number, but got nan"),
    ("dt", None, "dt must be a finite number, but got None"),
    ("dt", 10.0, "dt must be short enough"),
    ("max_voltage", 0, "max_voltage must be positive, but got 0"),
    ("max_voltage", math.inf, "max_voltage must be a finite number, but got inf"),
    ("ambient_velocity", math.nan, "ambient_velocity must be a finite number, but got nan"),
    ("ambient_velocity", "slow", "ambient_velocity must be a finite number, but got 'slow'"),
    ("process_noise_cov", [1.0, -4e-4], r"process_noise_cov must be positive semidefinite .* -0.0004\]"),
    ("process_noise_cov", [[1.0, 2.0], [2.0, 1.0]], "process_noise_cov must be positive semidefinite"),
    ("process_noise_cov", [[1.0, 0.5], [0.0, 1.0]], "process_noise_cov must be 2 variances or a symmetric"),
    ("process_noise_cov", [1.0, 1.0, 1.0], "process_noise_cov must be 2 variances or a symmetric"),
    ("process_noise_cov", 1.0, "process_noise_cov must be 2 variances or a symmetric"),
    ("process_noise_cov", [math.nan, 1.0], "process_noise_cov must be .* of finite numbers, but got"),
    ("process_noise_cov", [[1.0], [0.0, 1.0]], "process_noise_cov must be 2 variances or a symmetric"),
    ("process_noise_cov", "white", "process_noise_cov must be .*, but got 'white'"),
    ("measurement_noise_cov", -0.25, "measurement_noise_cov must be positive semidefinite .*, but got -0.25"),
    ("measurement_noise_cov", math.inf, "measurement_noise_cov must be .*, but got inf"),
    ("measurement_noise_cov", [1.0, 1.0], "measurement_noise_cov must be"),
    ("initial_state", [1.0], r"initial_state must be 2 finite numbers, but got \[1.0\]"),
    ("initial_state", [1.0, math.nan], "initial_state must be 2 finite numbers"),
    ("initial_state", "rest", "initial_state must be 2 finite numbers, but got 'rest'"),
    ("initial_state", {"volts": 12}, "initial_state must be None, two numbers"),
    ("initial_state", {"mean": [0, 0]}, "initial_state must be None, two numbers"),
    ("initial_state", {"voltage": math.nan}, "the voltage of initial_state must be a finite number"),
    ("initial_state", {"mean": [0], "cov": [1, 1]}, "the mean of initial_state must be 2 finite numbers"),
    ("initial_state", {"mean": [0, 0], "cov": [1, -1]}, "the cov of initial_state must be positive"),
]


@pytest.mark.parametrize(("argument", "value", "message"), WRONG)
def test_a_wrong_argument_is_refused_with_the_rule_and_the_value(argument, value, message):
    with pytest.raises(ValueError, match=message) as error:
        make_plant(**{argument: value})
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("argument", ["dt", "process_noise_cov", "initial_state"])
def test_an_integer_beyond_the_floats_is_refused_like_any_other_value(argument):
    value = 10**400 if argument == "dt" else [10**400, 1]
    with pytest.raises(ValueError, match=f"{argument} must be"):
        make_plant(**{argument: value})


@pytest.mark.parametrize("blade_angle", [-0.5, 3.0])
def test_blades_without_a_steady_state_are_refused_with_the_rule(blade_angle):
    with pytest.raises(ValueError, match="blade_angle|steady state"):
        make_plant(TUNNEL._replace(blade_angle=blade_angle))


@pytest.mark.parametrize(
    "call",
    [
        lambda: finite("n", "x"),
        lambda: positive("n", -1e-9, zero_allowed=True),
        lambda: at_least("n", 1, 2),
        lambda: at_least("n", 2.5, 2),
        lambda: at_least("n", math.inf, 2),
        lambda: one_of("n", "c", ("a", "b")),
        lambda: one_of("n", 1, ("a", "b")),
        lambda: vector("n", [[1.0, 2.0]], 2),
        lambda: covariance("n", [1.0, 0.0], 2, positive_definite=True),
    ],
)
def test_checks_name_the_argument(call):
    with pytest.raises(ValueError, match="^n must be .*, but got "):
        call()


def test_checks_return_plain_values():
    assert positive("n", 0, zero_allowed=True) == 0.0
    assert (at_least("n", 30.0, 2), type(at_least("n", np.int64(30), 2))) == (30, int)
    np.testing.assert_array_equal(vector("n", 3, 1), [3.0])
    np.testing.assert_array_equal(covariance("n", 0.25, 1), [[0.25]])
    np.testing.assert_array_equal(covariance("n", [1, 0], 2), [[1.0, 0.0], [0.0, 0.0]])


def test_checked_arrays_are_copies():
    given = np.eye(2)
    taken = covariance("n", given, 2), vector("n", given[0], 2)
    given[:] = 7.0
    np.testing.assert_array_equal(taken[0], np.eye(2))
    np.testing.assert_array_equal(taken[1], [1.0, 0.0])


@pytest.mark.parametrize(
    "cov",
    [Q, np.zeros((2, 2)), np.diag([0.0, 3.0]), np.diag([3.0, 0.0]), np.ones((2, 2)), [[4.0, -1.9], [-1.9, 1.0]]],
)
def test_a_covariance_is_its_root_times_its_transpose(cov):
    root = covariance_root(np.array(cov))
    np.testing.assert_allclose(root @ root.T, cov, rtol=0, atol=1e-14)
    np.testing.assert_allclose(root, np.tril(root), rtol=0, atol=0)
    assert (np.diag(root) >= 0).all()


def test_defaults_are_the_documented_ones():
    plant = make_plant()
    assert plant.parameters == PRESETS["tunnel"]
    assert (plant.dt, plant.max_voltage, plant.ambient_velocity) == (0.01, 24.0, 0.0)
    np.testing.assert_array_equal(plant.process_noise_cov, np.diag([1.0, 4e-4]))
    np.testing.assert_array_equal(plant.measurement_noise_cov, [[0.25]])
    np.testing.assert_array_equal(plant.initial_mean, [0.0, 0.0])
    np.testing.assert_array_equal(plant.initial_cov, np.diag([1.0, 0.01]))


@pytest.mark.parametrize("preset", ["tunnel", MAPPING, TUNNEL, TUNNEL._replace(gear_ratio=2)])
def test_a_preset_may_be_a_name_a_mapping_or_parameters(preset):
    assert make_plant(preset).parameters == TUNNEL
    assert type(make_plant(preset).parameters.gear_ratio) is float


def random_voltages(copies, steps, top=24.0, seed=5):
    return np.random.default_rng(seed).uniform(-top, top, (copies, steps))


@pytest.mark.parametrize("preset", PRESETS)
def test_without_noise_the_plant_is_the_stepper(preset):
    plant = make_plant(preset, process_noise_cov=[0, 0], measurement_noise_cov=0, initial_state=[3.0, 0.1])
    voltages = random_voltages(3, 40)
    run = simulate(plant, episode_keys(range(3)), voltages)
    x = (np.full(3, 3.0), np.full(3, 0.1))
    for k in range(40):
        np.testing.assert_allclose(run.states[:, k], np.transpose(x), rtol=1e-9, atol=1e-12)
        x = run_substeps(x, (voltages[:, k], 0.0), plant.parameters, plant.dt, plant.substeps)
    np.testing.assert_array_equal(run.measurements[..., 0], run.thrusts)


@pytest.mark.parametrize("count", [1, 4, 128, 300, 1100])
def test_a_voltage_beyond_the_range_is_clipped_in_every_copy(count):
    copies = copies_of(make_plant(), Task(), count)
    copies.begin(np.zeros((count, 2)))
    voltages = np.linspace(-40.0, 40.0, count)
    report = copies.step(voltages)
    np.testing.assert_array_equal(report[copies.report_rows["voltage"]], np.clip(voltages, -24, 24))


@pytest.mark.parametrize("preset", PRESETS)
def test_a_batch_is_a_loop_over_envs_with_the_same_seeds(preset):
    seeds = [0, 7, 2**33]
    arguments = {"process_noise_cov": Q, "measurement_noise_cov": R, "ambient_velocity": 0.2}
    env = gym.make("BowThruster-v0", preset=preset, **arguments)
    actions = random_voltages(3, 500, top=30.0).astype(np.float32)
    run = simulate(make_plant(preset, **arguments), episode_keys(seeds), actions)
    for b, seed in enumerate(seeds):
        infos = [env.reset(seed=seed)[1]]
        infos += [env.step(action)[4] for action in actions[b][:, None]]
        for name, batch in (("state", run.states), ("thrust", run.thrusts), ("measurement", run.measurements)):
            np.testing.assert_allclose(batch[b], [info[name] for info in infos], rtol=1e-12, atol=1e-12)


def test_an_unseeded_reset_takes_the_next_key_of_the_generator():
    env = gym.make("BowThruster-v0")
    env.reset(seed=4)
    generator = gym.utils.seeding.np_random(4)[0]
    draw_key(generator)
    for _ in range(3):
        start = simulate(make_plant(), draw_key(generator)[None], np.empty((1, 0)))
        np.testing.assert_allclose(env.reset()[1]["state"], start.states[0, 0], rtol=0, atol=1e-12)


def test_nothing_of_the_plant_is_compiled_within_interpreted():
    with interpreted():
        assert copies_of(make_plant(), Task(), 1).advance.in_python
    assert not copies_of(make_plant(), Task(), 1).advance.in_python


@pytest.mark.parametrize(
    "voltages", [np.zeros((2, 4)), np.zeros(4), np.full((3, 4), np.nan)], ids=["rows", "flat", "nan"]
)
def test_simulate_refuses_voltages_that_do_not_fit_the_keys(voltages):
    with pytest.raises(ValueError, match="voltages must"):
        simulate(make_plant(), episode_keys(range(3)), voltages)


def assert_standard_normal(z):
    """Mean, covariance and neighbours in time of z (n, K, d) within five standard errors of white N(0, I)."""
    flat = z.reshape(-1, z.shape[-1])
    n = len(flat)
    assert np.abs(flat.mean(axis=0)).max() < 5 / math.sqrt(n)
    standard_error = np.where(np.eye(z.shape[-1]), math.sqrt(2.0), 1.0) / math.sqrt(n)
    assert (np.abs(flat.T @ flat / n - np.eye(z.shape[-1])) < 5 * standard_error).all()
    lagged = np.einsum("bki,bkj->ij", z[:, 1:], z[:, :-1]) / n
    assert np.abs(lagged).max() < 5 / math.sqrt(n)


def test_noise_is_white_with_covariances_q_and_r():
    plant = make_plant(process_noise_cov=Q, measurement_noise_cov=R)
    voltages = random_voltages(1000, 100)
    run = simulate(plant, episode_keys(range(1000)), voltages)
    before = tuple(np.moveaxis(run.states[:, :-1], -1, 0))
    after = run_substeps(before, (voltages, 0.0), plant.parameters, plant.dt, plant.substeps)
    w = run.states[:, 1:] - np.moveaxis(after, 0, -1)
    v = (run.measurements[..., 0] - run.thrusts)[:, 1:, None]
    whitened = w @ np.linalg.inv(np.linalg.cholesky(Q)).T
    assert_standard_normal(np.concatenate([whitened, v / math.sqrt(R)], axis=-1))
    first = (run.measurements[..., 0] - run.thrusts)[:, :1, None]
    assert_standard_normal(first / math.sqrt(R))


def test_the_initial_state_has_its_distribution():
    mean, cov = [5.0, -0.2], [[4.0, 0.3], [0.3, 0.09]]
    plant = make_plant(initial_state={"mean": mean, "cov": cov})
    x = simulate(plant, episode_keys(range(5000)), np.empty((5000, 0))).states
    assert_standard_normal((x - mean) @ np.linalg.inv(np.linalg.cholesky(cov)).T)
    x = simulate(make_plant(), episode_keys(range(5000)), np.empty((5000, 0))).states
    assert_standard_normal(x / [1.0, 0.1])
