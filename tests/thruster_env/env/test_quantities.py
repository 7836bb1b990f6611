"""Names, symbols and units of a model's components, and the digest of a model."""

import pickle

import numpy as np
import pytest

from tests.models import pendulum, swing
from thruster_env.model.affine import affine_model, linearize
from thruster_env.model.quantities import Output, Quantity
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.thruster.analysis import steady_state
from thruster_env.thruster.model import thruster_model
from thruster_env.thruster.parameters import PRESETS


def turntable(**names):
    noise = {"process_noise_cov": [1e-4, 1e-4], "measurement_noise_cov": [0.1]}
    return affine_model(
        a=[[1, 0.1], [0, 1]], b=[[0], [0.1]], c=[[1, 0]], prior_mean=[0, 0], prior_cov=[1, 1], **noise, **names
    )


def decay(**inputs):
    noise = {"process_noise_cov": [0.1], "measurement_noise_cov": [0.1], "prior_mean": [0.0], "prior_cov": [1.0]}
    return StateSpaceModel(
        transition=lambda x, u, c: (0.9 * x[0],), observe=lambda x, c: (x[0],), **noise, **inputs
    )


def test_components_without_names_are_numbered():
    found = turntable().quantities
    assert [[one.symbol for one in part] for part in found] == [["x_1", "x_2"], ["u_1"], ["z_1"]]


def test_names_may_be_words_tuples_or_quantities():
    states = [("angle", "phi", "rad", True), "rate of turn"]
    found = turntable(states=states, measurements=[Quantity("bearing", "z", "rad", True)])
    assert found.states == (Quantity("angle", "phi", "rad", True), Quantity("rate of turn", "rate_of_turn"))
    assert found.states[0].plot_label == r"angle $\phi$ [rad]" and found.states[1].label == "rate of turn"
    assert pickle.loads(pickle.dumps(found)).states == found.states
    assert found.replace(prior_cov=[2.0, 2.0]).measurements == found.measurements


@pytest.mark.parametrize(
    ("names", "rule"),
    [
        ({"states": ["one"]}, "states must be 2 quantities or names, as prior_mean says, but got"),
        ({"states": "ab"}, "states must be 2 quantities or names, as prior_mean says, but got 'ab'"),
        (
            {"input_quantities": ["a", "b"]},
            "input_quantities must be 1 quantities or names, as inputs, or b, says",
        ),
        ({"input_quantities": "ab"}, "input_quantities must be 1 .*, but got 'ab'"),
        ({"states": ["a", "a"]}, "symbols of states must differ from one another, but got a, a"),
        ({"states": ["a", 3]}, "each of states must be a name, or have name, symbol"),
        ({"states": ["a", ("b", "b\n")]}, "each of states must be a name"),
        ({"states": ["a", ("b", "b", "deg", True)]}, "an angle the unit rad, but got"),
    ],
)
def test_wrong_names_are_refused(names, rule):
    with pytest.raises(ValueError, match=rule):
        turntable(**names)


@pytest.mark.parametrize("names", [["left pump", "right pump"], ["pump"], []])
def test_there_are_as_many_inputs_as_have_names(names):
    model = decay(inputs=names)
    assert model.input_quantities == decay(input_quantities=names).input_quantities
    assert model.inputs == len(names) and [one.name for one in model.input_quantities] == names
    assert model.replace(prior_mean=[1.0]).inputs == len(names)
    assert decay().inputs == 0
    with pytest.raises(ValueError, match="input_quantities must be 3 quantities or names, as inputs, or b, says"):
        decay(inputs=3, input_quantities=names)


def test_a_thruster_s_components_and_outputs_have_names_and_units():
    model = thruster_model(sensors=["speed", "thrust"])
    assert [one.label for one in model.states] == ["motor speed [rad/s]", "flow velocity [m/s]"]
    assert [one.unit for one in model.measurements] == ["rad/s", "N"]
    assert model.states[0].plot_label == r"motor speed $\omega_{m}$ [rad/s]"
    at = steady_state(PRESETS["tunnel"], 12.0)
    states = np.array([[at[:2], [0.0, 0.0]]])
    np.testing.assert_allclose(model.output("T", states), [[at.thrust, 0.0]], rtol=1e-12)
    assert isinstance(model.outputs["T"], Output) and model.outputs["T"].quantity.unit == "N"
    with pytest.raises(ValueError, match="output must be one of T, but got 'thrust'"):
        model.output("thrust", states)


def test_a_linearised_model_keeps_the_names():
    model = thruster_model()
    assert linearize(model, model.operating_state, model.operating_input).quantities == model.quantities


@pytest.mark.parametrize("given", [3, {"T": 3}, {"T": (Quantity("thrust", "T", "N"), 3)}, {"T": ("thrust",)}])
def test_wrong_outputs_are_refused(given):
    with pytest.raises(ValueError, match="output.* must .*but got"):
        turntable().replace(outputs=given)


HEADING = Quantity("heading", "psi", "rad", True)


def within_five(x, u, c):
    if abs(x[0]) > 5.0:
        raise RuntimeError("out of range")
    return swing(x, u, c)


def test_it_is_written_here_and_so_the_same_in_every_process_and_version():
    assert pendulum().digest == "a65b0ed575ed"


def test_noise_prior_and_what_only_helps_filters_have_no_part_in_it():
    model = pendulum()
    noise = {"process_noise_cov": [1.0, 2.0], "measurement_noise_cov": [3.0, 4.0]}
    prior = {"prior_mean": [1.0, 2.0], "prior_cov": [3.0, 4.0]}
    for changes in (noise, prior, {"operating_state": [0.0, 0.0], "state_low": [-1.0, -1.0]}):
        assert model.replace(**changes).digest == model.digest
    assert pickle.loads(pickle.dumps(model)).digest == model.digest
    assert thruster_model(process_noise_cov=[1.0, 1.0]).digest == thruster_model().digest


@pytest.mark.parametrize(
    "changes",
    [
        {"constants": (9.81, 0.3 + 1e-8)},
        {"transition": within_five},
        {"observe": lambda x, c: (x[0], x[1])},
        {"substeps": 2},
        {"inputs": 2},
        {"states": [("angle", "x_1", "rad"), "x_2"]},
        {"states": [("x_1", "x_1", "rad", True), "x_2"]},
        {"input_quantities": ["torque"]},
        {"measurements": ["a", "b"]},
        {"outputs": {"a": Output(HEADING, lambda x, c: x[0])}},
    ],
)
def test_whatever_else_changes_changes_it(changes):
    assert pendulum(**changes).digest != pendulum().digest


def test_thrusters_and_affine_models_differ_by_their_numbers():
    found = [
        thruster_model(preset=preset, dt=dt) for preset in ("tunnel", "tunnel_physical") for dt in (0.01, 0.02)
    ]
    found += [thruster_model(parameter_factors={"density": 1.001}), thruster_model(sensors=["speed"])]
    found += [turntable(), turntable(states=[HEADING, "rate"])]
    assert len({model.digest for model in found}) == len(found)
