"""What a tuned file's vehicle differs in from an env's."""

import gymnasium as gym
import pytest

import thruster_env.auv  # noqa: F401 - registers the envs
from thruster_env.auv.plant import ENTRIES, make_plant, plant_data

pytestmark = pytest.mark.usefixtures("as_python")


def check(tuned_for, **given):
    gym.make("SegorogeniAUV-v0", **given).unwrapped.check_tuned_for(tuned_for, "a.json")


def test_the_same_vehicle_passes_and_a_file_that_does_not_tell_does(recwarn):
    check(plant_data(make_plant()))
    check(None)
    assert not [warning for warning in recwarn if "tuned" in str(warning.message)]
    assert set(plant_data(make_plant())) == set(ENTRIES.names)


def test_other_noise_and_disturbances_are_warned_of():
    with pytest.warns(UserWarning, match="a.json was tuned for .*current .*plane_lag 0.0 .here 0.1"):
        check(plant_data(make_plant()), current=[0.1, 0.0, 0.0], plane_lag=0.1)


@pytest.mark.parametrize(
    "given, what",
    [
        ({"preset": "remus100"}, "tuned for preset segorogeni .here remus100"),
        ({"dt": 0.02}, "tuned for dt 0.05 .here 0.02"),
        ({"sensors": "papers"}, "tuned for sensors u, v, w, p, q, r, phi, theta, psi, z .here u, v, w, r"),
        ({"attitude": "quaternion"}, "tuned for attitude euler .here quaternion"),
        ({"propeller_torque": None}, "tuned for propeller_torque -0.006 .here None"),
    ],
)
def test_another_vehicle_is_refused(given, what):
    with pytest.raises(ValueError, match=what):
        check(plant_data(make_plant()), **given)


def test_data_of_something_else_are_refused():
    with pytest.raises(ValueError, match="a plant's data must have preset, .*in the tuned file a.json"):
        check({"preset": "tunnel"})
