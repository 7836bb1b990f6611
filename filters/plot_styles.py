"""How each filter is drawn: one colour and one dash, the same in every picture.

The hues are near those of Okabe and Ito, with a wine red: colour-blind people can distinguish them. Filters that
are often drawn together differ in hue, and no two share both hue and dash. Truth is a wide grey line below all,
measurements are pale.

Source: Okabe, Ito (2008), "Color universal design".
"""

from __future__ import annotations

from typing import Any

from thruster_env.core.plots import BLUE, GREEN, MUSTARD, PALE, PLUM, RUST, SKY, TRUE, WINE

SOLID, DASHED, DOTTED, BOTH, TWO_DOTS = "-", "--", ":", "-.", (0, (4, 1.5, 1, 1.5, 1, 1.5))
TRUTH: dict[str, Any] = {"color": TRUE, "linewidth": 3.0, "zorder": 1.8}  # wide, below the estimates
MEASURED: dict[str, Any] = {"color": PALE, "linewidth": 0.8}
OTHER = (GREEN, DOTTED)  # an estimator of one's own
STYLES: dict[str, tuple[str, Any]] = {
    "kf": (PLUM, SOLID),
    "kf-steady": (PLUM, DOTTED),
    "ekf": (BLUE, SOLID),
    "iekf": (MUSTARD, DASHED),
    "ukf": (SKY, BOTH),
    "ckf": (WINE, DOTTED),
    "mhe": (WINE, TWO_DOTS),
    "enkf": (RUST, SOLID),
    "etkf": (SKY, DASHED),
    "letkf": (SKY, TWO_DOTS),
    "ensrf": (WINE, BOTH),
    "denkf": (MUSTARD, BOTH),
    "ienkf": (PLUM, BOTH),
    "enkf-n": (GREEN, TWO_DOTS),
    "rhf": (RUST, TWO_DOTS),
    "pf": (GREEN, SOLID),
    "apf": (GREEN, DASHED),
    "rbpf": (MUSTARD, TWO_DOTS),
    "gsf": (PLUM, DASHED),
    "fading": (RUST, DOTTED),
    "h-infinity": (RUST, DASHED),
    "schmidt": (SKY, DOTTED),
    "imm": (BLUE, DASHED),
    "mmae": (BLUE, DOTTED),
    "fuzzy": (MUSTARD, SOLID),
    "sage-husa": (GREEN, BOTH),
    "vb": (WINE, SOLID),
    "ekf-robust": (RUST, BOTH),
    "open-loop": (MUSTARD, DOTTED),
    "low-pass": (SKY, SOLID),
    "inversion": (WINE, DASHED),
}


def plot_style(name: str) -> dict[str, Any]:
    """Colour and dash of a filter by name, as matplotlib takes them; all estimators of one's own share one."""
    colour, dashes = STYLES.get(name, OTHER)
    return {"color": colour, "linestyle": dashes}


def colour_of(name: str) -> str:
    """Colour of a filter by name."""
    return STYLES.get(name, OTHER)[0]
