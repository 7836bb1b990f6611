"""Fewer points than steps, without losing a peak."""

import numpy as np

from tuning.exploring.page.pictures import corners, drawn_steps, extremes


def test_a_short_run_is_drawn_whole():
    assert drawn_steps(5, 5).tolist() == [0, 1, 2, 3, 4]
    values = np.array([1.0, np.nan, 3.0])
    assert extremes(values, drawn_steps(3, 10)) is values


def test_places_go_from_the_first_step_to_the_last():
    at = drawn_steps(1001, 101)
    assert at[0] == 0 and at[-1] == 1000 and set(np.diff(at)) == {10}


def test_each_stretch_shows_what_is_farthest_from_the_mean():
    values = np.zeros(100)
    values[37], values[62] = 9.0, -4.0
    values[80:90] = np.nan
    at = np.arange(0, 100, 10)
    found = extremes(values, at)
    expected = np.zeros(10)
    expected[3], expected[6], expected[8] = 9.0, -4.0, np.nan
    np.testing.assert_array_equal(found, expected)


def test_level_stretches_need_their_ends_alone():
    low = np.array([np.nan, np.nan, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 2.0])
    high = np.array([np.nan, np.nan, 5.0, 5.0, 5.0, 5.0, 5.0, 6.0, 6.0])
    assert corners(low, high).tolist() == [0, 1, 2, 4, 5, 6, 7, 8]
    assert corners(np.ones(5)).tolist() == [0, 4] and corners(np.ones(1)).tolist() == [0]
