"""The scenarios that come with the package, by name.

    python -m tuning.thruster.scenarios [NAME ...]

recomputes their scales and prints them.
"""

from __future__ import annotations

import sys
from typing import Any

from thruster_env.core.checks import one_of
from tuning.problems.excitation import BinarySequence, Dwells, MultiSine
from tuning.problems.files import find_in
from tuning.thruster.scenario import ClosedLoop, Scenario, computed_scale

# Bounds from 1200 voltage sequences and 100 truths each, accurate to half a per cent; a test recomputes them.
NOMINAL_SCALE = (1.0753, 0.0464)
LINEAR_NOISE: dict[str, Any] = {"process_noise_cov": (0.5, 0.5), "measurement_noise_cov": 0.5, "steps": 100}

SCENARIOS: dict[str, Scenario] = {
    scenario.name: scenario
    for scenario in (
        Scenario(
            name="nominal",
            about="a perfect model and small noise: every good filter sits on the bound",
            scale=NOMINAL_SCALE,
        ),
        Scenario(
            name="published_noise",
            about="the noise of the published experiments on the nonlinear plant: filters differ",
            process_noise_cov=(0.5, 0.5),
            measurement_noise_cov=0.5,
            scale=(0.8069, 0.0720),
        ),
        Scenario(
            name="mismatch",
            about="the filter assumes 15 % more lift and 5 % less voltage gain K2 than the plant has",
            parameter_factors={"lift_coefficient": 1.15, "voltage_gain": 0.95},
            scale=NOMINAL_SCALE,
        ),
        Scenario(
            name="ambient",
            about="a slowly changing ambient flow of about 0.5 m/s, unknown to the filter",
            flow=[{"name": "gauss-markov", "std": 0.5, "time_constant": 10.0}],
            scale=NOMINAL_SCALE,
        ),
        Scenario(
            name="outliers",
            about="one measured thrust in twenty has an error of about 10 N",
            sensors={"thrust": [{"name": "outliers", "std": 10.0, "probability": 0.05}]},
            scale=NOMINAL_SCALE,
        ),
        Scenario(
            name="dropout",
            about="half of the measurements are missing, in gaps of 0.2 s on average",
            sensors={"thrust": [{"name": "dropout", "probability": 0.5, "mean_length": 20}]},
            scale=NOMINAL_SCALE,
        ),
        Scenario(
            name="bias",
            about="the sensor has a bias of about 1.5 N that drifts, while the voltage jumps between two levels",
            sensors={"thrust": [{"name": "bias", "std": 1.5, "drift": 0.03}]},
            excitation=BinarySequence(amplitude=8.0, hold=40),
            scale=(1.0424, 0.0384),
        ),
        Scenario(
            name="quantised",
            about="the sensor reads multiples of 4 N, under a sum of sines",
            sensors={"thrust": [{"name": "quantisation", "step": 4.0}]},
            excitation=MultiSine(),
            scale=(1.1042, 0.0512),
        ),
        Scenario(
            name="deadband",
            about="the amplifier has a dead band of 1 V, unknown to the filter, under a sum of sines",
            amplifier=[{"name": "dead-band", "width": 1.0}],
            excitation=MultiSine(),
            scale=(1.1042, 0.0512),
        ),
        Scenario(
            name="reversal",
            about="slow crossings of 0 V and dwells there, where the flow is not observable from thrust",
            excitation=Dwells(amplitude=4.0),
            scale=(1.1452, 0.0806),
        ),
        Scenario(
            name="speed_magnitude",
            about="a tachometer without a sign, at slow crossings of 0 V and dwells there",
            measurement_noise_cov=0.25,
            sensors=["speed-magnitude"],
            excitation=Dwells(amplitude=1.0),
            scale=(0.4493, 0.1365),
        ),
        Scenario(
            name="startup",
            about="the thruster may already turn, in either direction, when a run starts; every step counts",
            first_scored_step=0,
            initial_state={"mean": [0.0, 0.0], "cov": [[100.0**2, 0.0], [0.0, 2.0**2]]},
            scale=(1.0917, 0.0456),
        ),
        Scenario(
            name="published_tunnel",
            about="the linear tunnel thruster as published: the Kalman filter is optimal",
            system="tunnel",
            **LINEAR_NOISE,
            scale=(0.8066, 0.1457),
        ),
        Scenario(
            name="published_open_bladed",
            about="the linear open-bladed thruster as published, unstable, measured by its own C",
            system="open_bladed",
            **LINEAR_NOISE,
            scale=(4.8663, 2.1588),
        ),
        *(
            Scenario(
                name=name,
                about=f"strong process noise, and a thrust sensor with {about}: for policies on what it shows",
                process_noise_cov=(4.0, 0.01),
                measurement_noise_cov=variance,
                scale=scale,
            )
            for name, about, variance, scale in (
                ("low_noise", "0.5 N of noise", 0.25, (2.1173, 0.1068)),
                ("medium_noise", "2 N of noise", 4.0, (2.2619, 0.1846)),
                ("high_noise", "4 N of noise", 16.0, (2.2885, 0.2292)),
            )
        ),
        Scenario(
            name="mixed",
            about="outliers, dropout, gusts, a dead band and a wrong model, in a closed loop with PI",
            parameter_factors={"lift_coefficient": 1.1},
            sensors={
                "thrust": [
                    {"name": "outliers", "std": 10.0, "probability": 0.02},
                    {"name": "dropout", "probability": 0.1, "mean_length": 5},
                ]
            },
            flow=[{"name": "gusts", "std": 0.5, "rate": 0.5, "duration": 1.0}],
            amplifier=[{"name": "dead-band", "width": 0.5}],
            excitation=ClosedLoop(),
            scale=(1.0179, 0.0362),
        ),
    )
}


def main(names: list[str]) -> None:
    """Print the scales of scenarios beside the stored ones, all of them if none is named."""
    for name in names or SCENARIOS:
        scenario = SCENARIOS[one_of("scenario", name, tuple(SCENARIOS))]
        computed = ", ".join(f"{value:.4f}" for value in computed_scale(scenario))
        print(f"{name}: ({computed}), stored {scenario.scale}")


if __name__ == "__main__":
    main(sys.argv[1:])


# The thruster's scenarios by name or file, for `tuning.problems.find`.


__all__ = ["NAMES", "NOMINAL", "Scenario", "computed_scale", "find_scenario"]
NAMES = tuple(SCENARIOS)
NOMINAL = "nominal"


def find_scenario(name: str) -> Scenario:
    """A scenario by its name, or from a file that ends in .toml; ValueError for another."""
    return find_in(SCENARIOS, Scenario, "the thruster's", name)
