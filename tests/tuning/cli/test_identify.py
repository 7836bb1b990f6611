"""`thruster identify`: tables, files that every preset takes, and one clear line for a mistake."""

import gymnasium as gym
import numpy as np
import pytest

import thruster_env  # noqa: F401 - registers the env
from tests.filters.checks import refused
from tests.models import scalar_model
from tests.thruster_env.thruster.test_t200 import OTHER, recorded_rows, write_table
from thruster_env.core.streams import episode_keys
from thruster_env.logs.log import Log
from thruster_env.logs.write import write_log
from thruster_env.model.simulate import simulate
from thruster_env.thruster.model import logged_model, thruster_model
from thruster_env.thruster.parameters import TUNNEL_PHYSICAL, PresetFile, read_preset, write_preset
from tuning.experiments.identification import TRUTH, record
from tuning.likelihood.result import with_values
from tuning.plants.thruster_logs import of_preset
from tuning.problems.find import find_problem, scenario_of

FREE = ",".join(name for name in TRUTH if not name.startswith(("Q", "R")))
WHOSE = "--preset tunnel_physical --sensor thrust --sensor speed"
OF_LOGS = ("--preset", "tunnel_physical", "--sensor", "thrust", "--sensor", "speed")


@pytest.fixture(scope="module")
def recorded():
    return record(0, 4, 300)


@pytest.fixture
def logs(recorded, tmp_path):
    for place, log in enumerate(recorded):
        write_log(tmp_path / f"run{place}.csv", log)
    return [f"run{place}.csv" for place in range(len(recorded))]


@pytest.mark.slow
def test_identified_numbers_go_into_a_preset_that_everything_takes(thruster, as_json, logs, tmp_path):
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
    r = [found["values"][name] for name in ("R11", "R22")]
    assert np.diag(model.measurement_noise_cov).tolist() == pytest.approx(r, rel=1e-12)
    inside = as_json("inspect", "--preset", "mine.toml", "--out", "x.pdf")
    assert inside["preset"] == "mine.toml" and (tmp_path / "x.pdf").read_bytes().startswith(b"%PDF")
    before = (tmp_path / "mine.toml").read_text()
    for command in (("identify", *logs), ("bollard", "t.csv"), ("tune", "--scenario", "nominal")):
        done = thruster(*command, "--preset", "mine.toml", "--out", "mine.toml")
        assert done.returncode == 2 and "must not replace an input file, but got mine.toml for both" in done.stderr
    assert (tmp_path / "mine.toml").read_text() == before
    assert thruster("simulate", "--preset", "mine.toml", "--steps", 20, "--out", "sim.csv").returncode == 0
    env = gym.make("BowThruster-v0", preset="mine.toml").unwrapped
    assert env.plant.parameters == kept.parameters
    assert env.state_space_model().constants.dead_band_high == kept.dead_band[1]


@pytest.mark.slow
def test_a_bollard_table_and_a_step_response_make_a_preset(thruster, as_json, tmp_path):
    larger = {name: 1.5 * getattr(OTHER.thruster, name) for name in ("motor_damping", "voltage_gain", "load_gain")}
    truth = OTHER.thruster._replace(**larger, added_mass=0.6)
    write_table(tmp_path / "table.csv", recorded_rows(OTHER))
    model = thruster_model(preset=truth, max_voltage=12.0, sensors=["speed"], measurement_noise_cov=[0.25])
    inputs = np.repeat([[[2.0], [10.0], [-8.0]]], 60, axis=1)
    drawn = simulate(model, episode_keys([0]), inputs).measurements[0]
    write_log("step.csv", Log("step", 0.01, inputs[0], drawn, model.input_quantities, model.measurements))
    renamed = (tmp_path / "step.csv").read_text().replace("measured_speed_rad_per_s", "tacho")
    (tmp_path / "step.csv").write_text(renamed)
    column = "--column", "speed=tacho"
    found = as_json("bollard", "table.csv", "--step", "step.csv", *column, "--out", "mine.toml")
    assert found["held_out_supplies"] == [14.0, 18.0]
    assert found["thruster"]["lift_coefficient"] == pytest.approx(truth.lift_coefficient, rel=1e-4)
    values, errors = found["step"]["values"], found["step"]["standard_errors"]
    assert abs(values["motor_rate"] - 1.5) < 3 * errors["motor_rate"] < 0.3
    assert abs(values["added_mass"] - 0.6) < 3 * errors["added_mass"] < 0.3
    kept = read_preset("mine.toml").parameters
    speeds = [one.voltage_gain / one.motor_damping for one in (kept, truth)]
    assert speeds[0] == pytest.approx(speeds[1], rel=1e-4)
    assert kept.added_mass == values["added_mass"]
    inputs = np.full((60, 1), 2.0)
    write_log("flat.csv", Log("step", 0.01, inputs, drawn[:61], model.input_quantities, model.measurements))
    done = thruster("bollard", "table.csv", "--step", "flat.csv")
    assert done.returncode == 2 and "a step response must have a step of the voltage" in done.stderr


