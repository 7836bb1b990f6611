"""`thruster simulate`: truth, inputs and measurements as a table in a file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np

from thruster_env.core.checks import at_least, positive, within
from thruster_env.core.files import check_target
from thruster_env.core.streams import episode_keys
from thruster_env.logs.write import check_suffix, header_of, write_columns
from thruster_env.thruster.equations import simulate
from thruster_env.thruster.parameters import CHANNELS
from thruster_env.thruster.plant import DEFAULT_DT, DEFAULT_MEASUREMENT_NOISE, DEFAULT_PROCESS_NOISE, make_plant
from tuning.api.markers import INPUT, OUTPUT, RUNS, WRITTEN, Option, PresetOption, Seed
from tuning.api.result import Printed
from tuning.cli.output import warn_beyond
from tuning.problems.excitation import held_levels

MOST_STEPS = 10_000_000  # which take a gigabyte
TRUTH = ("time_s", "voltage_V", "omega_m_rad_per_s", "U_a_m_per_s", "thrust_N")
HIDDEN = TRUTH[2:]  # from a recorder


def command(
    *,
    preset: Annotated[str, PresetOption] = "tunnel",
    steps: Annotated[int, Option(RUNS)] = 500,
    dt: Annotated[float, Option(INPUT)] = DEFAULT_DT,
    voltage: Annotated[float | None, Option(RUNS)] = None,
    amplitude: Annotated[float, Option(RUNS)] = 12.0,
    hold: Annotated[int, Option(RUNS)] = 25,
    process_noise: Annotated[tuple[float, float], Option(INPUT)] = DEFAULT_PROCESS_NOISE,
    measurement_noise: Annotated[float, Option(INPUT)] = DEFAULT_MEASUREMENT_NOISE,
    sensor: Annotated[Sequence[str], Option(INPUT, choices="sensors")] = (),
    seed: Seed = 0,
    measured_only: Annotated[bool, Option(OUTPUT)] = False,
    out: Annotated[Path, Option(OUTPUT, file=WRITTEN)],
) -> Printed:
    """Simulate a thruster and write time, voltage, true state, true thrust and measurements to a log.

    With --measured-only the log looks like one of a real thruster, without the truth.

    Row k holds the state at time k dt and the voltage that acts from then on; the last row has none. The
    numbers are those of BowThruster-v0 after reset(seed=SEED) under the same voltages. A simulation that does not
    stay finite is refused, and nothing is written.

    Args:
        preset: the thruster:
        steps: number of steps.
        dt: sample time [s]; covariances are per step of it and do not scale with it.
        voltage: constant voltage [V]; random levels by default.
        amplitude: random levels lie within plus and minus this [V] ...
        hold: ... and are held for so many steps.
        process_noise: variances per step of omega_m and U_a.
        measurement_noise: variance of the thrust [N^2].
        sensor: a measured channel, thrust by default:
        seed: seed of all randomness; the same seed gives the same results.
        measured_only: leave out true state and thrust: time, voltage and measurements, as a recorder has them.
        out: file to write: .csv with units in the header, .parquet or .npz.
    """
    check_suffix(out)
    check_target(out)
    steps = at_least("steps", steps, 1, MOST_STEPS)
    sensors = list(sensor) or ["thrust"]
    variances = {**{name: channel.variance for name, channel in CHANNELS.items()}, "thrust": measurement_noise}
    plant = make_plant(
        preset,
        dt,
        process_noise_cov=process_noise,
        measurement_noise_cov=[variances.get(channel, 0.0) for channel in sensors],
        sensors=sensors,
    )
    keys = episode_keys([seed])
    if voltage is not None:
        voltages = np.full((1, steps), within("voltage", voltage, plant.max_voltage))
    else:
        amplitude = positive("amplitude", amplitude, zero_allowed=True)
        voltages = held_levels(
            keys, min(amplitude, plant.max_voltage), at_least("hold", hold, 1, MOST_STEPS), steps
        )
    warn_beyond(preset, np.abs(voltages).max())
    run = simulate(plant, keys, voltages).checked()
    values = [
        plant.dt * np.arange(steps + 1),
        np.append(voltages[0], np.nan),
        *run.states[0].T,
        run.thrusts[0],
        *run.measurements[0].T,
    ]
    columns = [*TRUTH, *(header_of(CHANNELS[channel].quantity) for channel in plant.channels)]
    table = dict(zip(columns, values, strict=True))
    if measured_only:
        table = {header: table[header] for header in columns if header not in HIDDEN}
    write_columns(out, table)
    data = {"file": str(out), "rows": steps + 1, "columns": list(table), "seed": seed, "preset": preset}
    return Printed([f"{steps + 1} rows of {', '.join(table)} in {out}"], data)
