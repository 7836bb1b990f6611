"""Every channel and every sensor effect against its definition, written here once more or as statistics."""

import math
from contextlib import nullcontext
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import pytest
from scipy import stats

import thruster_env  # noqa: F401 - registers the envs
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import episode_keys
from thruster_env.effects.effects import Effect, Registry
from thruster_env.effects.sensors import SENSOR_EFFECTS, Bias, Quantisation
from thruster_env.thruster.dynamics import thrust_and_torque
from thruster_env.thruster.equations import simulate
from thruster_env.thruster.parameters import CHANNELS, PRESETS, TUNNEL_PHYSICAL, derive_constants
from thruster_env.thruster.plant import make_plant

NOTHING = {"name": "bias"}  # adds zero
EVERY_EFFECT = [
    {"name": "student-t", "scale": 0.3},
    {"name": "outliers", "std": 5.0},
    {"name": "bias", "value": 0.2, "std": 0.1, "drift": 0.01},
    {"name": "quantisation", "step": 0.05},
    {"name": "saturation", "low": -9.0, "high": 9.0},
    {"name": "dropout", "probability": 0.3},
    {"name": "delay", "steps": 3},
    {"name": "sample-every", "steps": 3},
]
LEAST_COMPILED = 40_000  # steps of copies, from which machine code takes less time than its compilation
SURELY = 1e-4  # the probability with which a right program fails such a test, once for all seeds


def run_of(chain, copies=400, steps=100, channel="thrust", r=0.0, top=24.0, **arguments):
    plant = make_plant(sensors={channel: chain}, measurement_noise_cov=r, **arguments)
    voltages = np.random.default_rng(7).uniform(-top, top, (copies, steps))
    with interpreted() if copies * steps <= LEAST_COMPILED else nullcontext():
        return simulate(plant, episode_keys(range(copies)), voltages)


def read(chain, **arguments):
    return run_of(chain, **arguments).measurements[..., 0]


def added(effect, **arguments):
    run = run_of([effect], **arguments)
    return run.measurements[..., 0] - run.thrusts


def assert_share(count, total, probability):
    assert total == 0 or stats.binomtest(int(count), int(total), probability).pvalue > SURELY


def assert_drawn_from(values, distribution):
    assert stats.kstest(np.ravel(values), distribution.cdf).pvalue > SURELY


def assert_white(x):
    """Correlation of signs with those of the step before and of the next copy is within its standard error."""
    signs = np.sign(x)
    for one, other in ((signs[:, 1:], signs[:, :-1]), (signs[1:], signs[:-1])):
        assert abs((one * other).mean()) < 4 / math.sqrt(one.size)


@pytest.mark.parametrize("degrees", [1.0, 2.5, 3.0, 30.0])
def test_heavy_tails_are_those_of_student(degrees):
    noise = added({"name": "student-t", "scale": 0.3, "degrees": degrees}, copies=5000)
    assert_drawn_from(noise / 0.3, stats.t(degrees))
    assert_white(noise)


def test_heavy_tails_come_beside_the_gaussian_noise():
    both = added({"name": "student-t", "scale": 0.3, "degrees": 5.0}, r=0.25)
    alone = added({"name": "student-t", "scale": 0.3, "degrees": 5.0})
    assert_drawn_from((both - alone) / 0.5, stats.norm)
    assert abs((np.sign(both - alone) * np.sign(alone)).mean()) < 4 / math.sqrt(both.size)


@pytest.mark.parametrize("probability", [0.0, 0.05, 0.5, 1.0])
def test_outliers_are_a_share_of_normal_variates(probability):
    noise = added({"name": "outliers", "std": 5.0, "probability": probability})
    hit = np.abs(noise) > 0
    assert_share(hit.sum(), hit.size, probability)
    if hit.any():
        assert_drawn_from(noise[hit] / 5.0, stats.norm)
    if probability == 0.5:
        assert_white(hit - 0.5)


def test_outliers_have_the_moments_of_a_mixture():
    r, p, std = 0.25, 0.1, 4.0
    noise = added({"name": "outliers", "std": std, "probability": p}, r=r, copies=1000)
    # Moments of the mixture; the eighth is for the standard error of the fourth.
    fourth = 3 * ((1 - p) * r**2 + p * (r + std**2) ** 2)
    eighth = 105 * ((1 - p) * r**4 + p * (r + std**2) ** 4)
    variance = r + p * std**2
    assert abs(np.mean(noise**2) - variance) < 4 * math.sqrt((fourth - variance**2) / noise.size)
    assert abs(np.mean(noise**4) - fourth) < 4 * math.sqrt((eighth - fourth**2) / noise.size)


