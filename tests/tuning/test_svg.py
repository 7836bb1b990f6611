"""Pictures of a page: text stays text, colours are variables, and what a script reads off is where it is drawn."""

import json
import re
from html import unescape

import numpy as np
import pytest

from thruster_env.core.files import BLUE, MOST_POINTS, RUST, panels, thinned
from tuning.reporting.page import figure_svg


@pytest.fixture(scope="module")
def drawn():
    figure, (left, right) = panels(2, 2, (3.0, 2.0))
    x = np.linspace(0.0, 5.0, 40)
    left.plot(x, 2.0 * x - 3.0, color=BLUE, label="a line")
    left.plot([0.0, 5.0], [1.0, 1.0], color=RUST, label="two points")
    left.set(xlabel="time [s]", ylabel="speed $\\omega_m$ [rad/s]", xlim=(0.0, 5.0), ylim=(-4.0, 8.0))
    right.plot(x, np.exp(x))
    right.set(yscale="log", ylabel="$U_a$ [m/s]")
    return figure_svg(figure, "q7")


def test_text_is_text_and_colours_are_those_of_the_page(drawn):
    svg, _ = drawn
    assert ">time [s]</text>" in svg and "<metadata" not in svg and "http" not in svg
    assert not re.search(r"#[0-9a-fA-F]{6}\b", svg) and "var(--c-0b6fa4)" in svg and "var(--c-b5541c)" in svg
    ids = re.findall(r'\bid="([^"]*)"', svg)
    assert all(one.startswith("q7-") for one in ids) and len(ids) == len(set(ids))
    assert set(re.findall(r'href="#([^"]*)"|url\(#([^)]*)\)', svg)) <= {(one, "") for one in ids} | {
        ("", one) for one in ids
    }


def test_values_are_read_off_where_they_are_drawn(drawn):
    svg, readings = drawn
    left, right = json.loads(unescape(readings))
    assert [label for _, label in left["lines"]] == ["a line"] and left["label"] == "time [s]"
    assert right["log"] == [False, True] and right["lines"][0][1] == "U_a [m/s]"
    group = svg[svg.index(f'id="{left["lines"][0][0]}"') :]
    path = re.search(r' d="([^"]*)"', group)[1]
    points = np.array(re.findall(r"(-?[\d.]+) (-?[\d.]+)", path), float)
    (x0, top, x1, bottom), (low, high) = left["box"], left["y"]
    times = left["x"][0] + (points[:, 0] - x0) / (x1 - x0) * np.diff(left["x"])
    values = low + (bottom - points[:, 1]) / (bottom - top) * (high - low)
    np.testing.assert_allclose([times[0], times[-1]], [0.0, 5.0], atol=0.01)
    np.testing.assert_allclose(values, 2.0 * times - 3.0, atol=0.05)


def test_a_thinned_line_keeps_its_extremes_and_its_ends():
    x = np.arange(20_000.0)
    y = np.sin(x / 700)
    y[[4321, 17_000]] = 9.0, -9.0
    y[5000:5040] = np.nan
    times, values = thinned(x, y)
    assert len(times) <= MOST_POINTS and (np.diff(times) > 0).all()
    assert np.nanmax(values) == 9.0 and np.nanmin(values) == -9.0 and times[np.nanargmax(values)] == 4321
    _, above = thinned(x, y, np.fmax)
    assert np.nanmax(above) == 9.0 and len(above) == MOST_POINTS // 2
    short = x[:100], y[:100]
    assert all(np.array_equal(one, other) for one, other in zip(thinned(*short), short, strict=True))
