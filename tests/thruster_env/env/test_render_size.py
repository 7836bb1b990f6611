"""Pictures of other sizes: the same scene, larger or smaller, in the middle."""

import gymnasium as gym
import numpy as np
import pytest

import thruster_env  # noqa: F401
import thruster_env.auv  # noqa: F401

pytest.importorskip("pygame")


def picture(name, size):
    env = gym.make(name, render_mode="rgb_array", render_size=size)
    env.reset(seed=0)
    env.step(env.action_space.high)
    found = env.render()
    env.close()
    return found


@pytest.mark.parametrize("name", ["BowThruster-v0", "SegorogeniAUV-v0"])
def test_a_picture_of_another_size_is_the_same_scene(name):
    usual = picture(name, None)
    assert usual.shape == (400, 640, 3)
    np.testing.assert_array_equal(picture(name, [640, 400]), usual)
    double = picture(name, (1280, 800))
    assert double.shape == (800, 1280, 3)
    small = double.reshape(400, 2, 640, 2, 3).mean(axis=(1, 3))
    assert np.abs(small - usual).mean() < 4.0  # letters are drawn anew


def test_what_does_not_fit_the_shape_stays_white():
    tall = picture("BowThruster-v0", (320, 400))
    assert (tall[:100] == 255).all() and (tall[300:] == 255).all()
    assert (tall[100:300] != 255).any(axis=-1).mean() > 0.3


@pytest.mark.parametrize(
    ("size", "rule"),
    [
        (640, r"render_size must be None or \(width, height\) in pixels, but got 640"),
        ((640, 400, 3), "render_size must be None or"),
        ((640, 10), "the height of render_size must be a whole number of at least 64, but got 10"),
        ((9000, 400), "the width of render_size must be at most 4096, but got 9000"),
    ],
)
def test_a_wrong_size_is_one_clear_line(size, rule):
    with pytest.raises(ValueError, match=rule):
        gym.make("BowThruster-v0", render_size=size)
