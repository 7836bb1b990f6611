"""`tuning.estimate` and `identify` on recorded runs: the numbers of the commands, named models, gaps, outliers."""

import copy
import json
import pickle
from functools import cache

import numpy as np
import pytest

import tuning
from filters import affine_model, make_filter, run
from filters.named import model_named
from tests.filters.checks import refused
from tests.tuning.test_api_study import plain
from thruster_env.core.streams import episode_keys
from thruster_env.logs.write import write_log
from thruster_env.model.simulate import simulate
from thruster_env.thruster.parameters import read_preset
from tuning.api.problems import problem_of
from tuning.experiments.identification import record
from tuning.likelihood.identify import validate
from tuning.logs.problem import LoggedFamily, remarks

FREE = ["motor_damping", "voltage_gain"]
OF_LOGS = ("--preset", "tunnel_physical", "--sensor", "thrust", "--sensor", "speed")
WHOSE = {"preset": "tunnel_physical", "sensors": ["thrust", "speed"]}


def read(logs, **options):
    """Logs of the thruster that has the preset and the sensors."""
    return tuning.read_logs(logs, **WHOSE, **options)


@pytest.fixture(scope="module")
def recorded():
    return record(0, 2, 150)


@pytest.fixture
def runs(recorded, tmp_path):
    for place, log in enumerate(recorded):
        write_log(tmp_path / f"run{place}.csv", log)
    return [f"run{place}.csv" for place in range(len(recorded))]


@pytest.fixture(scope="module")
def found(recorded):
    return tuning.identify(read(recorded), FREE, noise=False, starts=1, progress=False)


def test_estimate_is_the_command_in_one_call(as_json, runs, tmp_path):
    told = as_json("estimate", "run0.csv", *OF_LOGS, "--smoother", "--lag", 5, "--skip", 20, "--out", "theirs.csv")
    mine = tuning.estimate(read("run0.csv"), smoother=True, lag=5, skip=20)
    assert mine.log_likelihood == told["log_likelihood"] and mine.findings.mean_nis == told["mean_nis"]
    assert mine.log.digest == told["digest"] and mine.found.smoothed
    assert mine.save("mine.csv").read_text() == (tmp_path / "theirs.csv").read_text()
    table = mine.to_frame()
    assert len(table) == told["rows"] == 151 and table.index.name == "time_s"
    np.testing.assert_array_equal(table["omega_m_rad_per_s"], mine.means[:, 0])
    assert "mean NIS over channels" in repr(mine) and len(repr(mine)) < 200 and "nan" not in mine._repr_html_()


def test_a_pair_of_model_and_log_is_the_same_and_a_baseline_has_no_nis(recorded):
    alone = tuning.estimate(read(recorded[0]))
    pair = tuning.estimate(tuning.read_logs(("tunnel_physical", recorded[0]), sensors=WHOSE["sensors"]))
    assert pair.log_likelihood == alone.log_likelihood
    with pytest.raises(ValueError, match="'mass'"):  # the logs of the pair are read as those of the thruster
        tuning.identify(tuning.read_logs(("tunnel_physical", [recorded[0]]), sensors=WHOSE["sensors"]), "mass")
    mine = tuning.estimate(read(recorded[0]), filter="open-loop")
    assert repr(mine).endswith("rows)") and "nan" not in mine._repr_html_()


def test_identify_is_the_command_in_one_call(as_json, runs, tmp_path):
    options = ("--free", ",".join(FREE), "--hold-noise", "--starts", 2, "--range", "voltage_gain=100:5000")
    told = as_json("identify", *runs, *OF_LOGS, *options, "--out", "theirs.toml")
    ranges = {"voltage_gain": (100, 5000)}
    options = {"noise": False, "starts": 2, "ranges": ranges, "progress": False}
    mine = tuning.identify(read(runs), FREE, **options)
    assert mine.values == told["values"] and mine.standard_errors == told["standard_errors"]
    assert plain({name: one._asdict() for name, one in mine.validation.items()}) == told["validation"]
    assert mine.save("mine.toml").read_text() == (tmp_path / "theirs.toml").read_text()
    assert read_preset("mine.toml").parameters.voltage_gain == mine.values["voltage_gain"]
    assert json.dumps(mine.sentences()) == json.dumps(told["sentences"])


def test_what_was_identified_shows_itself(found, tmp_path):
    assert repr(found).startswith("Identified(motor_damping ") and repr(found).endswith("all determined, 2 runs)")
    table = found.to_frame()
    assert table["value"].to_dict() == found.values and table.loc["voltage_gain", "unit"] == "rad/(s^2 V)"
    assert "voltage_gain" in found._repr_html_() and found.model.n == 2
    assert found.plot_profiles(["voltage_gain"]).axes
    for other in (copy.deepcopy(found), pickle.loads(pickle.dumps(found))):
        assert other.values == found.values
    refused(r"must end in \.toml, but got 'x\.json'", found.save, "x.json")


