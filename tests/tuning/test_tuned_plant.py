"""A tuned file says what plant it is for, and keeps the scenarios of files that may move."""

import json
import shutil
import warnings
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import thruster_env  # noqa: F401 - registers the envs
from filters import EstimateState, EstimateStates, thruster_model
from filters.tuned_file import made_with
from tests.filters.checks import refused
from tests.tuned_files import of_version, rewrite, write_untuned
from thruster_env.core.compiled import interpreted
from thruster_env.effects.effects import Gusts
from thruster_env.thruster.parameters import PRESETS, PresetFile, write_preset
from thruster_env.thruster.plant import differences, make_plant, plant_data
from tuning.api.report import find_subject
from tuning.api.tune import name_of
from tuning.api.verify import verify
from tuning.evaluation.tuned import read_tuned
from tuning.logs.problem import log_problem, problems_in
from tuning.logs.read import as_tuned
from tuning.plants.thruster import find_scenario
from tuning.policies.setup import make_configuration
from tuning.problems.find import scenario_of
from tuning.search.plan import Plan

TOML = 'base = "nominal"\nscale = [1.0, 0.05]\nsteps = 60\nflow = [{name = "gusts", std = 0.5}]\n'


@pytest.fixture(scope="module")
def nominal(tmp_path_factory):
    return write_untuned(tmp_path_factory.mktemp("nominal") / "ekf.json")


def wrapped(path, count=None, **arguments):
    if count:
        return EstimateStates(gym.make_vec("BowThruster-v0", num_envs=count, **arguments), tuned=str(path))
    return EstimateState(gym.make("BowThruster-v0", **arguments), tuned=str(path))


OTHERS = {
    "dt": ({"dt": 0.02}, r"dt 0.01 \(here 0.02\);"),
    "preset": ({"preset": "t200", "max_voltage": 13.0}, r"preset tunnel \(here t200\);"),
    "parameters": ({"preset": {**PRESETS["tunnel"]._asdict(), "area": 0.005}}, r"area 0.00445 \(here 0.005\);"),
    "channel": ({"sensors": ["speed"]}, r"sensors thrust \(here speed\);"),
    "all": (
        {"dt": 0.005, "preset": "tunnel_physical", "sensors": ["thrust", "speed"]},
        r"preset tunnel \(here tunnel_physical\), dt 0.01 \(here 0.005\), sensors thrust \(here thrust, speed\);",
    ),
}


@pytest.mark.parametrize(("arguments", "said"), OTHERS.values(), ids=list(OTHERS))
@pytest.mark.parametrize("count", [None, 2])
def test_a_file_on_another_plant_is_refused_and_each_difference_named(arguments, said, count, nominal):
    rule = "a tuned file must be for the plant it is used with, but .*ekf.json was tuned for " + said
    refused(rule, wrapped, nominal, count, **arguments)


@pytest.mark.parametrize("count", [None, 2])
def test_a_model_that_is_wrong_on_purpose_is_warned_of(count, tmp_path):
    file = write_untuned(tmp_path / "ekf.json", "mismatch")
    said = "ekf.json was tuned on a model that is wrong on purpose: .* voltage_gain 0.95 times"
    with pytest.warns(UserWarning, match=said) as caught:
        wrapped(file, count)
    assert [one.filename for one in caught] == [__file__]


def test_other_noise_is_warned_of_and_what_does_not_matter_is_not_compared(nominal):
    with pytest.warns(UserWarning, match=r"tuned for max_voltage 24.0 \(here 12.0\), measurement_noise_cov .*4.0"):
        wrapped(nominal, max_voltage=12.0, measurement_noise_cov=[4.0])
    for entry, arguments in {
        "flow": {"flow": [{"name": "gusts", "std": 0.5}]},
        "sensor_effects": {"sensors": {"thrust": [{"name": "dropout", "probability": 0.1}]}},
        "uncertainty": {"uncertainty": {"load_gain": {"name": "log-normal", "std": 0.1}}},
    }.items():
        with pytest.warns(UserWarning, match=f"ekf.json was tuned for {entry} "):
            wrapped(nominal, **arguments)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        wrapped(nominal)
        wrapped(nominal, 2)
        no_matter = {"initial_state": {"voltage": 3.0}, "energy_weight": 2.0, "reference": 4.0}
        wrapped(nominal, **no_matter, preset=PRESETS["tunnel"])


def test_a_linear_system_is_another_plant(nominal):
    with pytest.raises(ValueError, match=r"was tuned for system None \(here \["):
        EstimateState(gym.make("BowThrusterLinear-v0"), tuned=str(nominal))


