"""Limits of panels over time: neither a start-up nor another filter's errors flatten what they show."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from tuning.reporting.time_figures import limit_errors, limit_values

START = 3


def row():
    """Two panels side by side."""
    return Figure().subplots(1, 2)


def texts(axis):
    """What is written in a panel."""
    return [one.get_text() for one in axis.texts]


@pytest.mark.parametrize(("ratio", "differ"), [(5.0, False), (50.0, True)])
def test_errors_have_the_limits_of_the_scored_steps(ratio, differ):
    small = np.array([100.0, 2.0, 0.1, 0.3, -0.4, 0.0])  # a start-up of 100
    band = np.full(6, 0.2)
    axes = row()
    limit_errors(axes, [ratio * small, small], [band, band], START)
    before, after = (axis.get_ylim() for axis in axes)
    assert before == pytest.approx((-0.4 * ratio * 1.08, 0.4 * ratio * 1.08))
    assert after == pytest.approx((-0.4 * 1.08, 0.4 * 1.08) if differ else before)
    root = np.sqrt((0.3**2 + 0.4**2) / 3)
    assert texts(axes[1])[0] == f"RMSE {root:.3g}; start-up is cut off"
    assert ("axes differ" in texts(axes[0])) == ("axes differ" in texts(axes[1])) == differ


def test_a_row_of_nothing_is_left_alone_and_a_wide_band_is_cut():
    nothing = np.full(6, np.nan)
    axes = row()
    limit_errors(axes, [nothing, nothing], [nothing, nothing], START)
    assert texts(axes[0]) == [""]
    limit_errors(axes, [np.ones(6), np.ones(6)], [np.full(6, 1e6), nothing], START)
    assert axes[0].get_ylim() == pytest.approx((-4.32, 4.32))


def test_estimates_share_limits_with_as_much_again_of_their_bands():
    axes = row()
    limit_values(axes, [np.array([0.0, 1.0]), np.array([0.5])], [np.array([-9.0, 1.5])])
    assert axes[0].get_ylim() == axes[1].get_ylim() == pytest.approx((-1.08, 1.58))
