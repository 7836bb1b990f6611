"""Published experiments and standard problems, with the published numbers beside ours.

Papers on the thruster are in `thruster_papers`, those on the underwater vehicle in `vehicle`. Standard problems
are modules with a `BENCHMARK`, and a `problem` for `thruster tune --problem tuning.experiments.NAME:problem`.
`TABLES` and `FIGURES` of a module are those of the docs, by name: `python -m docs.scripts` makes them.
"""

from tuning.experiments.thruster_papers import KIKI2020 as KIKI_2020
from tuning.experiments.thruster_papers import NURHADI2022 as NURHADI_2022

STUDIES = {table.name: table for table in (NURHADI_2022, KIKI_2020)}
BENCHMARKS = {
    "lorenz63": "tuning.experiments.lorenz63:BENCHMARK",
    "lorenz63-sparse": "tuning.experiments.lorenz63:SPARSE",
    "lorenz96": "tuning.experiments.lorenz96:BENCHMARK",
    "range-bearing": "tuning.experiments.range_bearing:BENCHMARK",
}  # objects of modules by name
VEHICLE_STUDIES = ("ngatini2017", "ngatini2019")  # see `tuning.experiments.vehicle`

__all__ = ["BENCHMARKS", "KIKI_2020", "NURHADI_2022", "STUDIES", "VEHICLE_STUDIES"]