def test_a_model_of_one_s_own_and_a_file_of_before_are_not_compared(nominal, tmp_path):
    env = gym.make("BowThruster-v0", dt=0.02)
    model = "thruster_env.thruster.model:thruster_model"
    assert EstimateState(env, tuned=str(nominal), model=model).filter.model.substeps == thruster_model().substeps

    path = rewrite(shutil.copy(nominal, tmp_path / "old.json"), partial(of_version, version=2))
    assert wrapped(path, dt=0.02).filter.name == "ekf"
    assert read_tuned(path)[1] is find_scenario("nominal") and verify(path).holds


def test_a_file_of_the_version_before_this_is_compared_by_its_plant(nominal, tmp_path):
    path = rewrite(shutil.copy(nominal, tmp_path / "old.json"), partial(of_version, version=3))
    assert read_tuned(path) == read_tuned(nominal) and verify(path).holds and wrapped(path).filter.name == "ekf"
    refused(r"old.json was tuned for dt 0.01 \(here 0.02\);", wrapped, path, dt=0.02)


def test_a_policy_a_comparison_and_an_evaluation_refuse_it_too(nominal, thruster, tmp_path):
    slow = 'base = "nominal"\nscale = [1.0, 0.05]\ndt = 0.02\n'
    (tmp_path / "slow.toml").write_text(slow)
    said = "was tuned for dt 0.01 (here 0.02)"
    for command in (("evaluate", "--tuned"), ("compare",), ("train", "--tuned")):
        done = thruster(*command, nominal, "--scenario", "slow.toml")
        assert done.returncode == 2 and said in done.stderr, command
    with pytest.raises(ValueError, match=r"was tuned for dt 0.01 \(here 0.02\)"):
        make_configuration("tracking", find_scenario("slow.toml"), "ekf", tuned=nominal)
    assert make_configuration("tracking", find_scenario("medium_noise"), "ekf", tuned=nominal).filter_arguments


def test_plants_are_compared_as_data_and_not_by_the_names_of_their_presets():
    one = plant_data(make_plant())
    again = plant_data(make_plant(PRESETS["tunnel"]._replace(area=PRESETS["tunnel"].area * (1 + 1e-14))))
    assert json.loads(json.dumps(one)) == one and again["preset"] is None
    assert differences(one, again) == ([], [])
    assert differences(one, plant_data(make_plant(dt=0.02)))[0] == ["dt 0.01 (here 0.02)"]
    assert differences(one, {**one, "flow": [{"name": "gusts"}]})[1] == ["flow [] (here [{'name': 'gusts'}])"]
    refused("a plant's data must have preset, .* but got {}", differences, {}, one)


@pytest.fixture
def moved(thruster, tmp_path):
    """A tuned file of a scenario whose own file is no longer where it was."""
    (tmp_path / "my.toml").write_text(TOML)
    scenario = find_scenario("my.toml")
    write_untuned("ekf.json", scenario)
    (tmp_path / "my.toml").rename(tmp_path / "moved.toml")
    return scenario


def test_a_tuned_file_does_without_the_file_of_its_scenario(moved, thruster):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        choice, scenario, _ = read_tuned("ekf.json")
        assert scenario == moved and scenario.digest == moved.digest and verify("ekf.json").holds
    assert find_subject("ekf.json", "none.journal").plan.scenarios == (moved,)
    kept = json.loads(Path("ekf.json").read_text())["problems"]
    assert list(kept) == ["my.toml"] and kept["my.toml"]["digest"] == moved.digest
    for command in (("evaluate", "--tuned", "ekf.json", "--seeds", 2), ("compare", "ekf.json", "--seeds", 2)):
        done = thruster(*command)
        assert done.returncode == 0 and "my.toml" in done.stdout, done.stderr
    flow = [{"name": "gusts", "std": 0.5}]
    q = wrapped("ekf.json", flow=flow).filter.model.process_noise_cov
    np.testing.assert_array_equal(q, np.diag(choice.model["process_noise_cov"]))


@pytest.mark.parametrize(
    ("text", "now"), [(TOML.replace("0.5}", "0.6}"), "[0-9a-f]{12} now"), ("a = [", "none that can be read now")]
)
def test_a_scenario_file_that_has_changed_is_told_and_what_was_tuned_on_counts(text, now, moved, tmp_path):
    (tmp_path / "my.toml").write_text(text)
    with pytest.warns(UserWarning, match=f"my.toml is not the scenario that .*{moved.digest} then, {now}"):
        assert verify("ekf.json").holds
    (tmp_path / "my.toml").write_text(TOML)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert read_tuned("ekf.json")[1] == moved


