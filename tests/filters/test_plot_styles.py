"""Colours and dashes of filters: one each, none twice, all legible on white and on dark paper."""

from filters.logs.findings import STYLES, TRUTH, colour_of, plot_style
from filters.registry import FILTERS
from tuning.reporting.page import luminance, on_dark


def test_every_filter_has_a_look_of_its_own():
    assert set(STYLES) == set(FILTERS)
    looks = [tuple(plot_style(name).values()) for name in (*FILTERS, "somebody:Estimator")]
    assert len(set(looks)) == len(looks)
    assert TRUTH["color"] not in {colour for colour, _ in looks}


def test_filters_that_are_drawn_together_differ_in_hue():
    for some in (
        ("kf", "ekf", "enkf", "ukf", "pf"),
        ("ekf", "iekf", "ukf", "ckf", "gsf"),
        ("enkf", "etkf", "denkf"),
    ):
        assert len({colour_of(name) for name in some}) == len(some)
    assert len({colour_of(name) for name in ("ekf", "open-loop", "low-pass", "inversion")}) == 4


def test_colours_are_legible_on_white_and_on_dark_paper():
    for colour, _ in STYLES.values():
        assert luminance(colour) < 0.45 and luminance(on_dark(colour)) > 0.2