def test_scenarios_are_of_another_thruster_by_its_preset_file(thruster, tmp_path):
    path = tmp_path / "mine.toml"
    write_preset(path, PresetFile(TUNNEL_PHYSICAL._replace(voltage_gain=1300.0), (-0.5, 0.7)))
    made = of_preset(find_problem("nominal"), str(path), sequences=4)
    path.unlink()  # the scenario holds what it said
    assert made.plant.parameters.voltage_gain == 1300.0 and made.model().constants.dead_band_high == 0.7
    assert np.isfinite(made.scale).all() and made.scale != find_problem("nominal").scale
    again = scenario_of(made.as_mapping(), made.name, "t.json")
    assert again.digest == made.digest != find_problem("nominal").digest
    assert of_preset(made, None) is made
    done = thruster("compare", "--filter", "ekf", "--scenario", "published_tunnel", "--preset", "t200")
    assert done.returncode == 2
    assert "(--preset) must come with scenarios of the thruster's equations" in done.stderr


def test_no_command_writes_over_a_log_or_its_description(thruster, logs, tmp_path):
    (tmp_path / "run0.toml").write_text("dt = 0.01\n")

    def files():
        return {path.name: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}

    before = files()
    for line, message in [
        (f"identify run0.csv {WHOSE} --out run0.toml", "beside run0.csv"),
        (f"identify run0.csv {WHOSE} --out run1.toml", "beside run1.csv"),
        ("new preset run1.toml", "beside run1.csv"),
        ("simulate --steps 5 --out run1.csv", "logs are never overwritten, but run1.csv exists"),
        (f"estimate run0.csv {WHOSE} --out run1.csv", "logs are never overwritten, but run1.csv exists"),
        ("inspect --json run1.csv", "--json must be no log"),
        ("simulate --steps 5 --out new.csv --json run0.toml", "beside run0.csv"),
    ]:
        done = thruster(*line.split())
        assert done.returncode == 2 and message in done.stderr, line
        assert done.stderr.count("thruster:") == 1 and "Traceback" not in done.stderr, line
        assert files() == before, line


def test_values_of_a_model_belong_to_a_sample_time(tmp_path):
    (tmp_path / "mine.toml").write_text("[values]\nQ11 = 0.5\nR = 2.0\n[identified]\ndt = 0.01\n")
    alone = with_values(scalar_model, tmp_path / "mine.toml")
    assert alone(0.01).process_noise_cov.item() == pytest.approx(0.5, rel=1e-12)
    refused(r"the dt of a log must be that of .*mine.toml, 0.01 s, .* but is 0.02 s", alone, 0.02)
    made = with_values(lambda dt=0.01: scalar_model(), tmp_path / "mine.toml")(0.02)
    assert made.process_noise_cov.item() == pytest.approx(1.0, rel=1e-12)
    assert made.measurement_noise_cov.item() == pytest.approx(2.0, rel=1e-12)