@pytest.mark.parametrize(
    ("kept", "rule"),
    [
        (3, "a scenario in a file must be a mapping of about, .* ekf.json has 3"),
        ({"content": {"module": "os"}}, "a scenario in a file must be a mapping of about, .*'os'"),
        ({"content": {"scale": [1.0, -1.0]}}, r"scale must be positive in every state, .* \(in ekf.json\)"),
        ({"content": {}}, "values of a scenario must be valid for `Scenario`"),
    ],
)
def test_a_scenario_in_a_tuned_file_is_checked_as_one_in_a_file(kept, rule, moved, tmp_path):
    path = rewrite(tmp_path / "ekf.json", lambda content: content["problems"].update({"my.toml": kept}))
    refused(rule, read_tuned, path.name)


def test_a_scenario_with_effects_and_a_preset_of_its_own_comes_back_from_its_data():
    made = find_scenario("nominal").replace(flow=(Gusts(std=0.5),), preset=PRESETS["t200"]._asdict())
    again = scenario_of(json.loads(json.dumps(made.as_mapping())), made.name, "x.json")
    assert again.plant.flow == made.plant.flow and again.plant.parameters == made.plant.parameters


def test_a_tuned_file_finds_its_preset_or_an_error_names_the_options_that_made_it(thruster):
    for name, damping in (("mine", 72.0), ("other", 80.0)):
        mine = PresetFile(PRESETS["tunnel_physical"]._replace(motor_damping=damping), recorder={"dt": 0.01})
        write_preset(f"{name}.toml", mine, "a thruster")
    thruster("simulate", "--preset", "tunnel_physical", "--steps", 300, "--measured-only", "--out", "run.csv")
    problem = log_problem(["run.csv"], preset="mine.toml")
    names = [name_of(Plan("kf", (one,))) for one in (problem, log_problem(["run.csv"], preset="other.toml"))]
    assert names[0] == f"kf-run.csv-{problem.digest[:6]}-seed0" and names[1] != names[0]
    with interpreted():
        file = write_untuned("tuned.json", problem, "kf")
    assert read_tuned(file, problems_in(file, preset="mine.toml"))[1].digest == problem.digest
    assert as_tuned({"preset": None, "sensors": None, "dt": 0.01}, file) == {"preset": "mine.toml", "dt": 0.01}
    assert as_tuned({"preset": "other.toml"}, file) == {"preset": "other.toml"}
    made = "; tuned.json was made with --log run.csv --preset mine.toml"
    for command in ("verify", "evaluate", "report", "export --out boat"):
        others = thruster(*command.split(), "tuned.json", "--preset", "other.toml")
        assert others.returncode == 2 and others.stderr.strip().endswith(f"{made}: has that changed?")
    others = thruster("estimate", "run.csv", "tuned.json", "--preset", "other.toml")
    assert others.returncode == 2 and others.stderr.strip().endswith(made)
    shutil.move("mine.toml", "moved.toml")
    way_out = r"there is no file mine.toml: say where it is now \(--preset FILE\)"
    for read in (lambda: problems_in(file), lambda: as_tuned({"preset": None}, file)):
        refused(way_out, read)
    assert read_tuned(file, problems_in(file, preset="moved.toml"))[1].digest == problem.digest
    shutil.move("run.csv", "away.csv")
    refused("there is no file run.csv: run the command in the folder", problems_in, file, preset="moved.toml")


@pytest.mark.parametrize(
    ("content", "options"),
    [
        ({"problem": "nominal", "problems": {}}, "--problem nominal"),
        ({"problem": "nominal (my boat.toml)", "problems": {}}, "--problem nominal --preset 'my boat.toml'"),
        (
            {"problem": "mismatch (t200)+voltage_gain:20", "problems": {}},
            "--problem mismatch --preset t200 --augment voltage_gain:20",
        ),
        (
            {
                "problem": "a.csv and 1 more",
                "problems": {
                    "a.csv and 1 more": {
                        "content": {
                            "logs": [{"file": "a.csv"}, {"file": "b.csv"}],
                            "options": {"model": "m:x", "columns": ["u=U[mV]"], "grid": False, "lead": 40},
                        }
                    }
                },
            },
            "--log a.csv --log b.csv --model m:x --column 'u=U[mV]' --no-grid --lead 40",
        ),
    ],
)
def test_the_options_that_made_a_file_are_those_of_the_command(content, options):
    assert made_with(content) == options


def test_preset_of_a_scenario_must_be_the_file_s_own(nominal):
    rule = "must be that of the tuned file, but got t200, .* with --problem nominal, .*: leave --preset out"
    refused(rule, problems_in, nominal, preset="t200")