def test_a_bias_starts_about_its_value_and_walks():
    bias = added({"name": "bias", "value": -2.0, "std": 0.5, "drift": 0.1}, copies=1000, steps=50)
    assert_drawn_from((bias[:, 0] + 2.0) / 0.5, stats.norm)
    walk = np.diff(bias, axis=1) / 0.1
    assert_drawn_from(walk, stats.norm)
    assert_white(walk)
    assert abs(np.corrcoef(bias[:, 0], bias[:, -1] - bias[:, 0])[0, 1]) < 4 / math.sqrt(1000)
    expected = 0.5**2 + 50 * 0.1**2
    assert abs(bias[:, -1].var() / expected - 1) < 4 * math.sqrt(2 / 1000)


def test_a_bias_without_spread_is_a_constant_and_is_forgotten_at_the_next_episode():
    np.testing.assert_allclose(added({"name": "bias", "value": 0.7}), 0.7, rtol=0, atol=1e-12)
    env = gym.make("BowThruster-v0", sensors={"thrust": [Bias(std=3.0, drift=1.0)]}, measurement_noise_cov=0)
    starts = []
    for seed in (3, None, 3):
        info = env.reset(seed=seed)[1]
        starts.append(float(info["measurement"][0]) - info["thrust"])
        env.step([1.0])
    assert starts[0] == starts[2] != starts[1]


@pytest.mark.parametrize("step", [0.05, 3.0, 1e-20])
def test_quantised_readings_are_the_nearest_multiples(step):
    raw, rounded = (
        read([effect], r=0.25, copies=20) for effect in (NOTHING, {"name": "quantisation", "step": step})
    )
    assert (np.abs(rounded - raw) <= step / 2 + 1e-12).all()
    if step > 1e-3:
        np.testing.assert_allclose(rounded / step, np.round(rounded / step), rtol=0, atol=1e-9)
        np.testing.assert_array_equal(rounded, np.floor(raw / step + 0.5) * step)


def held(raw, valid):
    """The last valid reading, zero before there is one."""
    result = np.zeros_like(raw)
    for k in range(raw.shape[1]):
        before = result[:, k - 1] if k else 0.0
        result[:, k] = np.where(valid[:, k], raw[:, k], before)
    return result


@pytest.mark.parametrize(("probability", "length"), [(0.1, None), (0.3, 1.0), (0.4, 12.0), (0.0, None)])
def test_dropout_has_its_share_its_lengths_and_holds_the_last_valid_reading(probability, length):
    effect = {"name": "dropout", "probability": probability, "mean_length": length}
    copies, steps = 200, 2000
    run = run_of([effect], r=0.25, copies=copies, steps=steps)
    valid = run.valid[..., 0]
    raw = read([NOTHING], r=0.25, copies=copies, steps=steps)
    readings = run.measurements[..., 0]
    np.testing.assert_array_equal(readings, held(readings, valid))
    np.testing.assert_allclose(readings, held(raw, valid), rtol=0, atol=1e-12)  # another program: other last bits
    length = 1 / (1 - probability) if length is None else length
    begins, ends = probability / (1 - probability) / length, 1 / length
    before, after = valid[:, :-1], valid[:, 1:]
    assert_share((before & ~after).sum(), before.sum(), begins)
    assert_share((~before & after).sum(), (~before).sum(), ends)
    assert_share((~valid[:, 0]).sum(), copies, begins)  # as if a valid one came before
    share = 1 - valid[:, 100:].mean()
    correlation = 1 - begins - ends  # of neighbours in the chain of two states
    spread = probability * (1 - probability) * (1 + correlation) / (1 - correlation) / valid.size
    assert abs(share - probability) <= 4.5 * math.sqrt(spread)


