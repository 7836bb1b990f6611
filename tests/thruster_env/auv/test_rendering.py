"""Pictures of the vehicle: what they show, and that they show it where it is."""

import copy
import math
import pickle
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest

from filters import EstimateState
from thruster_env.auv.paths import STRAIGHT_AHEAD, DepthAndCourse, make_path
from thruster_env.auv.rendering import ChartEntry, Overlay, Renderer

pytest.importorskip("pygame")

from thruster_env.auv.rendering import HULL, PROJECTION, attitude
from thruster_env.render.canvas import BAND, ESTIMATE, INK, REFERENCE  # noqa: E402

ARGUMENTS = {
    "path": make_path("IV").points,
    "max_thrust": 4.0,
    "max_plane": 0.26,
    "dt": 0.05,
    "frames_per_second": 20.0,
}
START = ChartEntry(0.0, 0, 0, 0, 0, 0, 0, 1.0, 0.02, 1.0, 0.0, 1.0, 2.8, 0.0, 0.0)
BELIEF = Overlay("EKF", 0.5, 0.4, 0.2, 0.4, 0.1, 0.3, 0.0, 0.0, 0.1, 0.9, 0.05)
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


def test_an_estimate_is_blue_with_its_band_and_what_it_lacks_is_not_drawn():
    view, depth, speed = np.s_[:230, :498], np.s_[256:308, :490], np.s_[312:384, :490]
    pitch, yaw = np.s_[:76, 498:], np.s_[153:230, 498:]

    def blue(picture, part):
        return pixels_like(picture[part], ESTIMATE).any()

    full = frame(START, LATER, overlay=BELIEF)
    assert pixels_like(full[view], BAND).sum() > 100
    assert all(blue(full, part) for part in (speed, pitch, yaw))
    partly = frame(START, LATER, overlay=BELIEF._replace(**dict.fromkeys(Overlay._fields[1:7]), psi=None))
    assert [blue(partly, part) for part in (view, depth, speed, pitch, yaw)] == [False, False, True, True, False]


def test_axes_of_the_body_turn_as_angles_do():
    np.testing.assert_allclose(attitude(0.0, 0.0, math.pi / 2)[0], [0, 1, 0], atol=1e-12)  # yaw: to the east
    np.testing.assert_allclose(attitude(0.0, 0.5, 0.0)[0], [math.cos(0.5), 0, -math.sin(0.5)], atol=1e-12)
    np.testing.assert_allclose(attitude(0.5, 0.0, 0.0)[1], [0, math.cos(0.5), math.sin(0.5)], atol=1e-12)
    north, east, down = PROJECTION
    assert north[0] > 0 > north[1] and east[0] > 0 < east[1] and down[0] == 0 < down[1]


def test_straight_paths_are_shown_from_where_the_vehicle_was_to_ahead_of_it():
    path = make_path(STRAIGHT_AHEAD).points
    far = frame(START._replace(x=500.0), LATER._replace(x=501.0), path=path)
    near = frame(START, LATER, path=path)
    counts = [pixels_like(picture[20:200, :490], REFERENCE).sum() for picture in (far, near)]
    assert min(counts) > 20 and counts[0] == pytest.approx(counts[1], rel=0.1)


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


def test_importing_the_env_stays_light():
    heavy = ["numba", "scipy", "matplotlib", "optuna", "torch", "filters", "tuning", "pygame"]
    code = f"import sys, thruster_env.auv; print([name for name in {heavy} if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
