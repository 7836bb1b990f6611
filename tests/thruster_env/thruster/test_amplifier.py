"""The amplifier: the voltage that reaches the motor, against naive formulas, and what the reward is told."""

import math

import gymnasium as gym
import numpy as np
import pytest

import thruster_env  # noqa: F401 - registers the envs
from thruster_env.core.streams import episode_keys
from thruster_env.thruster.analysis import run_substeps
from thruster_env.thruster.equations import copies_of
from thruster_env.thruster.parameters import PRESETS, TUNNEL_PHYSICAL
from thruster_env.thruster.plant import Task, make_plant

DT = 0.01
DEAD_BAND, SLEW = {"name": "dead-band", "width": 1.5}, {"name": "slew-limit", "rate": 300.0}
SATURATION, SAG = {"name": "saturation", "limit": 10.0}, {"name": "sag", "fraction": 0.2}
EFFECTS = [DEAD_BAND, SLEW, SATURATION, SAG]


# The same four, one number at a time, with the voltage before and the motor's speed.
def dead_band(voltage, before, omega, back_emf):
    if abs(voltage) <= 1.5:
        return 0.0
    return voltage - 1.5 if voltage > 0 else voltage + 1.5


def slew_limit(voltage, before, omega, back_emf):
    if voltage > before + 3.0:
        return before + 3.0
    return before - 3.0 if voltage < before - 3.0 else voltage


def saturation(voltage, before, omega, back_emf):
    return math.copysign(min(abs(voltage), 10.0), voltage)


def sag(voltage, before, omega, back_emf):
    return 0.8 * voltage + 0.2 * back_emf * omega


NAIVE = {"dead-band": dead_band, "slew-limit": slew_limit, "saturation": saturation, "sag": sag}


def trace(effects, voltages, preset="tunnel", **arguments):
    """Commanded and applied voltages (K,) and states (K + 1, 2) of one thruster without noise."""
    plant = make_plant(preset, amplifier=effects, process_noise_cov=[0, 0], initial_state=[20.0, 0.5], **arguments)
    copies = copies_of(plant, Task(), 1)
    reports = [copies.begin(episode_keys([0]))[:, 0]]
    reports += [copies.step(np.array([voltage]))[:, 0] for voltage in voltages]
    applied, states = (np.array(reports)[:, copies.report_rows[name]] for name in ("voltage", "state"))
    return np.clip(voltages, -plant.max_voltage, plant.max_voltage), applied[1:], states, plant


def commands(count=200, top=40.0):
    """Noise, edges of the dead band and of the range, rest, and slow ramps."""
    rng = np.random.default_rng(4)
    edges = [1.5, -1.5, 1.5000001, -1.4999999, 0.0, -0.0, 24.0, -24.0, 10.0, math.inf, -math.inf, 1e300]
    return np.concatenate([rng.uniform(-top, top, count), edges, np.linspace(-30, 30, 50), np.zeros(20)])


CHAINS = [[effect] for effect in EFFECTS] + [EFFECTS, EFFECTS[::-1], [SLEW, DEAD_BAND], [SLEW, SATURATION, SLEW]]


@pytest.mark.parametrize("chain", CHAINS, ids=lambda chain: ", ".join(effect["name"] for effect in chain))
@pytest.mark.parametrize("preset", ["tunnel", "tunnel_physical"])
def test_the_applied_voltage_is_the_naive_one_and_moves_the_motor(chain, preset):
    commanded, applied, states, plant = trace(chain, commands(), preset)
    p = PRESETS[preset]
    np.testing.assert_array_equal(commanded, np.clip(commands(), -24, 24))
    before = [0.0] * len(chain)
    for k, voltage in enumerate(commanded):
        for i, effect in enumerate(chain):
            back_emf = p.motor_damping / p.voltage_gain
            voltage = NAIVE[effect["name"]](voltage, before[i], states[k, 0], back_emf)
            before[i] = voltage
        assert applied[k] == pytest.approx(voltage, rel=1e-12, abs=1e-12)
        moved = run_substeps(tuple(states[k]), (applied[k], 0.0), p, DT, plant.substeps)
        np.testing.assert_allclose(states[k + 1], moved, rtol=1e-10, atol=1e-12)


def test_without_effects_the_voltage_is_the_command():
    commanded, applied, _, _ = trace(None, commands())
    np.testing.assert_array_equal(applied, commanded)


def test_a_slew_limit_counts_volts_a_second():
    for dt, change in ((0.01, 3.0), (0.001, 0.3)):
        applied = trace([SLEW], np.full(8, 24.0), dt=dt)[1]
        np.testing.assert_allclose(applied, np.minimum(change * np.arange(1, 9), 24.0), rtol=1e-12)


