"""The vehicle's scenarios that come with the package, by name.

    python -m tuning.auv.scenarios [NAME ...]

recomputes their scales and prints them.
"""

from __future__ import annotations

import math
import sys
from typing import Any

from thruster_env.auv.plant import make_plant
from tuning.auv.scenario import OfManoeuvre, Scenario, computed_scale
from tuning.problems.excitation import Levels
from tuning.problems.files import find_in

PLANE = math.radians(6.0)
SAILING = Levels(low=(2.0, -PLANE, -PLANE), high=(4.0, PLANE, PLANE), shortest=60, longest=160)
"""Thrusts of 2 to 4 N and planes within 6 deg, each held for 3 to 8 s."""

MINUTE: dict[str, Any] = {"excitation": SAILING, "steps": 1200, "first_scored_step": 100}
PAPERS: dict[str, Any] = {
    "sensors": "papers",
    "dt": 0.001,
    "process_noise_cov": (1e-6,) * 6 + (1e-12,) * 6,
    "initial_state": {"mean": [0.0] * 12, "cov": [[1e-6 * (i == j) for j in range(12)] for i in range(12)]},
    "excitation": OfManoeuvre("IV"),
    "steps": 5000,
    "first_scored_step": 2000,
}


def suite_with(name: str, channels: tuple[str, ...], effect: dict) -> dict[str, list[dict]]:
    """Sensors of a suite, with one more effect on some channels, as a scenario takes them."""
    effects = make_plant(sensors=name).sensors.items()
    return {
        channel: [*(before.as_mapping() for before in chain), *([effect] if channel in channels else [])]
        for channel, chain in effects
    }


DVL = ("u", "v", "w")
# Standard deviations by the Riccati equation for 200 input sequences, to one per cent; a test recomputes some.
MOTION_SCALE = (0.007873, 0.004605, 0.005282, 0.002202, 0.002147, 0.002115, 0.0005593, 0.0009131)
NAVIGATION_SCALE = (
    0.007821,
    0.004604,
    0.005248,
    0.002202,
    0.002146,
    0.002115,
    0.000559,
    0.0009114,
    0.00178,
    0.03492,
    0.03428,
    0.004844,
)
CURRENT = {
    direction: [{"name": "gauss-markov", "std": 0.2, "time_constant": 60.0}] for direction in ("north", "east")
}
SCENARIOS: dict[str, Scenario] = {
    scenario.name: scenario
    for scenario in (
        Scenario(
            name="auv:motion",
            about="velocities by DVL, rates by gyros, roll and pitch by AHRS, and a perfect model",
            scale=MOTION_SCALE,
            **MINUTE,
        ),
        Scenario(
            name="auv:papers",
            about="the published noise at 1 kHz on path IV: u, v, w and r to 1 mm/s, attitude not measured",
            scale=(0.0007861, 0.0007861, 0.0007861, 0.01703, 0.02112, 0.000786, 0.002553, 0.01423),
            **PAPERS,
        ),
        Scenario(
            name="auv:papers_20hz",
            about="the published sensors at 20 Hz: u, v, w and r to 1 mm/s, attitude not measured",
            sensors="papers",
            scale=(0.0009238, 0.0009228, 0.000923, 0.004209, 0.004884, 0.0009219, 0.0005931, 0.003052),
            **MINUTE,
        ),
        Scenario(
            name="auv:velocities",
            about="the papers' six states at 20 Hz, roll and pitch from an ideal sensor",
            states="velocities",
            sensors="papers",
            scale=(0.0009238, 0.0009228, 0.000923, 0.004031, 0.004871, 0.0009219),
            **MINUTE,
        ),
        Scenario(
            name="auv:navigation",
            about="DVL, gyros, AHRS, compass and depth: position by dead reckoning",
            states="navigation",
            sensors="default",
            scale=NAVIGATION_SCALE,
            **MINUTE,
        ),
        Scenario(
            name="auv:usbl",
            about="the same with an acoustic position fix (USBL) every 2 s",
            states="navigation",
            sensors="usbl",
            scale=(
                0.007821,
                0.004604,
                0.005248,
                0.002202,
                0.002146,
                0.002115,
                0.000559,
                0.0009114,
                0.00178,
                0.03413,
                0.03354,
                0.004844,
            ),
            **MINUTE,
        ),
        Scenario(
            name="auv:no_dvl",
            about="gyros, AHRS, compass and depth: the speed follows from the model",
            states="navigation",
            sensors="inertial",
            scale=(
                0.01024,
                0.004744,
                0.005473,
                0.002205,
                0.002154,
                0.002119,
                0.0005762,
                0.0009233,
                0.001787,
                0.06397,
                0.05409,
                0.005417,
            ),
            **MINUTE,
        ),
        Scenario(
            name="auv:dvl_dropout",
            about="the DVL loses bottom track half of the time, for 10 s on average",
            states="navigation",
            sensors=suite_with("default", DVL, {"name": "dropout", "probability": 0.5, "mean_length": 200}),
            scale=(
                0.009044,
                0.004674,
                0.005361,
                0.002204,
                0.00215,
                0.002117,
                0.0005676,
                0.0009172,
                0.001784,
                0.04411,
                0.0432,
                0.005127,
            ),
            **MINUTE,
        ),
        Scenario(
            name="auv:dvl_outliers",
            about="one DVL velocity in twenty has an error of about 0.2 m/s",
            sensors=suite_with("motion", DVL, {"name": "outliers", "std": 0.2, "probability": 0.05}),
            scale=MOTION_SCALE,
            **MINUTE,
        ),
        Scenario(
            name="auv:wrong_drag",
            about="the filter assumes half of the drag ahead and 20 % more drag across",
            parameter_factors={"Xuu": 0.5, "Yvv": 1.2, "Zww": 1.2, "Yuv": 1.2, "Zuw": 1.2},
            scale=MOTION_SCALE,
            **MINUTE,
        ),
        Scenario(
            name="auv:current",
            about="a slowly changing current of about 0.2 m/s north and east, unknown to the filter",
            states="navigation",
            sensors="default",
            current=CURRENT,
            scale=NAVIGATION_SCALE,
            **MINUTE,
        ),
        Scenario(
            name="auv:estimated_current",
            about="the same current, estimated as two further states of the filter's model",
            states="current",
            sensors="default",
            current=CURRENT,
            scale=(
                0.009718,
                0.009672,
                0.006036,
                0.00252,
                0.002223,
                0.00218,
                0.0006729,
                0.0009328,
                0.001792,
                0.0536,
                0.0539,
                0.005383,
                0.02306,
                0.02347,
            ),
            **MINUTE,
        ),
    )
}


def main(names: list[str]) -> None:
    """Print the scales of scenarios, all of them if none is named."""
    for name in names or SCENARIOS:
        print(name, tuple(float(f"{part:.4g}") for part in computed_scale(SCENARIOS[name])), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])


# The vehicle's scenarios by name or file, for `tuning.problems.find`.


__all__ = ["NAMES", "NOMINAL", "Scenario", "computed_scale", "find_scenario"]
NAMES = tuple(SCENARIOS)
NOMINAL = "auv:motion"


def find_scenario(name: str) -> Scenario:
    """A scenario by its name, or from a file that ends in .toml; ValueError for another."""
    return find_in(SCENARIOS, Scenario, "the vehicle's", name)
