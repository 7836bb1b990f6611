"""Lines of a report to copy: Python, JSON and MATLAB that use the tuned filter."""

from __future__ import annotations

import json
from pathlib import Path

from tuning.problems.augmented import within
from tuning.problems.log_problem import LogProblem
from tuning.problems.plant_packages import built_in
from tuning.problems.problem import Problem
from tuning.reporting.matlab import matlab_function
from tuning.reporting.page import Code, Section, Words
from tuning.search.space import Choice

ON_ENV = """from filters import EstimateState
{problem}
env = EstimateState(problem.make_env(), tuned={file!r})  # observations are estimates
tuned = env.filter  # with its model, Q and R
"""
ON_LOG = """import tuning

found = tuning.estimate("run.csv", tuned={file!r})  # of a log; the same as `thruster estimate`
tuned = found.filter  # with its model, Q and R
"""
BY_HAND = """
belief = tuned.init()
for measurement, command in zip(measurements, inputs):  # arrays of your own, a row per step
    belief, innovation = tuned.update(belief, measurement)
    print(belief.mean, belief.cov)
    belief = tuned.predict(belief, command)
"""
UNSAVED = "TUNED.json"  # a name to be replaced


def lines_section(choice: Choice, problem: Problem, file: str | None) -> Section:
    """Lines that use the tuned filter.

    Args:
        choice: the tuned filter.
        problem: what it was tuned on.
        file: the tuned file; None where the report is of a study, which has none yet.
    """
    name = Path(file).name if file else UNSAVED
    model = problem.model(**choice.model)
    lines = ON_LOG if isinstance(within(problem), LogProblem) else ON_ENV
    python = lines.format(file=name, problem=_found_by(problem)) + BY_HAND
    noise = {"process_noise_cov": model.process_noise_cov, "measurement_noise_cov": model.measurement_noise_cov}
    entry = {"name": choice.name, "numbers": dict(choice.numbers)}
    entry["model"] = {key: value.tolist() for key, value in noise.items()} | dict(choice.model)
    command = f"`study.save({UNSAVED!r})` or `thruster tune --out {UNSAVED}`"
    said = [] if file else [Words([f"{command} writes the tuned file that these lines read."])]
    matlab = matlab_function(choice, model, problem.name, problem.dt)
    return Section(
        "Lines to copy",
        [
            *said,
            Code("Python", python),
            Code("JSON: the filter, as in the tuned file", json.dumps(entry, indent=2, default=str)),
            Code("MATLAB or GNU Octave: a function that needs no toolbox", matlab, folded=True),
        ],
    )


def _found_by(problem: Problem) -> str:
    """Lines that load a problem: by its name or, if it is the user's code, from its module."""
    if problem.name in built_in() or problem.name.endswith(".toml"):
        return f"from tuning.problems.find import find_problem\n\nproblem = find_problem({problem.name!r})"
    module, colon, name = problem.name.partition(":")
    if colon and module.replace(".", "").isidentifier() and name.isidentifier():
        found = f"from {module} import {name}" + ("" if name == "problem" else " as problem")
        return f"{found}  # if it is a function: problem = problem()\n"
    return "from your_module import problem  # the object that it was tuned on\n"