def test_validity_is_told_in_the_observation_and_in_info():
    often, seldom = ({"name": "dropout", "probability": share} for share in (0.5, 0.2))
    env = gym.make("BowThruster-v0", sensors={"speed": [], "thrust": [often], "speed-magnitude": [seldom]})
    observation, info = env.reset(seed=0)
    flags = []
    for _ in range(200):
        assert observation.shape == (5,) and info["measurement"].shape == (3,)
        np.testing.assert_array_equal(observation[:3], info["measurement"].astype(np.float32))
        assert info["measurement_valid"].dtype == bool and info["measurement_valid"][0]
        np.testing.assert_array_equal(observation[3:], info["measurement_valid"][1:])
        flags.append(info["measurement_valid"])
        observation, _, _, _, info = env.step([12.0])
    missing = 1 - np.mean(flags, axis=0)
    assert missing[0] == 0 and missing[1] > missing[2] > 0
    assert "measurement_valid" not in gym.make("BowThruster-v0").reset(seed=0)[1]


@pytest.mark.parametrize("steps", [1, 2, 7])
def test_a_delay_is_exactly_so_many_steps_late_and_repeats_the_first(steps):
    raw, late = (read([effect], r=0.25, copies=20) for effect in (NOTHING, {"name": "delay", "steps": steps}))
    np.testing.assert_array_equal(late[:, steps:], raw[:, :-steps])
    np.testing.assert_array_equal(late[:, :steps], np.repeat(raw[:, :1], steps, axis=1))


def test_a_delay_after_dropout_delays_the_flag_too_and_one_before_it_does_not():
    dropout, delay = {"name": "dropout", "probability": 0.3, "mean_length": 3.0}, {"name": "delay", "steps": 4}
    lost, both = run_of([dropout], r=0.25, copies=20), run_of([dropout, delay], r=0.25, copies=20)
    for late, now in ((both.measurements, lost.measurements), (both.valid, lost.valid)):
        np.testing.assert_array_equal(late[:, 4:], now[:, :-4])
        np.testing.assert_array_equal(late[:, :4], np.repeat(now[:, :1], 4, axis=1))
    late, lost = read([delay], r=0.25, copies=20), run_of([delay, dropout], r=0.25, copies=20)
    np.testing.assert_array_equal(lost.measurements[..., 0], held(late, lost.valid[..., 0]))


