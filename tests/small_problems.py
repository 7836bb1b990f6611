"""Small problems that tests share: a scenario of the thruster, and a pair of equal models."""

import numpy as np

from tests.models import wide_model
from tuning.plants.thruster import find_scenario
from tuning.problems.excitation import Steps
from tuning.problems.model_problem import ModelProblem

UNITS = {"states": ["p", ("q", "q", "m"), "r"], "measurements": [("one", "a", "N"), "b"]}


def thruster(**changes):
    return find_scenario("nominal").replace(steps=60, **changes)


def pair(**changes):
    model = wide_model(**UNITS)
    given = {"inputs": Steps(amplitude=(1.0, 2.0), hold=5), "steps": 60, "scale": (0.5, np.inf, 1.0)}
    return ModelProblem(model, **{"assumed": model, **given, **changes})
