import numpy as np
import pytest

from thruster_env.auv.parameters import LAUV, SEGOROGENI
from thruster_env.auv.plant import CHANNELS, INSTRUMENTS, STATES, SUITES, SYMBOLS, channels_of, make_plant, suite


def test_the_default_plant_is_the_documented_one():
    plant = make_plant()
    assert (plant.parameters, plant.dt, plant.substeps) == (SEGOROGENI, 0.05, 1)
    assert (plant.max_thrust, plant.max_plane, plant.propeller_torque) == (
        4.0,
        pytest.approx(0.2618, abs=1e-5),
        -0.006,
    )
    np.testing.assert_array_equal(np.diag(plant.process_noise_cov), [5e-6] * 6 + [1e-8] * 6)
    assert plant.channels == ("u", "v", "w", "p", "q", "r", "phi", "theta", "psi", "z")
    deviations = [0.02, 0.02, 0.02, 0.003, 0.003, 0.003, 0.005, 0.005, 0.0175, 0.02]
    np.testing.assert_allclose(np.sqrt(np.diag(plant.measurement_noise_cov)), deviations)
    assert [plant.instruments[channel].rate for channel in plant.channels] == [5] * 3 + [20] * 6 + [10]
    np.testing.assert_array_equal(plant.initial_mean, np.eye(12)[0])
    assert [quantity.symbol for quantity in plant.inputs] == ["X_prop", "delta_s", "delta_r"]
    assert len(make_plant(propeller_torque=None).inputs) == 4
    assert plant.dropping_channels == (0, 1, 2, 9)  # those slower than the step
    assert make_plant(sensors={"u": [], "z": [{"name": "dropout", "probability": 0.1}]}).dropping_channels == (1,)


def test_starts_are_at_a_speed_at_a_state_or_drawn():
    assert not make_plant(initial_state={"speed": 0}).initial_mean.any()
    fixed = make_plant(initial_state=list(range(12)))
    assert fixed.initial_mean[8] == 8 and not fixed.initial_cov.any()
    drawn = make_plant(initial_state={"mean": [0.0] * 12, "cov": [0.1] * 12})
    assert (np.diag(drawn.initial_cov) == 0.1).all()


def test_every_channel_reads_the_state_that_it_names():
    x = tuple(range(12))
    for channels in (tuple(CHANNELS.values()), channels_of(tuple(CHANNELS), 12)):
        for name, channel in zip(CHANNELS, channels, strict=True):
            place = SYMBOLS.index(name.removesuffix("_gps"))
            assert channel.read(x, (), (), ()) == place
            assert channel.slopes(x, (), ()) == tuple(float(i == place) for i in x)
            assert channel.quantity.unit == STATES[place].unit
            assert channel.quantity.angle == (name == "psi")


def test_suites_are_made_of_instruments_that_say_where_their_numbers_are_from():
    for name in SUITES:
        found = suite(name)
        assert set(found) <= set(CHANNELS) and all(one.source for one in found.values())
        plant = make_plant(sensors=name)
        assert plant.channels == tuple(found)
        np.testing.assert_allclose(
            np.diag(plant.measurement_noise_cov), [one.deviation**2 for one in found.values()]
        )
    assert set(suite("full")) == set(CHANNELS)
    assert np.diag(make_plant(sensors="papers").measurement_noise_cov).tolist() == pytest.approx([1e-6] * 4)
    assert INSTRUMENTS["gps"].at_surface and make_plant(sensors=["u"]).instruments["u"] == INSTRUMENTS["dvl"]


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"preset": LAUV._replace(Mqd=9.0)}, "the mass matrix must be positive definite, but got the smallest"),
        ({"dt": 0.0}, "dt must be positive, but got 0.0"),
        ({"dt": 9.0}, "dt must be short enough for 64 Runge-Kutta steps to follow the vehicle, but got 9.0"),
        ({"max_thrust": -1}, "max_thrust must be positive, but got -1"),
        ({"max_plane": 2.0}, "max_plane must be from 0 to 1.5708 rad, but got 2.0"),
        ({"sensors": "sonar"}, "sensors must be one of default, motion, "),
        ({"sensors": ["u", "sonar"]}, "a channel of sensors must be one of u, v, w, "),
        ({"sensors": ["u", "u"]}, "sensors must name each channel once, but got ['u', 'u']"),
        ({"sensors": []}, "sensors must name at least one channel, but got none"),
        ({"sensors": 3}, "sensors must be a suite's name, a list of channels or a mapping from them, but got 3"),
        ({"initial_state": {"voltage": 3}}, "initial_state must be None, twelve numbers, {'speed': U} or {'mean'"),
        ({"initial_state": [1.0]}, "initial_state must be 12 finite numbers, but got [1.0]"),
        (
            {"process_noise_cov": [1e-6] * 8},
            "process_noise_cov must be 12 variances or a symmetric 12 x 12 matrix",
        ),
        ({"propeller_torque": "free"}, "propeller_torque must be a finite number, but got 'free'"),
    ],
)
def test_what_makes_no_plant_is_told_in_a_line(arguments, message):
    with pytest.raises(ValueError) as error:
        make_plant(**arguments)
    assert str(error.value).startswith(message) and "\n" not in str(error.value)
