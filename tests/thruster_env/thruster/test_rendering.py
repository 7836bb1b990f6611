import math
import sys
import time

import numpy as np
import pytest
from gymnasium.error import DependencyNotInstalled

from thruster_env.thruster.rendering import ChartEntry, Overlay, Renderer

pygame = pytest.importorskip("pygame")

from thruster_env.render.canvas import fitting_axis  # noqa: E402
from thruster_env.thruster.rendering import (  # noqa: E402  # noqa: E402
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


@pytest.mark.parametrize("thrust", [20.0, -20.0])
def test_the_ship_is_pushed_against_the_water_that_is_driven(thrust):
    arrow = pixels_like(frame(REST._replace(thrust=thrust)), FORCE)[:25, : MIDDLE + 80]
    columns = np.flatnonzero(arrow.any(axis=0))
    widest = np.argmax(arrow.sum(axis=0))
    assert columns[-1] - columns[0] == pytest.approx(FORCE_LENGTH * 20 / 49.1, abs=4)
    assert (widest < MIDDLE) == (thrust > 0)


# --- the propeller ----------------------------------------------------------------------------------------


# --- estimates --------------------------------------------------------------------------------------------


def test_an_overlay_is_seen():
    plain = frame(FORWARD, FORWARD)
    believed = frame(FORWARD, FORWARD, overlay=BELIEF)
    changed = (plain != believed).any(axis=-1)
    assert changed[190:].any() and not changed[:186].any()


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
