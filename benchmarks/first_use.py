"""What the first use of each filter costs on each model of the vehicle, in processor time and memory.

`python -m benchmarks.first_use` prints a table in Markdown. Every filter is measured in a
process of its own with an empty cache. A model's name and names of
filters as arguments are measured in this process.
"""

from __future__ import annotations

import json
import sys

from benchmarks.compilation import measured, timed_use
from filters import make_filter
from filters.filter import Filter
from filters.registry import FILTERS, filter_type
from thruster_env.auv.model import MODELS, auv_model

FEW_RULES = {"fuzzy": {"premises": [0, 5]}}  # u and r; twelve states would make 4096
WITH_POSITION = ("navigation", "current")  # of which there is no steady state unless a position is measured


def filter_of(name: str, states: str) -> Filter:
    """A filter on a model of the vehicle."""
    arguments = {"ensemble_size": 10} if filter_type(name).has_ensemble else {}
    if MODELS[states].count > 8:
        arguments |= FEW_RULES.get(name, {})
    sensors = "usbl" if name == "kf-steady" and states in WITH_POSITION else None
    return make_filter(name, auv_model(states=states, sensors=sensors), **arguments)


def main() -> None:
    """Print the table, or measurements."""
    if len(sys.argv) > 1:
        states, *names = sys.argv[1:]
        for name in names:
            print(json.dumps(timed_use(filter_of(name, states))), flush=True)
        return
    print("| filter | " + " | ".join(f"{name} ({MODELS[name].count})" for name in MODELS) + " |")
    print("|---|" + "--:|" * len(MODELS))
    for name in FILTERS:
        cells = (
            f"{seconds:.1f} s, {megabytes:.0f} MB"
            for seconds, megabytes in (measured(__spec__.name, states, name) for states in MODELS)
        )
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
