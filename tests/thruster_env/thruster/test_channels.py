"""Channels: one definition of what a sensor measures, for the plant's step and for a filter's model."""

from contextlib import contextmanager

import numpy as np
import pytest

from thruster_env.core.streams import episode_keys
from thruster_env.env.copies import Channel
from thruster_env.model.quantities import Quantity
from thruster_env.thruster.equations import simulate
from thruster_env.thruster.linear import make_linear_plant
from thruster_env.thruster.model import model_of_plant, thruster_model
from thruster_env.thruster.parameters import CHANNELS
from thruster_env.thruster.plant import make_plant

pytestmark = pytest.mark.usefixtures("as_python")

FLOW = Channel(
    Quantity("measured flow", "flow", "m/s"), 1e-4, lambda x, y, u, c: x[1], lambda x, dy, c: (0.0, 1.0)
)


def measured(sensors, **arguments):
    plant = make_plant(sensors=sensors, **arguments)
    return simulate(plant, episode_keys(range(2)), np.linspace(-20.0, 20.0, 16).reshape(2, 8))


@contextmanager
def other_channels():
    """The dictionary of channels turned round, with one more in front."""
    before = dict(CHANNELS)
    try:
        CHANNELS.clear()
        CHANNELS.update({"flow": FLOW} | dict(reversed(before.items())))
        yield
    finally:
        CHANNELS.clear()
        CHANNELS.update(before)


ALL = ["thrust", "speed", "speed-magnitude", "current"]
UNCERTAIN = {"load_gain": {"name": "log-normal", "std": 0.3}}


@pytest.mark.parametrize("uncertainty", [None, UNCERTAIN])
def test_order_and_number_of_the_known_channels_change_no_number(uncertainty):
    before = measured(ALL, uncertainty=uncertainty).measurements
    with other_channels():
        after = measured(ALL, uncertainty=uncertainty).measurements
    np.testing.assert_array_equal(after, before)
    assert list(CHANNELS) == ALL


def test_a_further_channel_is_measured_and_predicted():
    with other_channels():
        run = measured(["speed", "flow"], measurement_noise_cov=[0.0, 0.0])
        model = thruster_model(sensors=["flow", "speed"])
        with pytest.raises(ValueError, match="sensors must name at most 4 channels, but got 5"):
            make_plant(sensors=list(CHANNELS))
    np.testing.assert_array_equal(run.measurements, run.states)
    assert [quantity.symbol for quantity in model.measurements] == ["flow", "speed"]
    np.testing.assert_array_equal(model.measurement_noise_cov, np.diag([1e-4, 4.0]))
    assert model.observe((3.0, -0.5), model.constants) == (-0.5, 3.0)
    assert model.observe_jacobian((3.0, -0.5), model.constants) == ((0.0, 1.0), (1.0, 0.0))


def test_a_model_predicts_what_the_plant_measures():
    known = [name for name in ALL if CHANNELS[name].slopes is not None]
    run, model = measured(known, measurement_noise_cov=[0.0] * 3), thruster_model(sensors=known)
    for x, z in zip(run.states[0], run.measurements[0], strict=True):
        np.testing.assert_allclose(model.observe(tuple(x), model.constants), z, rtol=1e-14)


def test_slopes_are_those_of_what_is_read():
    model, step = thruster_model(sensors=["thrust", "speed", "speed-magnitude"]), np.array([1e-4, 1e-6])
    for x in ((30.0, 0.4), (-12.0, 0.3)):
        for i in range(2):
            ahead, astern = (
                model.observe(tuple(np.array(x) + sign * step * (np.arange(2) == i)), model.constants)
                for sign in (1.0, -1.0)
            )
            expected = np.subtract(ahead, astern) / (2 * step[i])
            rows = np.array(model.observe_jacobian(x, model.constants))
            np.testing.assert_allclose(rows[:, i], expected, rtol=1e-5, atol=1e-6)


def test_a_linear_plant_has_the_channels_that_are_affine():
    plant = make_linear_plant(sensors=["speed", "thrust"])
    np.testing.assert_array_equal(model_of_plant(plant).matrices()[3], [[1.0, 0.0], plant.linear.c[0]])
    with pytest.raises(ValueError, match="channels of a linear model must be thrust, speed, but got"):
        model_of_plant(make_linear_plant(sensors=["speed-magnitude"]))
    with pytest.raises(ValueError, match="that a model of the state can predict must be thrust, speed, speed-mag"):
        thruster_model(sensors=["current", "thrust"])
