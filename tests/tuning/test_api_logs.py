"""`tuning.estimate` and `identify`: the numbers of the commands on recorded runs, as values."""

import copy
import json
import pickle

import numpy as np
import pytest

import tuning
from filters import affine_model
from tests.tuning.test_api_study import plain
from thruster_env.logs.write import write_log
from thruster_env.thruster.parameters import read_preset
from tuning.experiments.identification import record

FREE = ["motor_damping", "voltage_gain"]
OF_LOGS = ("--preset", "tunnel_physical", "--sensor", "thrust", "--sensor", "speed")
WHOSE = {"preset": "tunnel_physical", "sensors": ["thrust", "speed"]}


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
    return tuning.identify(tuning.read_logs(recorded, **WHOSE), FREE, noise=False, starts=1, progress=False)


def test_estimate_is_the_command_in_one_call(as_json, runs, tmp_path):
    told = as_json("estimate", "run0.csv", *OF_LOGS, "--smoother", "--lag", 5, "--skip", 20, "--out", "theirs.csv")
    mine = tuning.estimate(tuning.read_logs("run0.csv", **WHOSE), smoother=True, lag=5, skip=20)
    assert mine.log_likelihood == told["log_likelihood"] and mine.findings.mean_nis == told["mean_nis"]
    assert mine.log.digest == told["digest"] and mine.found.smoothed
    assert mine.save("mine.csv").read_text() == (tmp_path / "theirs.csv").read_text()
    table = mine.to_frame()
    assert len(table) == told["rows"] == 151 and table.index.name == "time_s"
    np.testing.assert_array_equal(table["omega_m_rad_per_s"], mine.means[:, 0])
    assert "mean NIS over channels" in repr(mine) and len(repr(mine)) < 200 and "nan" not in mine._repr_html_()


def test_a_pair_of_model_and_log_is_the_same(recorded):
    alone = tuning.estimate(tuning.read_logs(recorded[0], **WHOSE))
    pair = tuning.estimate(tuning.read_logs(("tunnel_physical", recorded[0]), sensors=WHOSE["sensors"]))
    assert pair.log_likelihood == alone.log_likelihood
    with pytest.raises(ValueError, match="'mass'"):  # the logs of the pair are read as those of the thruster
        tuning.identify(tuning.read_logs(("tunnel_physical", [recorded[0]]), sensors=WHOSE["sensors"]), "mass")


def test_a_baseline_has_no_nis(recorded):
    mine = tuning.estimate(tuning.read_logs(recorded[0], **WHOSE), filter="open-loop")
    assert repr(mine).endswith("rows)") and "nan" not in mine._repr_html_()


def test_identify_is_the_command_in_one_call(as_json, runs, tmp_path):
    options = ("--free", ",".join(FREE), "--hold-noise", "--starts", 2, "--range", "voltage_gain=100:5000")
    told = as_json("identify", *runs, *OF_LOGS, *options, "--out", "theirs.toml")
    ranges = {"voltage_gain": (100, 5000)}
    mine = tuning.identify(
        tuning.read_logs(runs, **WHOSE), FREE, noise=False, starts=2, ranges=ranges, progress=False
    )
    assert mine.values == told["values"] and mine.standard_errors == told["standard_errors"]
    assert plain({name: one._asdict() for name, one in mine.validation.items()}) == told["validation"]
    assert mine.save("mine.toml").read_text() == (tmp_path / "theirs.toml").read_text()
    assert read_preset("mine.toml").parameters.voltage_gain == mine.values["voltage_gain"]
    assert json.dumps(mine.sentences()) == json.dumps(told["sentences"])


def test_what_was_identified_shows_itself(found):
    assert repr(found).startswith("Identified(motor_damping ") and repr(found).endswith("all determined, 2 runs)")
    table = found.to_frame()
    assert table["value"].to_dict() == found.values and table.loc["voltage_gain", "unit"] == "rad/(s^2 V)"
    assert "voltage_gain" in found._repr_html_() and found.model.n == 2
    assert found.plot_profiles(["voltage_gain"]).axes
    for other in (copy.deepcopy(found), pickle.loads(pickle.dumps(found))):
        assert other.values == found.values


def test_runs_that_are_held_out_only_validate(recorded):
    options = {"noise": False, "starts": 1, "progress": False}
    mine = tuning.identify(
        tuning.read_logs([recorded[0]], **WHOSE, held_out=[recorded[1]]), "voltage_gain", **options
    )
    assert [log.name for log in mine.held_out] == [recorded[1].name] and len(mine.runs) == 1
    assert set(mine.validation) == {"start", "identified"}


WRONG = [
    (lambda log: tuning.estimate(log, "a.json", filter="ekf"), "either a tuned file or a filter .*, but got both"),
    (
        lambda log: tuning.estimate(tuning.read_logs(log, **WHOSE), 5),
        "tuned must be a tuned file or a Study, but got 5",
    ),
    (lambda log: tuning.identify(log, lambda dt: None), "free must be names of parameters, but got .*model=..."),
    (lambda log: tuning.read_logs(log, model="motor"), "or a thruster's preset, but got 'motor'"),
    (lambda log: tuning.read_logs(("tunnel", log), model="a:b"), "a pair .* must come without another model"),
    (lambda log: tuning.identify([]), "at least one log must be left to learn from"),
    (
        lambda log: tuning.identify(tuning.read_logs(log, **WHOSE), "mass"),
        "free parameters must be of .*, but got 'mass'",
    ),
    (lambda log: tuning.read_logs(log, model="tunnel", preset="t200"), "give either a model or a preset"),
    (
        lambda log: tuning.identify(tuning.read_logs(log, **WHOSE), FREE, filter="kf"),
        "a thruster must be identified with the ekf",
    ),
    (
        lambda log: tuning.identify(tuning.read_logs(log, **WHOSE), FREE, start={"x": 1.0}),
        "must be of free parameters, .*but got x",
    ),
]


@pytest.mark.parametrize("call, said", WRONG)
def test_errors_state_the_rule_and_the_value(call, said, recorded):
    with pytest.raises(ValueError, match=said):
        call(recorded[0])


def test_a_file_of_what_was_identified_ends_in_toml(found, tmp_path):
    with pytest.raises(ValueError, match=r"must end in \.toml, but got 'x\.json'"):
        found.save("x.json")


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

    with pytest.raises(ValueError, match="must be given by its name if it is code, but tuned.json names"):
        tuning.evaluate(file, progress=False)
    by_object, by_name = (tuning.evaluate(file, model=way) for way in (model, "lag_of_a_user:model"))
    assert by_object.evaluation.log_likelihood == by_name.evaluation.log_likelihood
    assert by_object.evaluation.log_likelihood == study.held_out.evaluation.log_likelihood
    with pytest.raises(ValueError, match="must be the one it was tuned on"):
        tuning.evaluate(file, model=lambda dt: model(dt, 0.5))


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
