"""Pictures of the vehicle: what they show, and that they show it where it is."""

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest

from filters import EstimateState
from thruster_env.auv.paths import DepthAndCourse, make_path
from thruster_env.auv.rendering import ChartEntry, Renderer

pytest.importorskip("pygame")

from thruster_env.auv.rendering import HULL
from thruster_env.render.canvas import ESTIMATE, INK, REFERENCE  # noqa: E402

ARGUMENTS = {
    "path": make_path("IV").points,
    "max_thrust": 4.0,
    "max_plane": 0.26,
    "dt": 0.05,
    "frames_per_second": 20.0,
}
START = ChartEntry(0.0, 0, 0, 0, 0, 0, 0, 1.0, 0.02, 1.0, 0.0, 1.0, 2.8, 0.0, 0.0)
LATER = START._replace(time=0.05, x=1.0, y=0.3, depth=0.5, theta=-0.2, psi=0.3, u=0.9)


def frame(*moments, overlay=None, **changes):
    renderer = Renderer("rgb_array", **{**ARGUMENTS, **changes})
    for moment in moments:
        renderer.add(moment, overlay)
    return renderer.draw()


def pixels_like(picture, colour, tolerance=24):
    return np.abs(picture.astype(int) - colour).max(axis=-1) <= tolerance


def test_a_frame_has_path_hull_and_charts_and_is_the_same_again():
    picture = frame(START, LATER)
    assert picture.shape == (400, 640, 3) and picture.dtype == np.uint8
    view = picture[:230, :498]
    assert pixels_like(view, HULL).sum() > 80 and pixels_like(view, REFERENCE).sum() > 20
    assert pixels_like(picture[230:], INK).sum() > 100
    assert not pixels_like(picture, ESTIMATE).any()
    np.testing.assert_array_equal(picture, frame(START, LATER))


@pytest.mark.parametrize(
    "field, value, window",
    [
        ("theta", 0.5, np.s_[0:76, 498:]),
        ("phi", 0.5, np.s_[76:153, 498:]),
        ("psi", 0.5, np.s_[153:230, 498:]),
        ("depth", 1.5, np.s_[250:310, :490]),
        ("u", 0.5, np.s_[320:390, :490]),
        ("thrust", 1.0, np.s_[236:, 500:550]),
        ("stern", 0.1, np.s_[236:, 550:594]),
        ("rudder", 0.1, np.s_[236:, 596:]),
    ],
)
def test_what_happens_is_seen_in_its_place(field, value, window):
    changed = frame(START, LATER._replace(**{field: value}))
    assert (changed[window] != frame(START, LATER)[window]).any()


@pytest.mark.usefixtures("as_python")
def test_an_env_draws_itself_with_its_filter_and_copies_go_on():
    env = EstimateState(gym.make("SegorogeniAUVPath-v0", sensors="motion", render_mode="rgb_array"), "ekf")
    assert env.metadata["render_fps"] == 20
    env.reset(seed=1)
    controller, state = DepthAndCourse.for_env(env, "motion"), None
    observation, _ = env.reset(seed=1)
    for _ in range(3):
        action, state = controller.predict(observation, state)
        observation, *_ = env.step(action)
    picture = env.render()
    assert pixels_like(picture[312:384, :490], ESTIMATE).any()
    for other in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        np.testing.assert_array_equal(other.render(), picture)
    moment = env.unwrapped.moment_of(env.unwrapped._out.reshape(-1).tolist())
    assert moment.measured_depth is None and moment.thrust == pytest.approx(float(action[0]))
    env.close()
