"""What is found in logs: gaps, stuck and saturated sensors, outliers, rows moved, dropped and doubled."""

from dataclasses import replace

import numpy as np
import pytest

from tests.thruster_env.logs.test_logs import MODEL
from tests.tuning.test_log_problem import logs_of
from thruster_env.logs.findings import has_outliers, outliers, remarks_on, sentences, turn_of
from thruster_env.logs.read import read_log
from tuning.problems.find import find_problem


def recorded(steps=1000, seed=0, quantum=0.0):
    """A noisy channel behind an input that switches, as a table."""
    rng = np.random.default_rng(seed)
    times = 0.01 * np.arange(steps)
    voltage = np.sign(np.sin(2.0 * times))
    speed = np.convolve(voltage, np.ones(50) / 50)[:steps] + 0.1 * rng.normal(size=steps)
    speed = np.round(speed / quantum) * quantum if quantum else speed
    return {"t": times, "voltage": voltage, "tach": speed}


def found(table, **options):
    log = read_log(table, MODEL, **options)
    return {one.kind: one for one in log.findings}, log


@pytest.mark.parametrize("quantum", [0.0, 0.05, 0.2, 1.0])
def test_nothing_is_found_in_logs_in_which_there_is_nothing(quantum):
    for seed in range(20):
        kinds, _ = found(recorded(seed=seed, quantum=quantum))
        assert not kinds


@pytest.mark.parametrize("scenario", ["nominal", "mismatch", "quantised", "dropout", "published_tunnel"])
def test_simulated_thrusters_have_healthy_sensors(scenario):
    problem = find_problem(scenario)
    model, data = problem.model(), problem.data(range(10))
    for inputs, measured in zip(data.inputs, data.measurements, strict=True):
        log = logs_of(10)[0].__class__("run", 0.01, inputs, measured, model.input_quantities, model.measurements)
        assert not log.findings


def test_a_gap_has_its_rows_and_times():
    table = recorded()
    kept = np.r_[0:300, 340:1000]
    kinds, log = found({name: values[kept] for name, values in table.items()})
    gap = kinds.pop("gap")
    assert not kinds and (gap.first, gap.last, gap.count, gap.channel) == (300, 339, 40, "")
    assert gap.sentence == "a gap: 40 rows (0.4 s) are missing in rows 300 to 339, 3 to 3.39 s"
    assert log.pieces == ((0, 300), (340, 660)) and log.dt == 0.01 and not log.irregular
    few = np.delete(np.arange(1000), [100, 200, 201])
    kinds, log = found({name: values[few] for name, values in table.items()})
    assert kinds["missing rows"].count == 3 and len(log.pieces) == 1
    assert sentences(log.findings) == ["3 of 1000 rows are missing, in 2 places; the input is held there."]


def test_rows_without_any_number_are_missing_too():
    table = recorded()
    for name in ("voltage", "tach"):
        table[name][300:340] = np.nan
    kinds, _ = found(table)
    assert kinds["gap"].count == 40
    table = recorded()
    table["tach"][300:340] = np.nan  # the input is known: nothing has to be held
    assert not found(table)[0]


@pytest.mark.parametrize("count", [12, 80, 150])
def test_a_stuck_sensor_is_found_whatever_the_input_does(count):
    table = recorded(quantum=0.02)
    table["tach"][400 : 400 + count] = table["tach"][400]
    kinds, _ = found(table)
    stuck = kinds.pop("stuck")
    assert not kinds and stuck.channel == "measurement:tach" and abs(stuck.count - count) <= 2
    assert abs(stuck.first - 400) <= 1 and "tach is stuck at" in stuck.sentence
    whole = recorded()  # the recorder repeats its last row
    for name in ("voltage", "tach"):
        whole[name][400 : 400 + count] = whole[name][400]
    assert found(whole)[0]["stuck"].count == count


def test_quantisation_and_rest_are_no_stuck_sensor():
    table = recorded(quantum=0.5)
    assert "stuck" not in found(table)[0]
    table = recorded(quantum=0.02)
    for name in ("voltage", "tach"):
        table[name][:300] = 0.0  # at rest, and the sensor has no noise there
    assert not found(table)[0]


def test_a_zero_between_jumps_is_stuck():
    table = recorded()
    table["tach"] = table["tach"] + 3.0
    table["tach"][400:430] = 0.0
    table["tach"][0] = -4.0  # so that 0 is no placeholder
    kinds, _ = found(table)
    assert kinds["stuck"].count == 30 and "tach is stuck at 0 for 30 samples" in kinds["stuck"].sentence


def test_placeholders_and_repeats_are_no_measurements():
    table = recorded()
    held = np.repeat(table["tach"][::5], 5)
    for tach, kind, left in (
        (np.where(np.arange(1000) % 100 < 3, -999.0, table["tach"]), "placeholder", np.arange(1000) % 100 >= 3),
        (held, "repeated", np.arange(1000) % 5 == 0),
        (np.round(held, 1), "repeated", np.arange(1000) % 5 == 0),  # equal neighbours among the measured ones, too
        (np.repeat(table["tach"], np.tile([2, 4, 3, 3], 250))[:1000], "repeated", None),
    ):
        kinds, log = found({**table, "tach": tach})
        finding, measured = kinds.pop(kind), ~np.isnan(log.measurements[:, 0])
        expected = np.append(True, np.diff(tach) != 0) if left is None else left
        assert not kinds and "left out" in finding.sentence
        np.testing.assert_array_equal(measured, expected)
        np.testing.assert_array_equal(log.measurements[measured, 0], tach[measured])