def test_a_slew_limit_starts_at_zero_in_every_episode():
    copies = copies_of(make_plant(amplifier=[SLEW]), Task(), 1)
    for _ in range(3):
        copies.begin(episode_keys([0]))
        for k in range(1, 5):
            report = copies.step(np.array([-24.0]))
            assert report[copies.report_rows["voltage"], 0] == pytest.approx(-3.0 * k)


def test_effects_do_not_commute():
    jump = np.full(10, 24.0)
    assert trace([DEAD_BAND, SLEW], jump)[1][0] == pytest.approx(3.0)
    assert trace([SLEW, DEAD_BAND], jump)[1][0] == pytest.approx(1.5)


def test_sag_slows_the_motor_down_to_where_the_torques_balance():
    """(1 - f) (K2 V - K1 omega) = K_h Q, for V_s = V - f (V - k_e omega) with k_e = K1/K2."""
    p = TUNNEL_PHYSICAL
    states = trace([SAG], np.full(1500, 12.0), "tunnel_physical")[2]
    weaker = p._replace(load_gain=p.load_gain / 0.8)
    end = states[-1]
    still = run_substeps(tuple(end), (12.0, 0.0), weaker, DT, 12)
    np.testing.assert_allclose(still, end, rtol=1e-6)
    assert end[0] < trace(None, np.full(1500, 12.0), "tunnel_physical")[2][-1, 0]


def test_a_current_is_that_of_the_applied_voltage():
    env = gym.make("BowThruster-v0", sensors=["current"], measurement_noise_cov=0, amplifier=[SATURATION])
    env.reset(seed=1)
    info = env.step([24.0])[4]
    p = PRESETS["tunnel"]
    current = p.voltage_gain * (p.voltage_gain * 10.0 - p.motor_damping * info["state"][0])
    assert info["measurement"][0] == pytest.approx(current / (p.load_gain * p.motor_damping), rel=1e-12)


def test_a_thruster_without_load_has_no_current():
    with pytest.raises(ValueError, match="load_gain must be positive for a motor current"):
        make_plant(TUNNEL_PHYSICAL._replace(load_gain=0.0), sensors=["current"])


@pytest.mark.parametrize("amplifier", [None, EFFECTS], ids=["none", "all"])
def test_the_reward_is_told_of_the_commanded_clipped_voltage(amplifier):
    weights = {"tracking_weight": 0.0, "energy_weight": 0.7, "voltage_rate_weight": 0.3}
    env = gym.make("BowThruster-v0", amplifier=amplifier, max_voltage=12.0, **weights)
    for _ in range(2):  # the second episode forgets the first one's last voltage
        env.reset(seed=0)
        before = 0.0
        for voltage in (5.0, 40.0, -40.0, 1.0, 1.0, -math.inf):
            clipped = min(max(voltage, -12.0), 12.0)
            expected = -0.7 * (clipped / 12) ** 2 - 0.3 * ((clipped - before) / 12) ** 2
            assert env.step([voltage])[1] == pytest.approx(expected, rel=1e-12, abs=1e-15)
            before = clipped


def test_no_amplifier_changes_anything_where_it_does_not_reach():
    mild = [{"name": "dead-band", "width": 0.0}, {"name": "slew-limit", "rate": 1e9}]
    mild += [{"name": "saturation", "limit": 24.0}, {"name": "sag", "fraction": 0.0}]
    np.testing.assert_allclose(trace(mild, commands())[2], trace(None, commands())[2], rtol=1e-12, atol=1e-12)


WRONG = [
    ("sag", "amplifier must be a list of mappings with a name, but got 'sag'"),
    ([{"name": "hum"}], "each entry of amplifier must be a mapping whose name is one of dead-band, slew-limit"),
    ([{"name": "bias"}], "each entry of amplifier must be a mapping whose name"),
    ([{"name": "dead-band"}], "'dead-band' must be given width, astern, but got {}"),
    ([{"name": "dead-band", "width": -1}], "width must be zero or positive, but got -1"),
    ([{"name": "slew-limit", "rate": 0}], "rate must be positive, but got 0"),
    ([{"name": "saturation", "limit": math.inf}], "limit must be a finite number, but got inf"),
    ([{"name": "saturation", "low": 1, "high": 2}], "arguments of 'saturation' must be among limit, but got"),
    ([{"name": "sag", "fraction": 1.0}], "fraction must be less than 1, but got 1.0"),
    ([{"name": "sag", "fraction": -0.1}], "fraction must be zero or positive, but got -0.1"),
]


@pytest.mark.parametrize(("amplifier", "message"), WRONG)
def test_wrong_amplifiers_are_refused_with_the_rule(amplifier, message):
    with pytest.raises(ValueError, match=message) as error:
        make_plant(amplifier=amplifier)
    assert "\n" not in str(error.value)
