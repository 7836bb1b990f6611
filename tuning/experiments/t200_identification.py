"""The preset `t200`, identified from the bollard table of a Blue Robotics T200 thruster.

    python -m tuning.experiments.t200_identification TABLE.csv

The table's licence is unstated, so it is not in this repository; the numbers derived from it are. Its columns are
pwm_us, rpm, current_A, voltage_V and force_kgf, its rows 201 pulse widths from 1100 to 1900 us at each of six
supply voltages from 10 to 20 V. Four voltages are fitted, the other two are predicted.

Only 4 of the 15 pairs of voltages that could be held out meet both goals in both directions: 14 and 18 V, which
the preset has, 14 and 16, 16 and 18, and 16 and 20 V. Of the others, 10 miss the goal for thrust from measured
speed, with medians up to 3.7 %. Two miss the one for thrust from pulse width and supply, as they extrapolate: 10
and 12 V, and 18 and 20 V, with medians up to 9.6 %.

Source: Blue Robotics, "T200 Public Performance Data 10-20V September 2019".
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from thruster_env.core.files import write_whole
from thruster_env.thruster.parameters import T200
from tuning.experiments.bollard_fit import (
    FITTED,
    Identified,
    PulseWidthMap,
    bollard_forces,
    identify,
    predict,
    relative_errors,
)
from tuning.experiments.bollard_table import BollardTable, read_table

HELD_OUT = (14.0, 18.0)  # between others, so that nothing is extrapolated [V]
GOALS = {"thrust from measured speed": 0.03, "thrust from pulse width and supply": 0.05}  # of medians
AGREEMENT = 1e-3  # relative; the preset has four digits

T200_PULSE_WIDTHS = PulseWidthMap(droop=0.01687, astern_gain=1.0085)
"""The speed controller of the table, identified together with the preset: `source_voltage` gives V_s.