@pytest.mark.parametrize(("unit", "turn"), [("deg", 360.0), ("rad", 2.0 * np.pi), ("", 360.0)])
def test_an_angle_wraps_only_if_its_samples_span_a_turn(unit, turn):
    angle = np.cumsum(np.random.default_rng(0).normal(size=1000)) * turn / 20.0
    assert turn_of(np.mod(angle, turn), unit) == turn_of(np.mod(angle, turn) - 0.5 * turn, unit) == turn
    assert not turn_of(angle, unit) and not turn_of(np.mod(angle, turn), "m")
    jumps = np.where(np.arange(1000) // 100 % 2, 0.45 * turn, -0.45 * turn) + angle * 1e-4
    assert turn_of(jumps, unit) == turn  # 0.1 of a turn on the circle
    assert not turn_of(0.7 * jumps, unit)  # 0.63 of a turn, no more


def test_a_saturated_sensor_is_found():
    table = recorded()
    table["tach"] = np.clip(table["tach"], -0.95, 10.0)
    kinds, _ = found(table)
    saturated = kinds.pop("saturated")
    assert not kinds and saturated.count == (table["tach"] == -0.95).sum()
    assert "tach is at its smallest value, -0.95, in" in saturated.sentence


def test_outliers_are_found_and_jumps_are_not():
    table = recorded()
    for row in (100, 555, 800):
        table["tach"][row] += 3.0
    kinds, log = found(table)
    assert kinds.pop("outlier").count == 3 and not kinds and has_outliers([log])
    np.testing.assert_array_equal(outliers(log, "measurement:tach"), [100, 555, 800])
    assert "tach has 3 isolated outliers in rows 100 to 800" in sentences(log.findings)[-1]
    jump = recorded()
    jump["tach"][500:] += 30.0
    assert not found(jump)[0]


@pytest.mark.parametrize("count", (6, 60))
def test_a_run_of_outliers_is_a_burst_and_a_plant_that_shakes_is_none(count):
    table, rng = recorded(), np.random.default_rng(1)
    signs = rng.choice([-1.0, 1.0], count) if count > 6 else (-1.0) ** np.arange(count)
    table["tach"][500 : 500 + count] += 20.0 * signs * rng.uniform(0.5, 1.5, count)
    table["tach"][100] += 3.0
    _, log = found(table)
    burst, isolated = (finding for finding in log.findings if finding.kind == "outlier")
    assert abs(burst.first - 500) <= 4 and abs(burst.last - (499 + count)) <= 4
    assert burst.count == burst.last - burst.first + 1 and isolated.count == 1
    assert f"tach has a burst of outliers, {burst.count} samples in rows {burst.first} to " in burst.sentence
    assert set(outliers(log, "measurement:tach")) == {100, *range(burst.first, burst.last + 1)}
    for row in range(300, 900):  # of a plant that shakes for long, and with its input
        table["tach"][row] += 20.0 * (-1.0) ** row
    assert [finding.count for finding in found(table)[1].findings if finding.kind == "outlier"] in ([1], [])
    for seed in range(10):  # scattered over the log, one sample in twenty
        scattered, draws = recorded(seed=seed), np.random.default_rng(seed)
        scattered["tach"] += 5.0 * (draws.random(1000) < 0.05) * draws.choice([-1.0, 1.0], 1000)
        assert not any("burst" in finding.sentence for finding in found(scattered)[1].findings)
    driven = recorded()
    driven["voltage"][400:460] = (-1.0) ** np.arange(60)
    driven["tach"][401:461] += 10.0 * driven["voltage"][400:460]
    assert not found(driven)[0]


def test_the_sample_time_is_found_though_the_clock_jitters_and_pauses():
    rng, worst = np.random.default_rng(3), 0.0
    for _ in range(30):
        stamps = 0.01 * np.arange(1000) + rng.uniform(-0.0025, 0.0025, 1000)
        stamps[500:] += 0.4537  # the recorder pauses, and begins again between two times of the grid
        stamps = np.sort(stamps)
        table = {"t": stamps, "voltage": np.ones(1000), "tach": rng.normal(size=1000)}
        kinds, log = found(table)
        worst = max(worst, abs(log.dt - 0.01))
        assert "dropped" not in kinds and "gap" in kinds and kinds["moved"].count > 500
        assert np.isfinite(log.measurements).sum() == 1000
    assert worst < 2e-6


def test_samples_that_share_a_time_of_the_grid_are_counted():
    table = recorded()
    kinds, log = found(table, dt=0.02)
    assert kinds["dropped"].count == 499 and log.steps == 500
    assert "499 samples of tach are not used" in kinds["dropped"].sentence
    twice = {name: np.insert(values, 400, values[399]) for name, values in table.items()}
    kinds, log = found(twice)
    assert kinds["doubled"].count == kinds["dropped"].count == 1 and log.steps == 999
    np.testing.assert_array_equal(log.measurements[:, 0], table["tach"])
    seconds = {**table, "t": np.floor(table["t"])}  # a clock of whole seconds
    with pytest.raises(ValueError, match="times must increase from row to row"):
        found(seconds)


def test_many_of_one_kind_are_one_sentence():
    table = recorded(2000)
    kept = np.concatenate([np.arange(start, start + 180 - 5 * (start // 200)) for start in range(0, 2000, 200)])
    _, log = found({name: values[kept] for name, values in table.items()})
    (said,) = sentences(log.findings)
    assert len(log.pieces) == 10 and " (the longest of 9, " in said
    assert remarks_on([log, log]) == [f"a table: {said}"]
    (both,) = remarks_on([log, replace(log, name="another")])
    rows = sum(one.count for one in log.findings)
    assert both.startswith("a table: a gap: ") and both.endswith(
        f" (the longest of 18 in 2 logs, {2 * rows} rows in all)."
    )
