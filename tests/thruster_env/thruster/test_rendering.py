import math
import subprocess
import sys
import time

import numpy as np
import pytest
from gymnasium.error import DependencyNotInstalled

from thruster_env.thruster.rendering import ChartEntry, Overlay, Renderer

pygame = pytest.importorskip("pygame")

from thruster_env.render.canvas import fitting_axis  # noqa: E402
from thruster_env.thruster.rendering import (  # noqa: E402  # noqa: E402
    FLOW,
    FORCE,
    FORCE_LENGTH,
    MIDDLE,
)

GEAR_RATIO, DT = 2.0, 0.01
ARGUMENTS = {
    "gear_ratio": GEAR_RATIO,
    "diameter": 0.0762,
    "max_voltage": 24.0,
    "thrust_scale": 49.1,
    "speed_scale": 387.5,
    "flow_scale": 7.35,
    "dt": DT,
    "frames_per_second": 100.0,
}
REST = ChartEntry(0.0, 0.0, 0.0, 0.0, 0.0, 12.3, 0.0, 0.0)
FORWARD = ChartEntry(1.0, 193.8, 3.674, 12.29, 12.5, 12.3, 12.0, 0.0)
REVERSE = ChartEntry(1.0, -193.8, -3.674, -12.29, -12.5, 12.3, -12.0, 0.0)
BELIEF = Overlay("EKF", 11.0, 0.5, 190.0, 5.0, 3.5, 0.1)


def renderer(mode="rgb_array", **changes):
    return Renderer(mode, **{**ARGUMENTS, **changes})


def frame(*moments, overlay=None):
    """The picture after some moments, of a renderer of its own."""
    r = renderer()
    for moment in moments:
        r.add(moment, overlay)
    return r.draw()


def pixels_like(picture, colour, tolerance=20):
    """Where a picture has a colour, a boolean array (height, width)."""
    return np.abs(picture.astype(int) - colour).max(axis=-1) <= tolerance


# --- pictures ---------------------------------------------------------------------------------------------


def test_a_frame_is_an_rgb_array():
    picture = frame(FORWARD)
    assert picture.shape == (400, 640, 3) and picture.dtype == np.uint8
    assert picture.flags["C_CONTIGUOUS"] and picture.flags["WRITEABLE"]


def test_a_moment_drawn_twice_gives_the_same_frame():
    r = renderer()
    for moment in (REST, FORWARD, FORWARD):
        r.add(moment)
        first = r.draw()
        np.testing.assert_array_equal(r.draw(), first)
        first[:] = 0  # a caller may write into a frame
        assert r.draw().any()


def test_a_new_episode_starts_empty():
    r = renderer()
    for moment in (FORWARD, REVERSE, FORWARD):
        r.add(moment, BELIEF)
    r.draw()
    r.begin()
    r.add(REST)
    np.testing.assert_array_equal(r.draw(), frame(REST))


def test_charts_forget_what_is_older_than_500_steps():
    old = [REVERSE] * 30
    new = [FORWARD._replace(time=k * DT, omega_m=0.0, measured_thrust=k % 17) for k in range(520)]
    np.testing.assert_array_equal(frame(*old, *[REST] * 90, *new)[190:], frame(*[REST] * 120, *new)[190:])


@pytest.mark.parametrize("other", [FORWARD, REVERSE, REST._replace(voltage=5.0), REST._replace(reference=None)])
def test_what_happens_is_seen(other):
    assert (frame(other) != frame(REST)).any()


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e300])
def test_no_number_is_too_wild_to_draw(value):
    wild = ChartEntry(1.0, *[value] * 7)
    belief = Overlay("EKF", *[value] * 6)
    assert frame(REST, wild, wild, overlay=belief).shape == (400, 640, 3)
    assert frame(wild, REST, overlay=belief).shape == (400, 640, 3)


# --- arrows -----------------------------------------------------------------------------------------------


def flow_arrows(flow):
    return pixels_like(frame(REST._replace(U_a=flow)), FLOW)[55:175, : 2 * MIDDLE]


def test_forward_and_reverse_flow_are_mirror_images():
    forward, reverse = flow_arrows(3.674), flow_arrows(-3.674)
    mirrored = reverse[:, ::-1]
    assert forward.sum() > 300
    assert (forward != mirrored).sum() < 0.1 * forward.sum()  # rounding at the edges
    assert (forward != reverse).sum() > 0.4 * forward.sum()


