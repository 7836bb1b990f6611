"""Two recordings of BROAD, for `tests.tuning.test_attitude`: python -m tests.data.broad FOLDER

D. Laidig, M. Caruso, A. Cereatti, T. Seel (2021), "BROAD - A Benchmark for Robust Inertial Orientation
Estimation", Data 6(7):72, doi 10.3390/data6070072; github.com/dlaidig/broad, licence CC BY 4.0. Changes: the first
70 s of trials 02 and 03 (slow rotation) without most of the rest before the motion, means of three samples, whole
numbers of 5e-4 rad/s, 4e-3 m/s^2, 5e-3 uT and of 1/32767 for quaternions (w, x, y, z) of the sensor in east,
north, up; -32768 where the sensor rests or the reference is missing. FOLDER has the cuts as npz.
"""

import sys
from pathlib import Path

import numpy as np

RATE, MEANS = 285.714 / 3, 3  # [Hz]
UNITS = {"gyr": 5e-4, "acc": 4e-3, "mag": 5e-3, "quat": 1.0 / 32767}


def cut(content):
    """The columns of a trial, each (K, 3) or (K, 4), as whole numbers."""
    moves = content["movement"].astype(bool)
    first = max(int(np.flatnonzero(moves)[0]) - 428, 0)
    parts = {name: np.asarray(content[name], dtype=np.float64)[first:] for name in UNITS}
    parts["quat"][~moves[first:]] = np.nan
    rows = len(parts["gyr"]) // MEANS * MEANS
    centres = np.arange(MEANS // 2, rows, MEANS)
    turned = np.cumsum(parts["gyr"], axis=0)[centres]  # the rate from one centre to the next
    columns = {name: parts[name][:rows].reshape(-1, MEANS, 3).mean(axis=1) for name in ("acc", "mag")}
    columns["gyr"] = np.diff(turned, axis=0, prepend=turned[:1] - parts["gyr"][:1] * MEANS) / MEANS
    columns["quat"] = np.nan_to_num(parts["quat"][centres], nan=-32768 / 32767)
    return {name: np.round(column / UNITS[name]).astype(np.int16) for name, column in columns.items()}


def broad(trial):
    """Columns of a trial, "02" or "03", in rad/s, m/s^2 and uT; quaternions are NaN where they do not count."""
    with np.load(Path(__file__).with_suffix(".npz")) as file:
        columns = {name: file[f"{name}_{trial}"] * unit for name, unit in UNITS.items()}
    return {**columns, "quat": np.where(columns["quat"] < -1.0, np.nan, columns["quat"])}


if __name__ == "__main__":
    stored = {}
    for path in sorted(Path(sys.argv[1]).glob("broad_0[23]_*.npz")):
        trial = path.name.split("_")[1]
        stored |= {f"{name}_{trial}": column for name, column in cut(np.load(path)).items()}
    np.savez_compressed(Path(__file__).with_suffix(".npz"), **stored)
