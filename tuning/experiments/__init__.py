"""Published experiments, standard problems and long studies, by name: `thruster reproduce NAME`.

A module has `reproduce`, of which `tuning.cli.verbs` makes the command, and `TABLES` and `FIGURES` of a page of
the docs, by name, which `python -m docs.scripts PAGE` computes. Standard problems also have a `problem` for
`thruster tune --problem tuning.experiments.NAME:problem`. The package is not in the wheel.
"""

from __future__ import annotations

from typing import NamedTuple

SOLVED = "benchmark:reproduce"


class Experiment(NamedTuple):
    """What an experiment is, and where it is.

    Attributes:
        about: one line.
        module: of this package, with TABLES and FIGURES of the page.
        page: of the docs; empty if none has them.
        command: "module:function" if it is not `reproduce` of the module. A module without it prints its TABLES.
    """

    about: str
    module: str
    page: str = ""
    command: str = ""


EXPERIMENTS = {
    "nurhadi2022": Experiment("KF and EnKF of two linear bow thrusters, Nurhadi et al. 2022", "thruster_papers"),
    "kiki2020": Experiment("KF and EnKF of two linear bow thrusters, Kiki 2020", "thruster_papers"),
    "thruster-papers": Experiment("Both papers on the bow thruster on the same runs", "thruster_papers"),
    "ngatini2017": Experiment("Ensemble and fuzzy filters of a vehicle, Ngatini 2017", "vehicle_tables", "auv"),
    "ngatini2019": Experiment("Ensemble filters of a vehicle, Ngatini 2019", "vehicle_tables", "auv"),
    "lorenz63": Experiment("Lorenz-63, beside published scores", "lorenz63", "benchmarks", SOLVED),
    "lorenz63-sparse": Experiment("Lorenz-63, measured seldom", "lorenz63", "benchmarks", SOLVED),
    "lorenz96": Experiment("Lorenz-96, beside published scores", "lorenz96", "benchmarks", SOLVED),
    "range-bearing": Experiment("Range and bearing, beside Stone Soup", "range_bearing", "benchmarks", SOLVED),
    "lidar": Experiment("Learned Q and R of a lidar's tracks, beside OKF", "lidar", "methods"),
    "identification": Experiment("Are the standard errors of identification right?", "identification", "identify"),
    "faults": Experiment("How soon a monitor notices faults", "faults", "monitoring"),
    "broad": Experiment("Attitude filters beside motion capture, Laidig et al. 2021", "broad", "attitude"),
    "recordings": Experiment("A recorded thruster beside its load cell", "recordings", "real_data"),
    "users": Experiment("Filters tuned on users' problems, beside users' baselines", "users", "tuning"),
    "methods": Experiment("Every method of tuning on the same data and budget", "methods_tables", "methods"),
    "policies": Experiment(
        "Policies on raw, filtered and true state, beside MPC, PI and LQG", "policies_report", "policies"
    ),
}
