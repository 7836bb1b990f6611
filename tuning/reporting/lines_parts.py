"""What stands in a report to be copied: lines of Python, JSON and MATLAB that use the tuned filter."""

from __future__ import annotations

import json
from pathlib import Path

from tuning.problems.log_problem import LogProblem
from tuning.problems.problem import Problem
from tuning.problems.rooms import built_in
from tuning.reporting.matlab import matlab_function
from tuning.reporting.page import Code, Section, Words
from tuning.search.space import Choice

PYTHON = """from tuning.evaluation.tuned import read_tuned

choice, problem, _ = read_tuned({file!r}{given})
tuned = choice.filter(problem)  # with its model, Q and R
belief = tuned.init()
for measurement, command in zip(measurements, inputs):  # arrays of your own, a row a step
    belief, innovation = tuned.update(belief, measurement)
    print(belief.mean, belief.cov)
    belief = tuned.predict(belief, command)
"""
ON_ENV = """
from filters import EstimateState

env = EstimateState(problem.make_env(), tuned={file!r})  # observations are estimates
"""
ON_LOG = """
import tuning

found = tuning.estimate("run.csv", tuned={file!r})  # of a log; the same as `thruster estimate`
"""


def lines_section(choice: Choice, problem: Problem, file: str | None) -> Section:
    """Lines that use the tuned filter.

    Args:
        choice: the tuned filter.
        problem: what it was tuned on.
        file: the tuned file; None where the report is of a study, which has none yet.
    """
    name = Path(file).name if file else "tuned.json"
    model = problem.model(**choice.model)
    given = "" if problem.name in built_in() or problem.as_mapping() is not None else ", [problem]  # yours"
    python = PYTHON.format(file=name, given=given).replace("  # yours)", ")  # the problem is code of yours")
    python += ON_LOG.format(file=name) if isinstance(problem, LogProblem) else ON_ENV.format(file=name)
    noise = {"process_noise_cov": model.process_noise_cov, "measurement_noise_cov": model.measurement_noise_cov}
    entry = {"name": choice.name, "numbers": dict(choice.numbers)}
    entry["model"] = {key: value.tolist() for key, value in noise.items()} | dict(choice.model)
    said = [] if file else [Words(["`thruster tune` writes the tuned file of a study, which these lines read."])]
    matlab = matlab_function(choice, model, problem.name, problem.dt)
    return Section(
        "Lines to copy",
        [
            *said,
            Code("Python", python),
            Code("JSON: the filter, as the tuned file has it", json.dumps(entry, indent=2, default=str)),
            Code("MATLAB or GNU Octave: a function that needs no toolbox", matlab, folded=True),
        ],
    )