def test_runs_that_are_held_out_only_validate(recorded):
    options = {"noise": False, "starts": 1, "progress": False}
    reading = read([recorded[0]], held_out=[recorded[1]])
    mine = tuning.identify(reading, "voltage_gain", **options)
    assert [log.name for log in mine.held_out] == [recorded[1].name] and len(mine.runs) == 1
    assert set(mine.validation) == {"start", "identified"}


WRONG = [
    (lambda log: tuning.estimate(log, "a.json", filter="ekf"), "either a tuned file or a filter .*, but got both"),
    (lambda log: tuning.estimate(read(log), 5), "tuned must be a tuned file or a Study, but got 5"),
    (lambda log: tuning.identify(log, lambda dt: None), "free must be names of parameters, but got .*model=..."),
    (lambda log: tuning.read_logs(log, model="motor"), "or a thruster's preset, but got 'motor'"),
    (lambda log: tuning.read_logs(("tunnel", log), model="a:b"), "a pair .* must come without another model"),
    (lambda log: tuning.identify([]), "at least one log must be left to learn from"),
    (lambda log: tuning.identify(read(log), "mass"), "free parameters must be of .*, but got 'mass'"),
    (lambda log: tuning.read_logs(log, model="tunnel", preset="t200"), "give either a model or a preset"),
    (lambda log: tuning.identify(read(log), FREE, filter="kf"), "a thruster must be identified with the ekf"),
    (lambda log: tuning.identify(read(log), FREE, start={"x": 1.0}), "must be of free parameters, .*but got x"),
]


@pytest.mark.parametrize("call, said", WRONG)
def test_errors_state_the_rule_and_the_value(call, said, recorded):
    refused(said, call, recorded[0])


LAG = """from filters import affine_model
def model(dt, decay=0.9):
    return affine_model(
        a=[[decay]], b=[[0.1]], c=[[1.0]], process_noise_cov=[0.01], measurement_noise_cov=[0.04],
        prior_mean=[0.0], prior_cov=[1.0], states=["level"], input_quantities=[("flow", "u", "")],
        measurements=[("level", "z", "")],
    )
"""


@pytest.mark.usefixtures("as_python")
def test_the_model_of_a_tuned_file_s_logs_may_be_given_as_an_object(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "lag_of_a_user.py").write_text(LAG)
    draws = np.random.default_rng(0)
    level, rows = 0.0, ["t,u,z"]
    for k in range(400):
        u = np.sign(np.sin(0.1 * k))
        rows.append(f"{0.1 * k:.1f},{u},{level + 0.2 * draws.normal():.6f}")
        level = 0.9 * level + 0.1 * u + 0.1 * draws.normal()
    (tmp_path / "run.csv").write_text("\n".join(rows) + "\n")
    study = tuning.tune(("lag_of_a_user:model", "run.csv"), "kf", trials=1, progress=False)
    file = study.save("tuned.json")
    from lag_of_a_user import model

    refused("must be given by its name if it is code, but tuned.json names", tuning.evaluate, file, progress=False)
    by_object, by_name = (tuning.evaluate(file, model=way) for way in (model, "lag_of_a_user:model"))
    assert by_object.evaluation.log_likelihood == by_name.evaluation.log_likelihood
    assert by_object.evaluation.log_likelihood == study.held_out.evaluation.log_likelihood
    refused("must be the one it was tuned on", tuning.evaluate, file, model=lambda dt: model(dt, 0.5))


def test_the_input_of_a_row_acts_from_it_on_or_until_it():
    table = {"t": [0.0, 0.1, 0.2, 0.3], "u_1": [1.0, 2.0, 3.0, 4.0], "z_1": [0.0, 1.0, 2.0, 3.0]}
    model = affine_model(F=[[0.9]], B=[[1.0]], H=[[1.0]], Q=[1.0], R=[1.0], x0=[0.0], P0=[1.0])
    expected = {
        None: [1.0, 2.0, 3.0],
        "from": [1.0, 2.0, 3.0],
        "until": [2.0, 3.0, 4.0],
        "between": [1.5, 2.5, 3.5],
    }
    for act, inputs in expected.items():
        log, _ = tuning.read_logs(table, model=model, inputs_act=act).read()
        assert log.inputs.ravel().tolist() == inputs
    with pytest.raises(ValueError, match="inputs_act must be one of from, until, between, but got 'since'"):
        tuning.read_logs(table, model=model, inputs_act="since").read()


