"""Units of the columns of logs: in headers, converted with and without a further package, and of times."""

import sys

import numpy as np
import pytest

from tests.thruster_env.logs.test_logs import MODEL, log_of
from thruster_env.logs.columns import converted, parted
from thruster_env.logs.read import read_log


@pytest.mark.parametrize(
    ("header", "base", "unit"),
    [
        ("omega_m_rad_per_s", "omega_m", "rad/s"),
        ("y_tach_abs_rad_s", "y_tach_abs", "rad/s"),
        ("U_a_m_per_s", "U_a", "m/s"),
        ("a_m_per_s2", "a", "m/s^2"),
        ("time_s", "time", "s"),
        ("load cell [kgf]", "load cell", "kgf"),
        ("loadcell_N", "loadcell", "N"),
        ("x_1", "x_1", None),
        ("force_x", "force_x", None),
        ("m_s", "m", "s"),
        ("U_uV", "U", "uV"),
        ("p_hPa", "p", "hPa"),
        ("torque_mNm", "torque", "mNm"),
        ("acc_mg", "acc", "mg"),
        ("U_parsec", "U", "parsec"),
        ("wind_knots_measured", "wind_knots_measured", None),
    ],
)
def test_a_header_tells_its_unit(header, base, unit):
    assert parted(header) == (base, unit)


def test_units_are_converted(tmp_path):
    pytest.importorskip("pint")
    text = "t_ms,supply [mV],motor_rpm\n0,1000,60\n100,2000,120\n200,0,180\n"
    columns = {"V_s": "supply [mV]", "tach": "motor_rpm"}
    log = log_of(tmp_path / "run.csv", text, columns=columns)
    assert log.dt == pytest.approx(0.1)
    np.testing.assert_allclose(log.inputs[:, 0], [1.0, 2.0])
    np.testing.assert_allclose(log.measurements[:, 0], 2 * np.pi * np.array([1, 2, 3]))
    again = log_of(tmp_path / "b.csv", text.replace("_rpm", ""), columns=columns | {"tach": "motor[rpm]"})
    np.testing.assert_array_equal(again.measurements, log.measurements)
    for unit, said in (
        ("kgf", "must be one that converts to rad/s, but got 'kgf'"),
        ("furl", "must be one that pint knows"),
    ):
        with pytest.raises(ValueError, match=f"the unit of column 'motor' of .*b.csv {said}"):
            read_log(tmp_path / "b.csv", MODEL, columns | {"tach": f"motor[{unit}]"})


def test_an_unknown_unit_at_the_end_of_a_header_is_never_volts(tmp_path):
    pytest.importorskip("pint")
    text = "t,U_parsec,tach\n0,1,2\n0.1,2,3\n0.2,0,4\n"
    with pytest.raises(ValueError, match="unit of column 'U_parsec' of .*run.csv must be one that converts to V"):
        log_of(tmp_path / "run.csv", text, columns={"V_s": "U_parsec"})
    assert log_of(tmp_path / "b.csv", text, columns={"V_s": "U_parsec[V]"}).inputs[1, 0] == 2.0


@pytest.mark.parametrize(
    ("unit", "wanted", "factor"),
    [
        ("mV", "V", 1e-3),
        ("g", "m/s^2", 9.80665),
        ("mg", "m/s^2", 9.80665e-3),
        ("g_0", "m/s^2", 9.80665),
        ("g0", "m/s^2", 9.80665),
        ("mg_0", "m/s/s", 9.80665e-3),
        ("m/s^2", "g", 1 / 9.80665),
        ("m/s/s", "m/s^2", 1.0),
        ("m/s2", "mm/s^2", 1e3),
        ("g", "kg", 1e-3),
        ("mg", "kg", 1e-6),
        ("g", "g_0", 1.0),
        ("ms", "s", 1e-3),
        ("µA", "A", 1e-6),
        ("min", "s", 60.0),
        ("rpm", "rad/s", 2 * np.pi / 60),
        ("deg/min", "rad/s", np.pi / 180 / 60),
        ("rad/s", "rpm", 60 / (2 * np.pi)),
        ("mm/s^2", "m/s^2", 1e-3),
        ("kNm", "N*m", 1e3),
        ("g", "kg", 1e-3),
        ("Hz", "rad/s", 2 * np.pi),
        ("kHz", "rad/s", 2e3 * np.pi),
        ("rps", "rad/s", 2 * np.pi),
        ("rev/s", "rad/s", 2 * np.pi),
        ("rad/s", "Hz", 1 / (2 * np.pi)),
        ("Hz", "rpm", 60.0),
        ("rpm", "Hz", 1 / 60),
        ("degC/min", "K/s", 1 / 60),
        ("minutes", "s", 60.0),
        ("days", "s", 86400.0),
    ],
)
def test_simple_units_need_no_package(monkeypatch, unit, wanted, factor):
    monkeypatch.setitem(sys.modules, "pint", None)
    np.testing.assert_allclose(converted(np.array([3.0]), unit, wanted, "here"), [3.0 * factor], rtol=1e-15)
    for other in ("hp", "kgf", "min"):
        with pytest.raises(ValueError, match="units must be converted by pint, which is not installed"):
            converted(np.array([3.0]), other, "K", "here")


