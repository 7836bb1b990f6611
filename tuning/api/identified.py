"""`Identified`: parameters identified from recorded runs, as a value."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thruster_env.logs.log import Log
from thruster_env.model.state_space import StateSpaceModel
from tuning.api.showing import drawn, frame, html
from tuning.identification.profiles import profile_figure, profiles
from tuning.identification.result import Identification
from tuning.identification.validation import Validation, fall_sentence
from tuning.logs.identify import AnyStepFamily, remarks, write_found

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False, repr=False)
class Identified:
    """Maximum-likelihood values of free parameters, their uncertainty, and the model's errors on other runs.

    Attributes:
        found: the identification itself.
        validation: of the model at the "start" and "identified", on the held-out runs, or else on the same runs.
        family: the thruster or the model whose parameters are free.
        runs: runs used for identification.
        held_out: runs used only for validation.
    """

    found: Identification
    validation: Mapping[str, Validation]
    family: Any
    runs: tuple[Log, ...]
    held_out: tuple[Log, ...] = ()

    @property
    def values(self) -> dict[str, float]:
        """Values by name."""
        return self.found.values

    @property
    def standard_errors(self) -> dict[str, float]:
        """Standard errors of the values by name."""
        return self.found.standard_errors

    @property
    def determined(self) -> dict[str, bool]:
        """Whether the runs determine each value."""
        return self.found.determined

    @property
    def correlations(self) -> np.ndarray:
        """Of the estimates, (p, p), in the order of the values."""
        return self.found.correlations

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C ended it: the values are the best so far."""
        return self.found.interrupted

    @property
    def model(self) -> StateSpaceModel:
        """The model with the identified values, as the filter used it; on own stamps that of a step of dt."""
        if isinstance(self.family, AnyStepFamily):
            return self.family.plain.model(**self.values)
        return self.found.objective.model_at(self.found.at)

    def sentences(self) -> list[str]:
        """Which parameters the data determine, whether held-out runs say so, and the findings in the logs."""
        fell = fall_sentence(self.validation) if self.held_out else []
        return [*self.found.sentences(), *fell, *remarks(self.runs, self.held_out, self.found)]

    def to_frame(self) -> pandas.DataFrame:
        """A row per parameter: unit, start, value, standard error, whether the data determine it, and a test.

        "p" is the probability of so large a fall of the likelihood if "left out at" were the parameter's true
        value: zero if its range contains zero, otherwise the start.

        Raises:
            ValueError: if pandas is not installed.
        """
        names, tests = self.found.names, self.found.null_tests
        columns: dict[str, Sequence[Any]] = {
            "parameter": list(names),
            "unit": [one.unit for one in self.found.objective.coordinates.free],
            "start": [self.found.start[name] for name in names],
            "value": [self.values[name] for name in names],
            "standard error": [self.standard_errors[name] for name in names],
            "determined": [self.determined[name] for name in names],
            "left out at": [tests[name].at if name in tests else math.nan for name in names],
            "p": [tests[name].p if name in tests else math.nan for name in names],
        }
        return frame(columns, "parameter")

    def save(self, path: str | Path) -> Path:
        """Write the result to a file, a `preset` for other calls and commands; return the path.

        Of a thruster it is a preset file, which `gym.make(preset=...)` takes, too; of another model its numbers.

        Raises:
            ValueError: if the path does not end in .toml, or the file cannot be written.
        """
        write_found(path, self.found, self.family, [log.name for log in self.runs])
        return Path(path)

    def plot_profiles(self, names: Sequence[str] | None = None) -> Figure:
        """Profile likelihoods: the fall of the log-likelihood if one parameter is held at another value.

        Args:
            names: of the parameters; all if None. Each takes some searches.

        Raises:
            ValueError: for an unknown name.
        """
        return drawn(profile_figure(self.found, profiles(self.found, names)))

    def __repr__(self) -> str:
        values = ", ".join(f"{name} {value:.4g}" for name, value in list(self.values.items())[:6])
        more = ", ..." if len(self.values) > 6 else ""
        loose = sum(not known for known in self.determined.values())
        said = f"{loose} of {len(self.values)} not determined" if loose else "all determined"
        return f"Identified({values}{more}; {said}, {len(self.runs)} runs)"

    def _repr_html_(self) -> str:
        tests = self.found.null_tests
        units = {one.name: one.unit for one in self.found.objective.coordinates.free}
        rows = [
            [name, units[name], f"{self.found.start[name]:.5g}", f"{value:.5g}"]
            + [f"{self.standard_errors[name]:.2g}", "yes" if self.determined[name] else "no"]
            + ([f"{tests[name].at:.4g}", tests[name].said] if name in tests else ["-", "-"])
            for name, value in self.values.items()
        ]
        columns = ["", "unit", "start", "value", "standard error", "determined", "if left out, at", "p"]
        steps = sum(log.steps for log in self.runs)
        title = f"Identified on {len(self.runs)} runs, {steps} steps"
        return html(title, columns, rows, " ".join(self.sentences()))
