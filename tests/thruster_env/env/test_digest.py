"""The digest of a model: the same for the same model anywhere, another for another one."""

import pickle

import pytest

from tests.models import pendulum, swing
from tests.thruster_env.env.test_quantities import turntable
from thruster_env.model.quantities import Output, Quantity
from thruster_env.thruster.model import thruster_model

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
