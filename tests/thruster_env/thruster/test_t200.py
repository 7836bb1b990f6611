import csv
import math

import numpy as np
import pytest

from thruster_env.thruster.analysis import jacobians, required_substeps, steady_state
from thruster_env.thruster.dynamics import thrust_and_torque
from thruster_env.thruster.parameters import PRESETS, T200, checked, derive_constants
from tuning.plants.bollard import (
    FITTED,
    T200_PULSE_WIDTHS,
    Identified,
    PulseWidthMap,
    bollard_forces,
    identify_bollard,
    predict,
    read_bollard,
    relative_errors,
)

PRESET = Identified(T200, T200_PULSE_WIDTHS)
OTHER = Identified(
    T200._replace(
        lift_coefficient=0.5, drag_coefficient=0.2, thrust_asymmetry=0.1, motor_damping=60.0, voltage_gain=2500.0
    ),
    PulseWidthMap(droop=0.01, astern_gain=0.9),
)
# Quoted from the table: supply [V], pulse width [us], speed [rpm], force [kgf].
QUOTED = (
    (12, 1900, 2994.56, 3.71416),
    (16, 1900, 3533.45, 5.24504),
    (20, 1900, 3930.98, 6.72223),
    (12, 1100, 2975.71, -2.90374),
    (16, 1100, 3464.71, -4.06948),
    (20, 1100, 3782.51, -5.03563),
    (12, 1700, 1796.49, 1.27913),
    (16, 1300, 2140.15, -1.43789),
)


def identified_numbers(found):
    return {name: getattr(found.thruster, name) for name in FITTED} | found.pulse_widths._asdict()


def recorded_rows(found):
    """What a recorder of the thruster `found` would write, in the public table's form; slow speeds become 0."""
    c, back_emf = derive_constants(found.thruster), found.thruster.motor_damping / found.thruster.voltage_gain
    for supply in range(10, 21, 2):
        for pulse_width in range(1100, 1901, 20):
            voltage = float(found.pulse_widths.source_voltage(pulse_width, supply))
            state = steady_state(found.thruster, voltage)
            rpm = abs(state.omega_m) * 30 / math.pi
            torque = abs(thrust_and_torque((state.omega_m, state.U_a), c)[1])
            current = torque / back_emf * abs(pulse_width - 1500) / 400
            if rpm < 300:
                yield pulse_width, 0, 0, supply, 0, 0, 0
            else:
                yield pulse_width, rpm, current, supply, supply * current, state.thrust / 9.80665, 1


def write_table(path, rows):
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["pwm_us", "rpm", "current_A", "voltage_V", "power_W", "force_kgf", "efficiency_g_per_W"])
        writer.writerows(rows)
    return path


@pytest.fixture(scope="module")
def table_path(tmp_path_factory):
    return write_table(tmp_path_factory.mktemp("t200") / "table.csv", recorded_rows(OTHER))


def test_a_table_gives_its_thruster_back(table_path):
    table = read_bollard(table_path)
    found = identify_bollard(table, (14.0, 18.0), T200)
    expected = identified_numbers(OTHER)
    assert identified_numbers(found) == pytest.approx(expected, rel=1e-5)
    for groups in relative_errors(found, table, (14.0, 18.0)).values():
        for group in groups.values():
            assert max(e["90 %"] for e in group.values()) < 1e-5


def test_only_fitted_voltages_count(table_path):
    table = read_bollard(table_path)
    spoilt = table._replace(thrust=np.where(table.supply == 14, 2 * table.thrust, table.thrust))
    assert identify_bollard(spoilt, (14.0,), T200) == identify_bollard(table, (14.0,), T200)
    errors = relative_errors(OTHER, spoilt, (14.0,))["thrust from measured speed"]
    assert errors["held out"]["ahead"]["median"] == pytest.approx(0.5)
    assert errors["fitted"]["ahead"]["median"] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("ahead", [True, False])
def test_current_counts_in_both_directions(table_path, ahead):
    table = read_bollard(table_path)
    more = table._replace(current=np.where(table.ahead == ahead, 1.2 * table.current, table.current))
    drag = [identify_bollard(rows, (14.0,), T200).thruster.drag_coefficient for rows in (table, more)]
    assert drag[1] > 1.01 * drag[0]


def test_slow_rows_are_left_out(table_path):
    table = read_bollard(table_path)
    assert len(table.speed) < 6 * 41
    for supply in range(10, 21, 2):
        for ahead in (True, False):
            speeds = table.speed[(table.supply == supply) & (table.ahead == ahead)]
            assert speeds.min() > speeds.max() / 4
    assert (table.thrust > 0).all()


def test_time_constants_do_not_show_in_a_static_table(table_path):
    table = read_bollard(table_path)
    slower = T200._replace(
        load_gain=T200.load_gain / 3, motor_damping=T200.motor_damping / 3, voltage_gain=T200.voltage_gain / 3
    )._replace(added_mass=2 * T200.added_mass)
    one, other = (predict(Identified(p, T200_PULSE_WIDTHS), table) for p in (T200, slower))
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)


def test_the_preset_is_a_preset():
    assert PRESETS["t200"] == T200 == checked(T200)
    assert T200.momentum_drag == pytest.approx(1.5 * T200.density * T200.area, rel=1e-4)
    length = 0.05 + 1.22 * T200.diameter / 2
    assert T200.added_mass == pytest.approx(T200.density * T200.area * length, rel=1e-4)