def test_effects_act_in_the_order_of_the_list():
    clip, shift = {"name": "saturation", "low": -5.0, "high": 5.0}, {"name": "bias", "value": 2.0}
    rounding, raw = {"name": "quantisation", "step": 0.7}, read([NOTHING], copies=20)
    np.testing.assert_array_equal(read([clip], copies=20), np.clip(raw, -5, 5))
    np.testing.assert_allclose(read([clip, shift], copies=20), np.clip(raw, -5, 5) + 2.0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(read([shift, clip], copies=20), np.clip(raw + 2.0, -5, 5), rtol=0, atol=1e-12)
    rounded = np.floor((raw + 2.0) / 0.7 + 0.5) * 0.7
    np.testing.assert_allclose(
        read([shift, rounding, clip], copies=20), np.clip(rounded, -5, 5), rtol=0, atol=1e-12
    )


def test_two_equal_effects_draw_different_numbers():
    student = {"name": "student-t", "scale": 1.0}
    in_one_channel = added(student), read([student, student]) - read([student])
    plant = make_plant(sensors={"thrust": [student], "speed": [student]}, measurement_noise_cov=[0, 0])
    run = simulate(plant, episode_keys(range(400)), np.zeros((400, 50)))
    in_two = run.measurements[..., 0] - run.thrusts, run.measurements[..., 1] - run.states[..., 0]
    for one, other in (in_one_channel, in_two):
        assert abs((np.sign(one) * np.sign(other)).mean()) < 4 / math.sqrt(one.size)


@pytest.mark.parametrize("preset", PRESETS)
def test_channels_measure_what_they_are_named_after(preset):
    plant = make_plant(preset, sensors=list(CHANNELS), measurement_noise_cov=[0, 0, 0, 0])
    voltages = np.random.default_rng(1).uniform(-40, 40, (5, 60))
    run = simulate(plant, episode_keys(range(5)), voltages)
    speed, p = run.states[..., 0], PRESETS[preset]
    applied = np.column_stack([np.zeros(5), np.clip(voltages, -24, 24)])
    current = p.voltage_gain * (p.voltage_gain * applied - p.motor_damping * speed)
    current = current / (p.load_gain * p.motor_damping)
    assert (speed < 0).any() and (speed > 0).any()
    expected = np.stack([run.thrusts, speed, np.abs(speed), current], axis=-1)
    np.testing.assert_allclose(run.measurements, expected, rtol=1e-12, atol=1e-9 * np.abs(current).max())


@pytest.mark.parametrize("voltage", [-9.0, 6.0, 24.0])
def test_in_steady_state_the_current_makes_the_torque_of_the_propeller(voltage):
    noiseless = {"measurement_noise_cov": 0, "process_noise_cov": [0, 0], "initial_state": {"voltage": voltage}}
    plant = make_plant("tunnel_physical", sensors=["current"], **noiseless)
    run = simulate(plant, episode_keys([0]), np.full((1, 20), voltage))
    torque = thrust_and_torque(tuple(run.states[0, -1]), derive_constants(TUNNEL_PHYSICAL))[1]
    motor_constant = TUNNEL_PHYSICAL.motor_damping / TUNNEL_PHYSICAL.voltage_gain
    assert motor_constant * run.measurements[0, -1, 0] == pytest.approx(torque, rel=1e-6)
    assert torque * voltage > 0


def test_noise_of_the_channels_has_covariance_r():
    r = np.array([[0.25, 0.3, -0.02, 0.0], [0.3, 4.0, 0.0, 0.1], [-0.02, 0.0, 1.0, 0.05], [0.0, 0.1, 0.05, 0.01]])
    plants = [make_plant(sensors=list(CHANNELS), measurement_noise_cov=cov) for cov in (r, np.zeros((4, 4)))]
    keys, voltages = episode_keys(range(500)), np.full((500, 60), 9.0)
    noisy, exact = (simulate(plant, keys, voltages).measurements for plant in plants)
    v = (noisy - exact).reshape(-1, 4)
    errors = np.sqrt((np.outer(np.diag(r), np.diag(r)) + r**2) / len(v))  # standard errors, Isserlis' theorem
    assert (np.abs(v.T @ v / len(v) - r) < 4.5 * errors).all()
    assert_white((noisy - exact)[..., 1])
    defaults = make_plant(sensors=["speed", "thrust"]).measurement_noise_cov
    np.testing.assert_array_equal(defaults, np.diag([CHANNELS["speed"].variance, CHANNELS["thrust"].variance]))


def test_every_effect_is_tried():
    ours = {name for name, kind in SENSOR_EFFECTS.effects.items() if kind.__module__.startswith("thruster_env")}
    assert {effect["name"] for effect in EVERY_EFFECT} == ours  # and what examples of the docs have registered


def registered(monkeypatch, act):
    """An effect of a user with one argument, `factor`."""

    @dataclass(frozen=True)
    class OwnEffect(Effect):
        factor: float
        name = "own"

    OwnEffect.act = staticmethod(act)
    monkeypatch.setitem(SENSOR_EFFECTS.effects, "own", OwnEffect)
    return {"name": "own", "factor": 1.5}


def test_a_name_of_another_module_s_effect_is_refused_and_one_defined_anew_replaces():
    registry, classes = Registry("sensors"), [type("Drift", (Effect,), {"__module__": name}) for name in "aab"]
    for cls in classes[:2]:  # as a cell of a notebook that runs again
        assert registry.register("drift")(cls) is registry.effects["drift"]
    with pytest.raises(ValueError, match="an effect must have a name of its own, but 'drift' is Drift of a"):
        registry.register("drift")(classes[2])


def test_an_effect_of_one_s_own_may_decide_and_keep_what_it_likes(monkeypatch):
    def act(e, reading, peak, t):
        peak = abs(reading.z) if t.begin else max(peak, abs(reading.z))
        if reading.z < 0.0:
            return reading._replace(z=-peak * e.factor), peak
        return reading._replace(z=peak), peak

    raw, changed = read([NOTHING], r=0.25, copies=20), read([registered(monkeypatch, act)], r=0.25, copies=20)
    peak = np.maximum.accumulate(np.abs(raw), axis=1)
    np.testing.assert_allclose(changed, np.where(raw < 0, -1.5 * peak, peak), rtol=1e-12)


def raising(e, reading, n, t):
    """A sensor that refuses negative readings."""
    if reading.z < 0:
        raise ValueError("negative")
    return reading, n


GENERATOR = np.random.default_rng(1)  # of the user's own: tracing would freeze what it draws


@pytest.mark.parametrize(
    ("act", "rule"),
    [
        (
            lambda e, reading, n, t: (reading, 0.0 if t.begin else (n, n)),
            "must have a memory of the same shape in",
        ),
        (lambda e, reading, n, t: (reading._replace(z=[0.0, 1.0][reading.z]), n), "must be a function of numbers"),
        (
            lambda e, reading, n, t: (reading._replace(z=GENERATOR.normal()), n),
            "must be .* must depend on its arguments alone",
        ),
        (lambda e, reading, n, t: (reading.z, n), "must return the value, here a Reading, and the memory"),
        (raising, "must be .* it must not raise exceptions, but raises ValueError"),
        (lambda e, reading, n, t: (reading, n + 1), "must be .* where t.begin is true"),
        (lambda e, reading, n, t: reading, "must return the value, here a Reading, and the memory"),
        (lambda e, reading, n, t: (reading._replace(z=e.nothing), n), "must take what its arguments have"),
    ],
)
def test_an_effect_that_is_no_function_of_numbers_is_refused(monkeypatch, act, rule):
    with pytest.raises(ValueError, match=f"act of 'own' {rule}") as error:
        gym.make("BowThruster-v0", sensors={"thrust": [registered(monkeypatch, act)]})
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("effect", EVERY_EFFECT, ids=lambda effect: effect["name"])
def test_an_effect_does_not_move_the_truth(effect):
    one, other = (run_of(chain, r=0.25, copies=5) for chain in ([effect], []))
    np.testing.assert_allclose(one.states, other.states, rtol=1e-12, atol=1e-12)
    assert (one.measurements != other.measurements).any()
    one, other = (run_of(chain, copies=5, channel="speed") for chain in ([effect], [NOTHING]))
    np.testing.assert_array_equal(one.states, other.states)
    np.testing.assert_array_equal(one.thrusts, other.thrusts)


# Channels, or effects on the thrust, and what the message must say.
WRONG = [
    ("thrust", "sensors must be a list of channels or a mapping"),
    ([], "sensors must name at least one channel"),
    (["thrust", "thrust"], "sensors must name each channel once"),
    (["torque"], "a channel of sensors must be one of thrust, speed, speed-magnitude, current, but got 'torque'"),
    ({"name": "fog"}, "each entry of sensors must be a mapping whose name is one of student-t"),
    ({"name": ["bias"]}, "each entry of sensors must be a mapping whose name is one of student-t"),
    ({"name": "dead-band", "width": 1.0}, "each entry of sensors must be a mapping whose name"),
    ({"name": "quantisation"}, "'quantisation' must be given step, but got {}"),
    ({"name": "bias", "size": 1, 2: 3}, r"arguments of 'bias' must be among value, std, drift, but got \[2"),
    ({"name": "student-t", "scale": -1}, "scale must be zero or positive, but got -1"),
    ({"name": "student-t", "scale": 1, "degrees": 0.5}, "degrees must be at least 1, but got 0.5"),
    ({"name": "outliers", "std": 1, "probability": 1.1}, "probability must be within"),
    ({"name": "outliers", "std": "wide"}, "std must be a finite number, but got 'wide'"),
    ({"name": "quantisation", "step": 0}, "step must be positive, but got 0"),
    ({"name": "saturation", "low": 1, "high": 1}, "low must be less than high, but got"),
    ({"name": "dropout", "probability": 1.0}, "probability must be less than 1, but got 1.0"),
    ({"name": "dropout", "probability": 0.8, "mean_length": 2}, "mean_length must be at least 4"),
    ({"name": "delay", "steps": 1.5}, "steps must be a whole number of at least 1, but got 1.5"),
]


@pytest.mark.parametrize(("sensors", "message"), WRONG)
def test_wrong_sensors_are_refused_with_the_rule(sensors, message):
    with pytest.raises(ValueError, match=message) as error:
        make_plant(sensors={"thrust": [sensors]} if isinstance(sensors, dict) else sensors)
    assert "\n" not in str(error.value)


def test_effects_may_be_objects_or_one_mapping():
    for given in (Quantisation(0.5), [Quantisation(0.5)], {"name": "quantisation", "step": 0.5}):
        assert make_plant(sensors={"thrust": given}).sensors == {"thrust": (Quantisation(0.5),)}
