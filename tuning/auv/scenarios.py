"""The vehicle's scenarios that come with the package, by name.

    python -m tuning.auv.scenarios [NAME ...]

computes their scales anew and prints them.
"""

from __future__ import annotations

import math
import sys

from auv_env.plant import make_plant
from tuning.auv.excitation import OfManoeuvre
from tuning.auv.scale import computed_scale
from tuning.auv.scenario import Scenario
from tuning.problems.excitation import Levels

PLANE = math.radians(6.0)
SAILING = Levels(low=(2.0, -PLANE, -PLANE), high=(4.0, PLANE, PLANE), shortest=60, longest=160)
"""Thrusts of 2 to 4 N and planes within 6 deg, each held for 3 to 8 s."""

MINUTE = {"excitation": SAILING, "steps": 1200, "first_scored_step": 100}
PAPERS = {
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
        channel: [*(one.as_mapping() for one in chain), *([effect] if channel in channels else [])]
        for channel, chain in effects
    }


DVL = ("u", "v", "w")
SCENARIOS: dict[str, Scenario] = {
    scenario.name: scenario
    for scenario in (
        Scenario(
            name="auv:motion",
            about="velocities by DVL, rates by gyros, roll and pitch by AHRS, and a perfect model",
            scale=(1.0,) * 8,
            **MINUTE,
        ),
        Scenario(
            name="auv:papers",
            about="the published noise at 1 kHz on path IV: u, v, w and r to 1 mm/s, attitude not measured",
            scale=(1.0,) * 8,
            **PAPERS,
        ),
        Scenario(
            name="auv:papers_20hz",
            about="the published sensors at 20 Hz: u, v, w and r to 1 mm/s, attitude not measured",
            sensors="papers",
            scale=(1.0,) * 8,
            **MINUTE,
        ),
        Scenario(
            name="auv:velocities",
            about="the papers' six states at 20 Hz, roll and pitch told by an ideal sensor",
            states="velocities",
            sensors="papers",
            scale=(1.0,) * 6,
            **MINUTE,
        ),
        Scenario(
            name="auv:navigation",
            about="DVL, gyros, AHRS, compass and depth: position by dead reckoning",
            states="navigation",
            sensors="default",
            scale=(1.0,) * 12,
            **MINUTE,
        ),
        Scenario(
            name="auv:usbl",
            about="the same with a position by sound every 2 s",
            states="navigation",
            sensors="usbl",
            scale=(1.0,) * 12,
            **MINUTE,
        ),
        Scenario(
            name="auv:no_dvl",
            about="gyros, AHRS, compass and depth: the model tells the speed",
            states="navigation",
            sensors="inertial",
            scale=(1.0,) * 12,
            **MINUTE,
        ),
        Scenario(
            name="auv:dvl_dropout",
            about="the DVL loses the ground half of the time, for 10 s in a row",
            states="navigation",
            sensors=suite_with("default", DVL, {"name": "dropout", "probability": 0.5, "mean_length": 200}),
            scale=(1.0,) * 12,
            **MINUTE,
        ),
        Scenario(
            name="auv:dvl_outliers",
            about="one velocity in twenty of the DVL is off by some 0.2 m/s",
            sensors=suite_with("motion", DVL, {"name": "outliers", "std": 0.2, "probability": 0.05}),
            scale=(1.0,) * 8,
            **MINUTE,
        ),
        Scenario(
            name="auv:wrong_drag",
            about="the filter believes in half of the drag ahead and 20 % more across",
            parameter_factors={"Xuu": 0.5, "Yvv": 1.2, "Zww": 1.2, "Yuv": 1.2, "Zuw": 1.2},
            scale=(1.0,) * 8,
            **MINUTE,
        ),
        Scenario(
            name="auv:current",
            about="a current of about 0.2 m/s each way, slow to change, that the filter does not know",
            states="navigation",
            sensors="default",
            current={
                direction: [{"name": "gauss-markov", "std": 0.2, "time_constant": 60.0}]
                for direction in ("north", "east")
            },
            scale=(1.0,) * 12,
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