def test_the_preset_has_the_measured_coefficients_and_its_asymmetry_hardly_shows_in_torque():
    unit = T200.density * T200.diameter**4 / (2 * math.pi) ** 2  # thrust over K_T omega_m^2
    (thrust_astern, torque_astern), (thrust, torque) = bollard_forces(T200)
    assert thrust / unit == pytest.approx(0.429, rel=0.015)
    assert thrust_astern / unit == pytest.approx(0.335, rel=0.015)
    assert torque / unit / T200.diameter == pytest.approx(0.0566, rel=0.04)
    assert 1.0 < torque_astern / torque < 1.06
    assert steady_state(T200, -13.0).omega_m == pytest.approx(-steady_state(T200, 13.0).omega_m, rel=0.015)


def test_the_preset_agrees_with_the_public_table():
    from_speed, from_pulse_width, speeds = [], [], []
    for supply, pulse_width, rpm, force in QUOTED:
        state = steady_state(T200, float(T200_PULSE_WIDTHS.source_voltage(pulse_width, supply)))
        at_measured_speed = state.thrust * (rpm * math.pi / 30 / state.omega_m) ** 2
        from_speed.append(at_measured_speed / (force * 9.80665) - 1)
        from_pulse_width.append(state.thrust / (force * 9.80665) - 1)
        speeds.append(abs(state.omega_m) / (rpm * math.pi / 30) - 1)
    assert np.abs(from_speed).max() < 0.1  # full throttle at 20 V is the worst
    assert np.abs(from_pulse_width).max() < 0.1
    assert np.median(np.abs(from_pulse_width)) < 0.05
    assert np.abs(speeds).max() < 0.06


def test_the_shaft_gives_more_power_than_the_jet_takes():
    for voltage in (13.0, -13.0):
        state = steady_state(T200, voltage)
        thrust, torque = thrust_and_torque((state.omega_m, state.U_a), derive_constants(T200))
        assert 0.45 < thrust * state.U_a / (torque * state.omega_m) < 0.8


def test_few_substeps_and_stable_real_poles():
    assert required_substeps(T200, 0.01, 13.0) <= 4
    assert required_substeps(T200, 0.01, 24.0) <= 6
    for voltage in (8.3, 13.3, -8.4, -13.4):
        poles = np.linalg.eigvals(jacobians(T200, steady_state(T200, voltage)[:2], voltage)[0])
        assert np.isreal(poles).all()
        assert (poles < -60).all() and (poles > -180).all()


def test_pulse_widths_become_voltages():
    controller = PulseWidthMap(droop=0.02, astern_gain=0.9)
    voltages = controller.source_voltage([1100, 1300, 1472, 1500, 1528, 1700, 1900, 2000], 10.0)
    np.testing.assert_allclose(voltages, [-7.2, -3.6, 0.0, 0.0, 0.0, 4.0, 8.0, 8.0])
    assert float(controller.source_voltage(1900, 20.0)) == pytest.approx(12.0)


def test_the_table_of_the_preset_gives_the_preset(tmp_path):
    table = read_bollard(write_table(tmp_path / "own.csv", recorded_rows(PRESET)))
    found = identify_bollard(table, (14.0, 18.0), T200)
    assert identified_numbers(found) == pytest.approx(identified_numbers(PRESET), rel=1e-3)
    medians = {
        quantity: max(e["median"] for group in groups.values() for e in group.values())
        for quantity, groups in relative_errors(found, table, (14.0, 18.0)).items()
    }
    assert medians["thrust from measured speed"] < 0.03 and medians["thrust from pulse width and supply"] < 0.05


@pytest.mark.parametrize(
    ("content", "rule"),
    [
        (None, "a file that can be read, but"),
        ("", "must have a header and rows"),
        ("pwm_us,rpm,current_A,voltage_V\n1100,1,1,10\n", "but lacks force_kgf"),
        ("pwm_us,rpm,current_A,voltage_V,force_kgf\n", "must have a header and rows"),
        ("pwm_us,rpm,current_A,voltage_V,force_kgf\n1100,900,1,10,-1\n1900,fast,1,10,1\n", "'fast' in line 3"),
        ("pwm_us,rpm,current_A,voltage_V,force_kgf\n1100,900,1,10\n", "line 2"),
        ("pwm_us,rpm,current_A,voltage_V,force_kgf\n1100,900,1,10,-1\n", "must turn ahead at 10 V"),
        ("pwm_us,rpm,current_A,voltage_V,force_kgf\n1100,900,1,10,1\n1900,900,1,10,1\n", "in the direction"),
        ("pwm_us,rpm,current_A,voltage_V,force_kgf\n1100,900,1,10,-1\n1900,900,0,10,1\n", "above zero"),
        ("pwm_us,rpm,current_A,voltage_V,force_kgf\n1100,900,1,10,-1\n1900,900,1,10,1\n", "must be some of 10 V"),
        ("\x00\xff", "must"),
    ],
)
def test_a_bad_file_is_refused(tmp_path, content, rule):
    path = tmp_path / "bad.csv"
    if content is not None:
        path.write_bytes(content.encode("latin-1"))
    with pytest.raises(ValueError, match=rule):
        identify_bollard(read_bollard(path), (14.0, 18.0), T200)


@pytest.mark.parametrize("held_out", [(13.0,), (10.0, 12.0, 14.0, 16.0, 18.0), ()])
def test_held_out_voltages_are_checked(table_path, held_out):
    with pytest.raises(ValueError, match="held-out voltages must be some of 10, 12, 14, 16, 18, 20 V"):
        identify_bollard(read_bollard(table_path), held_out, T200)
