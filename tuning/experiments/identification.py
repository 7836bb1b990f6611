"""Are the standard errors of `thruster identify` right? Logs of a known thruster, identified many times.

    thruster reproduce identification

A thruster with a dead band, asymmetric thrust and ambient flow is recorded by a thrust sensor with a bias and a
tachometer with a lag. Each repetition draws other inputs, process noise and measurement noise, starts from a
preset of another thruster, and checks whether each value is within two standard errors of the truth.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np

from thruster_env.core.checks import at_least
from thruster_env.core.streams import episode_keys
from thruster_env.core.text_tables import markdown_table
from thruster_env.logs.log import Log
from thruster_env.model.simulate import simulate
from thruster_env.thruster.model import Recorder, logged_model
from thruster_env.thruster.plant import make_plant
from tuning.api.markers import RUNS, Option
from tuning.api.result import Printed
from tuning.cli.output import progress_of
from tuning.likelihood.identify import identify
from tuning.likelihood.result import Identification
from tuning.plants.thruster_logs import ThrusterFamily
from tuning.problems.excitation import held_levels

PRESET, SENSORS = "tunnel_physical", ("thrust", "speed")
TRUTH = {
    "motor_damping": 60.0,
    "voltage_gain": 1300.0,
    "load_gain": 15000.0,
    "lift_coefficient": 1.5,
    "thrust_asymmetry": 0.08,
    "ambient_velocity": 0.2,
    "dead_band_low": -0.7,
    "dead_band_high": 0.9,
    "bias_thrust": 0.5,
    "lag_speed": 0.05,
    "Q11": 1.0,
    "Q22": 4e-4,
    "R11": 0.25,
    "R22": 4.0,
}
OWN = ("motor_damping", "voltage_gain", "load_gain", "lift_coefficient", "thrust_asymmetry")
AMPLITUDE, HOLD = 12.0, 25  # of the inputs [V], in steps
FINE = 8  # Runge-Kutta steps of the truth: more than in the identified model
WITHIN = 2.0  # standard errors


class Coverage(NamedTuple):
    """The estimates of one parameter compared with the truth, over all repetitions."""

    name: str
    truth: float
    mean: float
    scatter: float  # standard deviation of the estimates
    standard_error: float  # mean of those stated
    within: int  # repetitions within two of their standard errors


def record(seed: int, runs: int = 6, steps: int = 500) -> list[Log]:
    """Logs of the known thruster."""
    plant = make_plant(PRESET)
    parameters: dict[str, Any] = {name: TRUTH[name] for name in OWN}
    model = logged_model(
        preset=plant.parameters._replace(**parameters),
        sensors=SENSORS,
        substeps=FINE,
        ambient_velocity=TRUTH["ambient_velocity"],
        dead_band=(TRUTH["dead_band_low"], TRUTH["dead_band_high"]),
        bias={"thrust": TRUTH["bias_thrust"]},
        lag={"speed": TRUTH["lag_speed"]},
        process_noise_cov=[TRUTH["Q11"], TRUTH["Q22"]],
        measurement_noise_cov=[TRUTH["R11"], TRUTH["R22"]],
    )
    keys = episode_keys(range(1000 * seed, 1000 * seed + runs))
    inputs = held_levels(keys, AMPLITUDE, HOLD, steps)[..., None]
    drawn = simulate(model, keys, inputs).measurements
    return [
        Log(f"run {k}", plant.dt, inputs[k], drawn[k], model.input_quantities, model.measurements)
        for k in range(runs)
    ]


def repetition(seed: int, *, starts: int = 2, runs: int = 6, steps: int = 500) -> Identification:
    """One identification from the preset."""
    plant = make_plant(PRESET, sensors=SENSORS, max_voltage=AMPLITUDE)
    family = ThrusterFamily(record(seed, runs, steps), plant, Recorder(), tuple(TRUTH))
    return identify(family.data, family.model, family.free, starts=starts, seed=seed, against=False)


def coverage(results: Sequence[Identification]) -> list[Coverage]:
    """The estimates of each parameter compared with the truth."""
    rows = []
    for name, truth in TRUTH.items():
        values = np.array([result.values[name] for result in results])
        errors = np.array([result.standard_errors[name] for result in results])
        within = int((np.abs(values - truth) <= WITHIN * errors).sum())
        scatter = float(values.std(ddof=1)) if len(values) > 1 else float("nan")
        rows.append(Coverage(name, truth, float(values.mean()), scatter, float(errors.mean()), within))
    return rows


def report(rows: Sequence[Coverage], repetitions: int) -> str:
    """A table of Markdown, and how many of all intervals hold the truth."""
    columns = ["parameter", "truth", "mean", "scatter", "stated error", f"within 2, of {repetitions}"]
    cells = [[row.name, *(f"{value:.4g}" for value in row[1:5]), str(row.within)] for row in rows]
    total = sum(row.within for row in rows)
    part = total / (repetitions * len(rows))
    return (
        markdown_table(columns, cells) + f"\n\n{total} of {repetitions * len(rows)} ({part:.1%}) hold the truth."
    )


def study(repetitions: int, tell: Callable[[int], None] = lambda done: None, **options) -> list[Identification]:
    """All repetitions."""
    results = []
    for seed in range(at_least("repetitions", repetitions, 2)):
        results.append(repetition(seed, **options))
        tell(seed + 1)
    return results


def reproduce(repetitions: Annotated[int, Option(RUNS)] = 20) -> Printed:
    """Record and identify a known thruster many times, and count how often stated errors hold the truth.

    Args:
        repetitions: how many, at least 2.
    """
    with progress_of("identifying") as progress:
        results = study(repetitions, lambda done: progress("", done, repetitions))
    rows = coverage(results)
    return Printed([report(rows, repetitions)], {"coverage": [row._asdict() for row in rows]})


TABLES = {"coverage": lambda: report(coverage(study(20)), 20)}
