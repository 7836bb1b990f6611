"""What a gap and outliers did to identified constants, and what cutting there and a gate make of it."""

from functools import cache

import numpy as np
import pytest

import tuning
from thruster_env.core.streams import episode_keys
from thruster_env.model.affine import affine_model
from thruster_env.model.simulate import simulate
from tuning.likelihood.identify import validate
from tuning.logs.problem import LoggedFamily, remarks

DT, COOLING, SPEED = 0.1, 52_000.0, 55.0  # [s], [J/(min K)], [rad/s/V]
HEAT, PERIOD = 6e5, 25  # heat capacity [J/K]; rows for which the coolant keeps its temperature


def kettle(cooling=48_000.0, process_noise_cov=1e-4, measurement_noise_cov=0.01):
    """A cooled kettle: T' = cooling (T_c - T)/heat, in minutes of sixty rows."""
    kept = 1.0 - cooling * DT / HEAT
    return affine_model(
        a=[[kept]], b=[[1.0 - kept]], c=[[1.0]], process_noise_cov=[process_noise_cov],
        measurement_noise_cov=[measurement_noise_cov], prior_mean=[0.0], prior_cov=[0.01],
        states=[("temperature", "T", "K")], input_quantities=[("coolant", "u", "K")],
        measurements=[("thermometer", "z", "K")],
    )  # fmt: skip


def motor(gain=50.0, process_noise_cov=1.0, measurement_noise_cov=25.0):
    """A motor whose speed follows its voltage: w' = (gain u - w)/(0.5 s)."""
    return affine_model(
        a=[[0.8]], b=[[0.2 * gain]], c=[[1.0]], process_noise_cov=[process_noise_cov],
        measurement_noise_cov=[measurement_noise_cov], prior_mean=[0.0], prior_cov=[1.0],
        states=[("speed", "w", "rad/s")], input_quantities=[("voltage", "u", "V")],
        measurements=[("tachometer", "z", "rad/s")],
    )  # fmt: skip


def table(model, size, rows, seed):
    """A run of a model under levels of its input."""
    u = np.random.default_rng(seed).uniform(-size, size, rows // PERIOD).repeat(PERIOD)
    drawn = simulate(model, episode_keys([seed]), u[None, :-1, None])
    return {"time_s": DT * np.arange(rows), "u": u, "z": drawn.measurements[0, :, 0].copy()}


def found_in(run, make, free, hold_gaps=False, **options):
    return tuning.identify(
        tuning.read_logs(run, model=make, hold_gaps=hold_gaps), free, starts=1, use_all=True, **options
    )


def test_a_late_actuator_has_a_negative_clock_offset_that_its_file_takes_off(tmp_path):
    run = table(motor(), 8.0, 300, seed=5)
    run["u"] = np.r_[run["u"][3:], run["u"][-1:], run["u"][-1:], run["u"][-1:]]  # it acts three rows later
    options = {"noise": False, "start": {"clock_offset_u": -0.25}, "progress": False}
    late = found_in(run, motor, "gain,clock_offset_u", **options)
    assert late.values["clock_offset_u"] == pytest.approx(-3 * DT, abs=0.1 * DT)
    assert late.values["gain"] == pytest.approx(50.0, abs=4.0 * late.standard_errors["gain"])
    reading = tuning.read_logs(run, model=motor, preset=late.save(tmp_path / "late.toml"))
    log, _ = reading.read()
    assert log.offsets == {"input:u": late.values["clock_offset_u"]}
    read_with = tuning.read_logs(run, model=motor, clock_offset={"z": 0.05})
    parameter = LoggedFamily([read_with.read()[0]], motor, ["clock_offset_z"]).free[0]
    assert (parameter.default, parameter.low, parameter.high) == pytest.approx((0.05, -0.95, 1.05))
    with pytest.raises(ValueError, match="clock_offset_z, clock_offset_u, but got 'clock_offset_T'"):
        found_in(run, motor, "gain,clock_offset_T")


@cache
def gap(hold):
    run = table(kettle(COOLING), 30.0, 600, seed=2)
    kept = np.r_[0:280, 320:600]
    return found_in({name: one[kept] for name, one in run.items()}, kettle, "cooling", hold_gaps=hold)


def test_a_constant_beside_a_gap_is_within_its_standard_error_where_the_run_is_cut_there():
    cut = gap(False)
    assert abs(cut.values["cooling"] - COOLING) < 3.9 * cut.standard_errors["cooling"]
    assert abs(cut.values["Q11"] - 1e-4) < 3.9 * cut.standard_errors["Q11"]


def test_held_over_the_gap_it_is_off_by_several_and_q_much_too_large():
    cut, held = gap(False), gap(True)
    assert abs(held.values["cooling"] - COOLING) > 3.9 * cut.standard_errors["cooling"]
    assert held.values["Q11"] > 10 * cut.values["Q11"]
    assert held.standard_errors["cooling"] > 3 * cut.standard_errors["cooling"]


def test_outliers_name_the_gate_and_with_it_the_constant_is_nearer():
    run = table(motor(SPEED), 2.0, 500, seed=3)
    loaded = np.flatnonzero(run["u"] > 0.8)  # where the tachometer's brushes spark
    run["z"][np.random.default_rng(4).choice(loaded, 12, replace=False)] += 150.0
    plain, gated = (found_in(run, motor, "gain", **options) for options in ({}, {"gate": 5.0}))
    unaware, said = (" ".join(one.sentences()) for one in (plain, gated))
    assert "--gate 5" in unaware and "--gate 5" not in said
    assert "within the gate: a filter" not in unaware
    assert (
        "needs a gate (session(gate=5)), or to be robust (ekf-robust). Figures of the runs it has seen are "
        in said
    )
    whole = validate(gated.found, gated.runs)
    assert gated.validation["identified"].log_likelihood > whole["identified"].log_likelihood + 100.0
    proven = remarks(gated.runs, gated.runs, gated.found)
    assert proven[-1].endswith("(ekf-robust). Figures of held-out runs count all samples.")
    assert abs(gated.values["gain"] - SPEED) < 3.9 * gated.standard_errors["gain"]
    assert abs(gated.values["gain"] - SPEED) < abs(plain.values["gain"] - SPEED) / 2
    assert gated.standard_errors["gain"] < plain.standard_errors["gain"] / 2
