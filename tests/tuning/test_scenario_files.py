import numpy as np
import pytest

from tuning.evaluation.evaluate import evaluate
from tuning.evaluation.held_out import Comparison
from tuning.evaluation.tuned import read_tuned, write_tuned
from tuning.problems.excitation import BinarySequence, Steps
from tuning.search.plan import Plan
from tuning.search.space import untuned_choice
from tuning.search.study import StudyResult
from tuning.thruster.scenario import find_scenario


@pytest.fixture
def file(tmp_path, monkeypatch):
    """Write a scenario file in the working folder and return its name."""
    monkeypatch.chdir(tmp_path)

    def write(text):
        (tmp_path / "my.toml").write_text(text)
        return "my.toml"

    return write


def test_a_file_changes_its_base(file):
    text = """
        base = "outliers"
        about = "outliers under a binary sequence, with gusts"
        scale = [1.0, 0.05]
        steps = 200
        excitation = {name = "prbs", amplitude = 8, hold = 40}
        flow = [{name = "gusts", std = 0.5}]
        [parameter_factors]
        lift_coefficient = 1.1
    """
    scenario, outliers = find_scenario(file(text)), find_scenario("outliers")
    assert scenario.name == "my.toml" and scenario.about == "outliers under a binary sequence, with gusts"
    assert scenario.excitation == BinarySequence(8.0, 40) and scenario.scale == (1.0, 0.05)
    assert scenario.plant.sensors == outliers.plant.sensors and scenario.plant.flow[0].std == 0.5
    assert dict(scenario.parameter_factors) == {"lift_coefficient": 1.1}
    assert scenario == find_scenario("my.toml") and hash(scenario) == hash(find_scenario("my.toml"))
    assert scenario.data([1, 2]).states.shape == (2, 201, 2)


def test_without_base_and_scale_it_is_nominal_and_the_scale_is_computed(file):
    scenario = find_scenario(file("measurement_noise_cov = 4.0\nsteps = 60"))
    assert scenario.excitation == Steps() and scenario.about == ""
    assert scenario.scale == tuple(scenario.computed_scale(200))
    assert scenario.scale[1] > find_scenario("nominal").scale[1]


def test_a_linear_system_can_be_told_by_a_file(file):
    scenario = find_scenario(file('base = "published_tunnel"\nscale = [1.0, 1.0]\nmeasurement_noise_cov = 1'))
    assert scenario.plant.linear is not None and scenario.measurement_noise_cov == 1.0


def test_a_tuned_filter_finds_the_file_of_its_scenario_again(file):
    scenario = find_scenario(file("scale = [1.0, 0.05]\nsteps = 60"))
    choice = untuned_choice("ekf", scenario)
    evaluation = evaluate(choice.filter(scenario), scenario.data([1, 2]), scenario.scale)
    result = StudyResult(choice, 1.0, [], [], 0.0, False)
    comparison = Comparison(evaluation, evaluation, evaluation, np.array([1.0, 1.0]), range(2))
    write_tuned("tuned.json", Plan("ekf", (scenario,)), result, [comparison], "s")
    assert read_tuned("tuned.json") == (choice, scenario, 0)


BAD = {
    "colour = 1": r"keys of a scenario must be among plant, base, about, .*, but my.toml has \['colour'\]",
    "name = 'x'": r"keys of a scenario must be among .*, but my.toml has \['name'\]",
    "plant = 'kite'": r"plant of a scenario must be one of thruster.*, but got 'kite' \(in my.toml\)",
    "a = [": "a scenario file must be TOML, but my.toml is not: ",
    "base = 'none'": r"scenario must be one of nominal, .*, but got 'none' \(in my.toml\)",
    "scale = [1.0, 0.0]": r"scale must be positive in every state, but got \[1.0, 0.0\] \(in my.toml\)",
    "scale = 1.0": r"scale must be 2 finite numbers, but got 1.0 \(in my.toml\)",
    "steps = 50": r"steps must be a whole number of at least 51, but got 50 \(in my.toml\)",
    "process_noise_cov = [0.0, 0.0]\ninitial_state = [0.0, 0.0]": "the RMSE of the open loop is",
    "base = 'published_open_bladed'\nprocess_noise_cov = [1.0, 0.0]": "needs a bound or a stable open loop",
    "measurement_noise_cov = 'small'": r"measurement_noise_cov must be a finite number, but got 'small'",
    "excitation = {name = 'steps', height = 3}": "arguments of 'steps' must be among amplitude, hold",
    "excitation = 'prbs'": "each entry of excitation must be a mapping whose name is one of steps",
    "sensors = ['thrust', 'speed']": "measurement_noise_cov must be 2 finite numbers, but got 0.25",
    "sensors = ['current']": r"channels that a model of the state can predict must be .* \(in my.toml\)",
    "sensors = 3": r"sensors of a scenario must be one channel or several, but got 3 \(in my.toml\)",
    "flow = [{name = 'tide'}]": "each entry of flow must be a mapping whose name is one of",
    "preset = 'none'": "preset must be one of",
    "system = 'none'": "system must be one of tunnel, open_bladed, but got 'none'",
    "parameter_factors = {colour = 2}": "parameter_factors must name fields of",
    "parameter_factors = 2": r"parameter_factors must be a mapping, but got 2 \(in my.toml\)",
    "about = 2": r"about must be text, but got 2 \(in my.toml\)",
    "dt = -1": r"dt must be positive, but got -1 \(in my.toml\)",
    "initial_state = 'rest'": "initial_state must be",
    "uncertainty = 3": "uncertainty must be",
}


@pytest.mark.parametrize(("text", "line"), BAD.items(), ids=list(BAD))
def test_what_is_wrong_with_a_file_is_one_clear_line(text, line, file):
    with pytest.raises(ValueError, match=line) as caught:
        find_scenario(file(text))
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_one_clear_line(tmp_path):
    with pytest.raises(ValueError, match="a scenario file must be readable, but .*no.toml is not: No such file"):
        find_scenario(str(tmp_path / "no.toml"))