@pytest.mark.parametrize(
    ("unit", "wanted", "value"),
    [
        ("degC", "K", 293.15),
        ("K", "degC", -253.15),
        ("degF", "degC", -20 / 3),
        ("°C", "degF", 68.0),
        ("degF", "K", 266.4833333333333),
    ],
)
def test_temperatures_have_their_zero(monkeypatch, unit, wanted, value):
    monkeypatch.setitem(sys.modules, "pint", None)
    np.testing.assert_allclose(converted(np.array([20.0]), unit, wanted, "here"), [value], rtol=1e-12)


def test_what_may_be_turns_or_radians_is_refused():
    for unit, wanted in (("1/min", "rad/s"), ("s^-1", "rpm"), ("rpm", "1/s")):
        with pytest.raises(ValueError, match="here must say whether it counts turns or radians .rpm, Hz"):
            converted(np.ones(1), unit, wanted, "here")


def test_known_units_agree_with_pint():
    pint = pytest.importorskip("pint")
    for unit in ("rps", "rpm", "deg/min", "turn/s", "turn/hour"):
        there = pint.application_registry.get().Quantity(1.0, unit).to("rad/s").magnitude
        assert converted(np.ones(1), unit, "rad/s", "here")[0] == pytest.approx(there, rel=1e-12)


def test_time_in_minutes_is_understood_or_refused(tmp_path):
    rows = "\n0,1,2\n1,2,3\n2,3,4\n"
    for header, dt in (("t [min]", 60.0), ("time_ms", 1e-3), ("time (h)", 3600.0), ("time_minutes", 60.0)):
        assert log_of(tmp_path / "run.csv", f"{header},voltage,tach{rows}").dt == pytest.approx(dt)
    with pytest.raises(ValueError, match="the unit of column 't .fortnights and more|units must be converted"):
        log_of(tmp_path / "run.csv", f"t [fortnights and more],voltage,tach{rows}")


def test_a_header_may_be_named_without_its_unit(tmp_path):
    text = "t,U_mot [mV],n_mot (rpm)\n0,1000,60\n0.1,2000,120\n0.2,0,180\n"
    log = log_of(tmp_path / "run.csv", text, columns={"V_s": "U_mot", "tach": "n_mot"})
    np.testing.assert_allclose(log.inputs[:, 0], [1.0, 2.0])
    np.testing.assert_allclose(log.measurements[:, 0], 2 * np.pi * np.array([1, 2, 3]))
    two = text.replace("n_mot (rpm)", "U_mot [V]")
    with pytest.raises(ValueError, match="the column for V_s must be one of t, U_mot"):
        log_of(tmp_path / "run.csv", two, columns={"V_s": "U_mot"})


def test_brackets_without_a_unit_say_none():
    rows = np.arange(9.0)
    model = MODEL.replace(measurements=[("duty", "z", "")])
    for header in ("duty []", "duty [-]", "duty (1)", "z[ ]"):
        log = read_log({"time": rows, "voltage []": rows % 2, header: rows}, model)
        np.testing.assert_array_equal(log.measurements[:, 0], rows)
    with pytest.raises(ValueError, match="must be one that"):
        read_log({"time": rows, "voltage [-]": rows % 2, "duty": rows}, model)


@pytest.mark.parametrize("unit, value", [("mK", 307353.0), ("K", 307.353), ("degF", 93.5654), ("uK", 307353e3)])
def test_a_temperature_of_any_prefix_has_the_zero_of_the_other(unit, value):
    assert converted(np.array([value]), unit, "degC", "z")[0] == pytest.approx(34.203, abs=1e-9)
    assert converted(np.array([34.203]), "degC", unit, "z")[0] == pytest.approx(value, rel=1e-9)