rng = np.random.default_rng(4)
VELOCITY = np.cumsum(0.2 * rng.normal(size=300))
Z = np.cumsum(0.1 * VELOCITY) + 0.5 * rng.normal(size=300)
TRACK = {"time": 0.1 * np.arange(300), "x [m]": Z, "y [m]": Z[::-1].copy()}
NAME = "constant-velocity"


@pytest.fixture
def log(tmp_path):
    file = tmp_path / "acc.csv"
    rows = np.column_stack([TRACK["time"], Z])
    np.savetxt(file, rows, delimiter=",", header="t,pos [m]", comments="", fmt="%.17g")
    return file


def test_numbers_of_a_study_are_those_of_its_training_blocks(log):
    problem = problem_of((NAME, log))
    assert [parameter.name for parameter in problem.parameters] == ["acceleration", "R"]
    blocks, lead = problem.parts.blocks, problem.parts.lead
    known = np.full(300, np.nan)
    for block in blocks[: len(problem.parts.training)]:
        rows = slice(block.first + lead, block.first + block.rows)
        known[rows] = Z[rows]
    fit = tuning.fit(known, 0.1, model=NAME)
    assert problem.given == pytest.approx({"acceleration": fit.numbers[0].value, "R": fit.r}, rel=1e-3)
    changed = known.copy()
    changed[np.isnan(known)] = rng.normal(size=np.isnan(known).sum())
    again = problem_of((NAME, {"time": TRACK["time"], "pos [m]": changed}))
    assert again.given == pytest.approx(problem.given, rel=1e-9)  # held-out rows and lead-ins count for nothing


def test_an_estimate_uses_given_numbers_or_finds_them_and_says_which(log):
    model = model_named(f"{NAME}:acceleration=0.5,R=0.3")(dt=0.1)
    stated = tuning.estimate((f"{NAME}:acceleration=0.5,R=0.3", log), filter="kf")
    np.testing.assert_allclose(stated.filter.model.process_noise_cov, model.process_noise_cov, rtol=1e-9)
    assert not any("maximum-likelihood" in sentence for sentence in stated.sentences())
    free, fit = tuning.estimate((NAME, log), filter="kf"), tuning.fit(log, model=NAME)
    assert free.filter.model.measurement_noise_cov[0, 0] == pytest.approx(fit.r, rel=1e-4)
    assert any(f'--model "{NAME}:acceleration=' in sentence for sentence in free.sentences())
    for numbers in (Z, Z.tolist()):
        reading = tuning.read_logs(numbers, model=f"{NAME}:acceleration=0.5,R=0.3", dt=0.1)
        np.testing.assert_allclose(tuning.estimate(reading, filter="kf").means, stated.means, rtol=1e-6, atol=1e-6)


def test_identified_numbers_are_those_of_fit_and_a_preset_for_other_commands(log, tmp_path):
    identified = tuning.identify((NAME, log), starts=1, use_all=True, progress=False)
    fit = tuning.fit(log, model=NAME)
    assert set(identified.values) == {"acceleration", "R"}
    assert identified.values["R"] == pytest.approx(fit.r, rel=0.05)
    file = identified.save(tmp_path / "found.toml")
    runs = tuning.read_logs(log, model=NAME, preset=file)
    used = tuning.estimate(runs, filter="kf").filter.model
    assert used.measurement_noise_cov[0, 0] == pytest.approx(identified.values["R"], rel=1e-12)


def test_a_tuned_file_of_a_named_model_needs_no_model_again(log, tmp_path):
    study = tuning.tune(("auto", str(log)), filter="kf", trials=3, progress=False)
    assert study.problem.as_mapping()["options"]["model"] == NAME
    file = study.save(tmp_path / "tuned.json")
    used = tuning.estimate(str(log), file).filter.model
    np.testing.assert_allclose(used.process_noise_cov, study.filter.model.process_noise_cov, rtol=1e-12)
    assert not any("maximum-likelihood" in sentence for sentence in tuning.estimate(log, file).sentences())


def test_a_clock_offset_beside_a_file_changes_no_fit(tmp_path):
    rng, file = np.random.default_rng(0), tmp_path / "run.csv"
    z = np.cumsum(0.3 * rng.normal(size=(200, 2)), axis=0) + rng.normal(size=(200, 2))
    table = np.column_stack([0.1 * np.arange(200), z])
    np.savetxt(file, table, delimiter=",", header="t,x,y", comments="")
    options = {"model": "constant", "column": "x,y"}
    before = tuning.fit(file, **options)
    file.with_suffix(".toml").write_text("[clock_offset]\nx = 0.05\ny = 0.05\n")
    np.testing.assert_array_equal(tuning.fit(file, **options).r, before.r)
    file.with_suffix(".toml").write_text("[clock_offset]\nx = 0.05\n")
    refused("columns of a fit must have one clock, but .* has x = 0.05", tuning.fit, file, **options)