@pytest.mark.parametrize("thrust", [20.0, -20.0])
def test_the_ship_is_pushed_against_the_water_that_is_driven(thrust):
    arrow = pixels_like(frame(REST._replace(thrust=thrust)), FORCE)[:25, : MIDDLE + 80]
    columns = np.flatnonzero(arrow.any(axis=0))
    widest = np.argmax(arrow.sum(axis=0))
    assert columns[-1] - columns[0] == pytest.approx(FORCE_LENGTH * 20 / 49.1, abs=4)
    assert (widest < MIDDLE) == (thrust > 0)


# --- the propeller ----------------------------------------------------------------------------------------


def test_blades_turn_with_the_propeller_not_with_the_frames():
    r = renderer()
    speeds = 100.0 + 50.0 * np.sin(np.arange(200) / 20)
    for k, omega_m in enumerate(speeds):
        r.add(REST._replace(omega_m=omega_m))
        if k % 7 == 0:
            r.draw()
    by_trapezoids = ((speeds[1:] + speeds[:-1]) / 2).sum() * DT / GEAR_RATIO
    assert r.blade_angle == pytest.approx(by_trapezoids, rel=1e-12)


# --- estimates --------------------------------------------------------------------------------------------


def test_an_overlay_is_seen():
    plain = frame(FORWARD, FORWARD)
    believed = frame(FORWARD, FORWARD, overlay=BELIEF)
    changed = (plain != believed).any(axis=-1)
    assert changed[190:].any() and not changed[:186].any()


def test_an_estimate_that_comes_after_its_step_stands_at_its_step():
    at_once, later = renderer(), renderer()
    for k in range(5):
        belief = BELIEF._replace(thrust=10.0 + k)
        at_once.add(FORWARD, belief)
        later.add(FORWARD)
        later.amend(belief)
    np.testing.assert_array_equal(at_once.draw(), later.draw())


def test_an_estimate_of_nothing_is_ignored():
    r = renderer()
    r.amend(BELIEF)
    r.add(REST)
    r.amend(None)
    np.testing.assert_array_equal(r.draw(), frame(REST))


@pytest.mark.parametrize(
    ("values", "low", "high"),
    [
        ([0.0, 0.0], -1.0, 1.0),
        ([math.nan], -1.0, 1.0),
        ([0.0, 12.3], 0.0, 15.0),
        ([-0.3, 11.0], -0.3, 15.0),
        ([-200.0, 5.0], -150.0, 5.0),
        ([5000.0, math.nan], 0.0, 150.0),
    ],
)
def test_an_axis_has_round_ends_around_zero(values, low, high):
    axis = fitting_axis(np.array(values), 50.0, 100.0, 40.0)
    assert (axis.low, axis.high) == pytest.approx((low, high))
    assert axis.y(axis.low) == 140.0 and axis.y(axis.high) == 100.0


# --- windows, videos, and what can go wrong ---------------------------------------------------------------


@pytest.fixture
def window():
    r = renderer("human")
    r.add(FORWARD)
    yield r
    r.close()


def test_a_window_opens_and_closes(window):
    assert window.draw() is None
    assert pygame.display.get_surface().get_size() == (640, 400)
    shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
    np.testing.assert_array_equal(shown, frame(FORWARD))
    window.close()
    assert not pygame.display.get_init()
    window.close()
    window.draw()
    assert pygame.display.get_init()


def test_a_window_keeps_real_time(window):
    window.draw()
    start = time.perf_counter()
    for _ in range(20):
        window.add(FORWARD)
        window.draw()
    assert time.perf_counter() - start > 0.15  # 0.2 s; some of it may be made up for


@pytest.mark.parametrize("kind", [pygame.QUIT, pygame.WINDOWCLOSE])
def test_a_window_closed_by_hand_stays_closed(window, kind):
    window.draw()
    pygame.event.post(pygame.event.Event(kind))
    for _ in range(3):
        window.add(FORWARD)
        assert window.draw() is None
        assert not pygame.display.get_init()
    window.close()
    window.draw()
    assert pygame.display.get_init()


def test_another_env_may_end_pygame(window):
    off_screen = renderer()
    off_screen.add(FORWARD)
    before = off_screen.draw()
    window.draw()
    pygame.quit()
    off_screen.add(REVERSE._replace(time=2.0))
    assert (off_screen.draw() != before).any()
    assert window.draw() is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mode": "ansi"}, "mode must be one of human, rgb_array, but got 'ansi'"),
        *(({name: 0.0}, f"{name} must be positive, but got 0.0") for name in ARGUMENTS),
    ],
)
def test_a_wrong_argument_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        Renderer(**{"mode": "rgb_array", **ARGUMENTS, **changes})


def test_without_pygame_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(DependencyNotInstalled, match=r"pip install '\.\[render\]'"):
        renderer()


def test_pygame_is_not_imported_before_it_is_needed():
    code = "import sys, thruster_env.thruster.rendering; print('pygame' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "False"
