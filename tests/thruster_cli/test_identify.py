"""`thruster identify`: tables, files that every preset takes, and one clear line for a mistake."""

import re

import gymnasium as gym
import numpy as np
import pytest

import thruster_env  # noqa: F401 - registers the env
from plants.logs.write import write_log
from studies.identification import TRUTH, record
from tests.thruster_cli.test_cli import as_json, thruster  # noqa: F401 - fixtures
from thruster_env.logged import logged_model
from thruster_env.parameters import TUNNEL_PHYSICAL
from thruster_env.preset_file import read_preset

FREE = ",".join(name for name in TRUTH if not name.startswith(("Q", "R")))
OF_LOGS = ("--preset", "tunnel_physical", "--sensor", "thrust", "--sensor", "speed")


@pytest.fixture
def logs(tmp_path):
    recorded = record(0, 4, 300)
    for place, log in enumerate(recorded):
        write_log(tmp_path / f"run{place}.csv", log)
    return [f"run{place}.csv" for place in range(len(recorded))]


def test_identified_numbers_go_into_a_preset_that_everything_takes(thruster, as_json, logs, tmp_path):  # noqa: F811
    found = as_json("identify", *logs, *OF_LOGS, "--free", FREE, "--starts", 1, "--out", "mine.toml")
    assert found["held_out"] == ["run2.csv"] and found["files"] == ["mine.toml"]
    for name, value in found["values"].items():
        assert abs(value - TRUTH[name]) < 4 * found["standard_errors"][name], name
    checked = found["validation"]
    assert checked["identified"]["log_likelihood"] > checked["start"]["log_likelihood"] + 1000
    kept = read_preset("mine.toml")
    assert kept.parameters.voltage_gain == found["values"]["voltage_gain"]
    assert kept.parameters.added_mass == TUNNEL_PHYSICAL.added_mass
    assert kept.dead_band == (found["values"]["dead_band_low"], found["values"]["dead_band_high"])
    model = logged_model(preset="mine.toml")
    assert model.n == 3 and model.constants.bias_0 == found["values"]["bias_thrust"]
    assert np.diag(model.measurement_noise_cov).tolist() == [found["values"]["R11"], found["values"]["R22"]]
    inside = as_json("inspect", "--preset", "mine.toml", "--out", "x.png")
    assert inside["preset"] == "mine.toml"
    assert thruster("simulate", "--preset", "mine.toml", "--steps", 20, "--out", "sim.csv").returncode == 0
    env = gym.make("BowThruster-v0", preset="mine.toml").unwrapped
    assert env.plant.parameters == kept.parameters
    assert env.state_space_model().constants.dead_band_high == kept.dead_band[1]


WITHOUT_LOG = [
    ((), "identify must have at least one log"),
    (("--step", "x.csv"), "--step must come with --bollard"),
    (("--bollard", "none.csv"), "none.csv cannot be read"),
]
WITH_LOG = [
    (("--free", "mass"), "free parameters must be of lift_coefficient, .*, but got 'mass'"),
    (("--start", "voltage_gain=1e9"), "the start of voltage_gain must be within"),
    (("--range", "voltage_gain=5"), "--range must have the form NAME=LOW:HIGH, but got 'voltage_gain=5'"),
    (("--filter", "kf"), "a thruster must be identified with the ekf, but got --filter kf"),
    (("--held-out", "run0.csv"), "at least one log must be left to learn from"),
    (("--out", "x.json"), "--out must end in .toml"),
]
MISTAKES = [
    *((("identify", *arguments), message) for arguments, message in WITHOUT_LOG),
    *((("identify", "run0.csv", *OF_LOGS, *arguments), message) for arguments, message in WITH_LOG),
    (("identify", "run0.csv", "--preset", "none.toml"), "a preset file must be readable, but none.toml is not"),
    (("identify", "run0.csv", "--bollard", "table.csv"), "give either logs or --bollard TABLE.csv"),
]


@pytest.mark.parametrize(("arguments", "message"), MISTAKES)
def test_a_mistake_is_one_line_and_nothing_is_written(thruster, logs, tmp_path, arguments, message):  # noqa: F811
    done = thruster(*arguments)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
    assert re.search(message, done.stderr), done.stderr
    assert not list(tmp_path.glob("*.toml"))


def test_logs_without_excitation_say_what_they_do_not_determine(thruster, tmp_path):  # noqa: F811
    assert thruster("simulate", "--voltage", 12, "--steps", 200, "--out", "flat.csv").returncode == 0
    done = thruster("identify", "flat.csv", "--free", "motor_damping,voltage_gain,dead_band")
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
    assert "constant inputs do not determine" in done.stderr and "voltage_gain" in done.stderr
    assert not (tmp_path / "out" / "identified.toml").exists()