def test_a_clock_offset_of_all_columns_moves_no_number():
    options = {"model": f"{NAME}:acceleration=1", "columns": ["x,y"]}
    log, maker = tuning.read_logs(TRACK, **options).read()
    moved, of_moved = tuning.read_logs(TRACK, **options, clock_offset={"x": 0.05, "y": 0.05}).read()
    np.testing.assert_array_equal(moved.measurements, log.measurements)
    assert of_moved.values == maker.values and moved.start == pytest.approx(log.start - 0.05)
    reading = tuning.read_logs(TRACK, **options, clock_offset={"x": 0.05})
    refused("must come with all its numbers where columns have own clock", tuning.estimate, reading, filter="kf")
    with pytest.raises(ValueError, match="clock offsets must be of channels x, y, but got 'z'"):
        tuning.read_logs(TRACK, **options, clock_offset={"z": 0.05}).read()


def test_columns_of_axes_are_those_that_are_named_or_as_many():
    numbers = "acceleration=1,R=1"
    by_axes = tuning.read_logs(TRACK, model=f"{NAME}:axes=2,{numbers}")
    runs = [by_axes, tuning.read_logs(TRACK, model=f"{NAME}:{numbers}", columns=["x,y"])]
    for each in runs:
        recorded, maker = each.read()
        assert [quantity.symbol for quantity in recorded.measured] == ["x", "y"] and maker(dt=0.1).n == 4
    refused(r"one column of numbers beside its times", tuning.read_logs(TRACK, model=NAME).read)
    with pytest.raises(ValueError, match="of 3 axes must have as many columns"):
        tuning.read_logs(TRACK, model=f"{NAME}:axes=3", columns=["x,y"]).read()


def test_numbers_without_a_model_and_logs_of_another_plant_name_the_way():
    refused(r"tuning.fit\(z, dt=0.1\) finds the model", tuning.tune, Z)
    refused(r"dt must be given to tuning.read_logs.*tuning.fit\(z, dt=0.1\)", tuning.tune, Z, dt=0.1)
    with pytest.raises(TypeError, match="unexpected keyword argument 'trial'"):
        tuning.tune("mismatch", trial=3)
    refused("has time, x .m., y .m.: tuning.fit finds a model.*--model auto", tuning.estimate, TRACK)


def test_an_estimate_on_its_own_stamps_has_the_q_of_each_step():
    times = np.cumsum(rng.uniform(0.05, 0.15, 300))
    reading = {"model": f"{NAME}:acceleration=0.5,R=0.3", "grid": False, "dt": 0.1}
    estimate = tuning.estimate(tuning.read_logs({"t": times, "pos": Z}, **reading), filter="ekf")
    maker = model_named(reading["model"])
    plant = maker.continuous(dt=0.1)
    filter_ = make_filter("ekf", estimate.filter.model.replace(process_noise_cov=plant.noise(0.1)))
    by_run = run(filter_, Z, dt=np.diff(times), noise=plant.noise)
    np.testing.assert_allclose(estimate.means, by_run.means, rtol=1e-9, atol=1e-9)
    with pytest.raises(ValueError, match="must be tuned or identified on a grid, but run1 is on its own stamps"):
        problem_of(tuning.read_logs({"t": times, "pos": Z}, **reading))


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
    reading = tuning.read_logs(run, model=make, hold_gaps=hold_gaps)
    return tuning.identify(reading, free, starts=1, use_all=True, **options)


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


def test_a_constant_is_within_its_error_where_a_run_is_cut_at_a_gap_and_far_off_where_it_is_held():
    cut = gap(False)
    assert abs(cut.values["cooling"] - COOLING) < 3.9 * cut.standard_errors["cooling"]
    assert abs(cut.values["Q11"] - 1e-4) < 3.9 * cut.standard_errors["Q11"]
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
    assert "needs a gate (session(gate=5)), or to be robust (ekf-robust). Figures of the runs it has seen" in said
    whole = validate(gated.found, gated.runs)
    assert gated.validation["identified"].log_likelihood > whole["identified"].log_likelihood + 100.0
    proven = remarks(gated.runs, gated.runs, gated.found)
    assert proven[-1].endswith("(ekf-robust). Figures of held-out runs count all samples.")
    assert abs(gated.values["gain"] - SPEED) < 3.9 * gated.standard_errors["gain"]
    assert abs(gated.values["gain"] - SPEED) < abs(plain.values["gain"] - SPEED) / 2
    assert gated.standard_errors["gain"] < plain.standard_errors["gain"] / 2