The gain compensates the model's torque, which is larger astern than the thruster's: see `T200`. It is nearly one,
but with a gain of exactly one a goal is narrowly missed: the fit then compensates the torque with more thrust
astern, whose median error at measured speed is 3.03 % at the held-out voltages. With the gain it is 2.93 %.
"""

PRESET = Identified(T200, T200_PULSE_WIDTHS)


def identified_numbers(found: Identified) -> dict[str, float]:
    """The seven numbers of a fit by name."""
    return {name: getattr(found.thruster, name) for name in FITTED} | found.pulse_widths._asdict()


def coefficients(found: Identified, table: BollardTable) -> dict[str, dict[str, float]]:
    """Bollard coefficients K_T = T/(rho n^2 D^4) and K_Q = Q/(rho n^2 D^5), n in turns a second, by direction.

    Beside the model's they are the medians of the table, where Q is the motor's current times K1/K2.
    """
    p = found.thruster
    unit = p.density * p.diameter**4 / (2 * math.pi) ** 2  # thrust over K_T omega_m^2
    guess = predict(found, table)
    astern, ahead = bollard_forces(p)
    by_direction = {}
    for name, rows, (thrust, torque) in (("ahead", table.ahead, ahead), ("astern", ~table.ahead, astern)):
        k_t, k_q = float(thrust / unit), float(torque / unit / p.diameter)
        by_direction[name] = {
            "K_T": k_t,
            "K_T measured": k_t * float(np.median((table.thrust / guess.thrust_from_speed)[rows])),
            "K_Q": k_q,
            "K_Q from current": k_q * float(np.median((table.current / guess.current_from_speed)[rows])),
        }
    return by_direction


def study(path, held_out: Sequence[float] = HELD_OUT) -> dict:
    """Identify the T200 from a table; return numbers, errors and the comparison with the preset as plain data.

    Raises ValueError if the file is no such table or the held-out voltages are not in it.
    """
    table = read_table(path)
    found = identify(table, held_out, T200)
    numbers, preset = identified_numbers(found), identified_numbers(PRESET)
    errors = relative_errors(found, table, held_out)
    return {
        "fitted_voltages": sorted(set(np.unique(table.supply).tolist()) - set(held_out)),
        "held_out_voltages": sorted(set(held_out)),
        "numbers": numbers,
        "preset": preset,
        "matches_preset": bool(
            np.allclose(list(numbers.values()), list(preset.values()), rtol=AGREEMENT, atol=0.0)
        ),
        "coefficients": coefficients(found, table),
        "errors": errors,
        "preset_errors": relative_errors(PRESET, table, held_out),
        "goals": GOALS,
        "goals_met": {
            quantity: all(e["median"] < goal for group in errors[quantity].values() for e in group.values())
            for quantity, goal in GOALS.items()
        },
    }


def report(result: dict) -> str:
    """The result of `study` as text."""
    lines = [
        f"fitted: {_volts(result['fitted_voltages'])}; held out: {_volts(result['held_out_voltages'])}",
        "",
        f"{'':20}{'identified':>12}{'preset':>12}",
    ]
    for name, value in result["numbers"].items():
        lines.append(f"{name:20}{value:12.5g}{result['preset'][name]:12.5g}")
    agree = "agree with" if result["matches_preset"] else "differ from"
    lines += [f"The numbers {agree} the preset's, to within {AGREEMENT:.1%} each.", ""]
    for direction, values in result["coefficients"].items():
        cells = ", ".join(f"{name} {value:.4f}" for name, value in values.items())
        lines.append(f"Bollard {direction}: {cells}")
    lines += [
        "",
        "Relative errors above a quarter of full speed: median (90th percentile)",
        f"{'':36}{'fitted':^32}{'held out':^32}",
        f"{'':36}" + f"{'ahead':>16}{'astern':>16}" * 2,
    ]
    for quantity, groups in result["errors"].items():
        errors = [f"{e['median']:.1%} ({e['90 %']:.1%})" for group in groups.values() for e in group.values()]
        lines.append(f"{quantity:36}" + "".join(f"{cell:>16}" for cell in errors))
    for quantity, goal in result["goals"].items():
        lines.append(f"Median {quantity} below {goal:.0%}: {'yes' if result['goals_met'][quantity] else 'no'}")
    return "\n".join(lines)


def _volts(voltages: Sequence[float]) -> str:
    return ", ".join(f"{v:g}" for v in voltages) + " V"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return 0, or 2 after a user's mistake, which is one line."""
    parser = argparse.ArgumentParser(
        prog="python -m tuning.experiments.t200_identification",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description=(
            "Identify the preset t200 from the T200's bollard table.\n\n"
            "Fits lift, drag, thrust asymmetry and motor of the thruster, and two numbers of its\n"
            "speed controller, on the voltages that are not held out; states the errors on all; says\n"
            "whether the preset in the package has these numbers. All else in the preset is\n"
            "inferred, which a static table cannot check: see its docstring."
        ),
        epilog="Example: python -m tuning.experiments.t200_identification t200.csv --held-out 12 16 --json -",
    )
    parser.add_argument(
        "table", type=Path, help="CSV with columns pwm_us, rpm, current_A, voltage_V, force_kgf, of 10 to 20 V."
    )
    parser.add_argument(
        "--held-out", type=float, nargs="+", default=HELD_OUT, metavar="V", help="Voltages not fitted [14 18]."
    )
    parser.add_argument("--json", metavar="PATH", help="Write the result as JSON; - for standard output, alone.")
    options = parser.parse_args(arguments)
    try:
        result = study(options.table, options.held_out)
        text = json.dumps(result, indent=2) + "\n"
        if options.json and options.json != "-":
            write_whole(options.json, text)
    except (ValueError, OSError) as error:
        print(f"t200_identification: {error}", file=sys.stderr)
        return 2
    print(text if options.json == "-" else report(result), end="" if options.json == "-" else "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
