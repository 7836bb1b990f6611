"""The input of an identification: training runs, held-out runs, and the model family."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from thruster_env.core.checks import short_repr
from thruster_env.core.modules import object_named
from thruster_env.logs.findings import has_outliers, remarks_on
from thruster_env.logs.log import Log, cut_at_gaps
from thruster_env.logs.steps import in_any_steps
from thruster_env.model.continuous import in_discrete_time
from thruster_env.model.state_space import StateSpaceModel
from tuning.identification.family import ModelFamily
from tuning.identification.result import Identification, write_values
from tuning.logs.problem import runs_by_name, without_rescaled
from tuning.logs.read import read_named
from tuning.problems.log_parts import check_apart, check_times
from tuning.problems.parameter import Parameter
from tuning.problems.plant_packages import logs_package

EVERY_THIRD = 3
SHORTEST_PIECE = 10  # rows of a run between gaps: fewer tell little beside how they begin
OFFSET_SHARE = 4  # a clock offset may be at most the length of a log divided by this


def split_runs(
    logs: Any, held_out: Any = None, *, use_all: bool = False, hold_gaps: bool = False, **options: Any
) -> tuple[list[Log], list[Log]]:
    """The training logs, and the held-out ones for validation: by default every third of three or more.

    Args:
        logs: recorded runs, as `tuning.logs.read.read_named` takes them.
        held_out: the held-out runs, or their paths or names.
        use_all: whether no run is held out.
        hold_gaps: whether runs are not cut at gaps, and their inputs are held there; on their own stamps they are.
        **options: options of `read_named`.

    Raises:
        ValueError: states the rule and the value.
    """
    runs, validating = runs_by_name(logs, held_out)
    if use_all and validating:
        raise ValueError(
            f"give either held_out (--held-out) or use_all (--use-all), but got both, held out {validating[0]}"
        )
    names = list(runs)
    if not validating and not use_all and len(names) >= EVERY_THIRD:
        validating = names[EVERY_THIRD - 1 :: EVERY_THIRD]
    learning = [name for name in names if name not in validating]
    if not learning:
        raise ValueError("at least one log must be left to learn from, but all are held out")
    read = [read_named(runs[name], **options, name=name)[0] for name in (*learning, *validating)]
    check_times(read)
    read = without_rescaled(read, validating)
    parts = [log for log in read if log.name not in validating], [log for log in read if log.name in validating]
    check_apart(*parts)
    if hold_gaps or any(log.stamps is not None for log in read):
        return parts
    pieces = [[piece for log in logs_ for piece in cut_at_gaps(log, SHORTEST_PIECE)] for logs_ in parts]
    if not pieces[0]:
        raise ValueError(
            f"logs must have {SHORTEST_PIECE} rows without a gap (or give hold_gaps, --hold-gaps), but "
            f"{', '.join(log.name for log in parts[0])} do not"
        )
    return pieces[0], pieces[1]


def family_of(
    logs: Sequence[Log],
    free: Sequence[str],
    *,
    preset: str | Path | None = None,
    model: Any = None,
    sensors: Sequence[str] | None = None,
    noise: bool = True,
    filter: str = "ekf",
) -> Any:
    """The thruster or the model whose parameters are free.

    Args:
        logs: training logs.
        free: names of the free parameters; a thruster has a default.
        preset: the thruster where the search starts.
        model: instead of a thruster: a model, a function that makes one, or "module:object".
        sensors: measured channels of a thruster.
        noise: whether the variances of Q and R are free, too.
        filter: the filter whose innovations are used; for a thruster, and on own stamps, always the ekf.

    Raises:
        ValueError: for an unknown name; the message has the known ones.
    """
    stamped = logs[0].stamps is not None
    if stamped and filter != "ekf":
        raise ValueError(f"logs on their own stamps must be identified with the ekf, but got filter {filter}")
    if model is None:
        if filter != "ekf":
            raise ValueError(f"a thruster must be identified with the ekf, but got filter {filter} (--filter)")
        whose = None if preset is None else str(preset)
        of_preset = logs_package().family_of_preset(logs, whose, sensors, list(free), noise=noise)
        return AnyStepFamily(of_preset, logs) if stamped else of_preset
    if not free:
        raise ValueError("free (--free) must name at least one parameter of the model, but got none")
    offered = object_named(model, "model") if isinstance(model, str) else model
    family = LoggedFamily(logs, in_discrete_time(offered), list(free), noise=noise, dt=logs[0].dt)
    return AnyStepFamily(family, logs) if stamped else family


class LoggedFamily(ModelFamily):
    """A model's family with the logs that it is identified on, as `ThrusterFamily` has them."""

    def __init__(self, logs: Sequence[Log], make: Any, free: Sequence[str], **options: Any):
        """Keep the logs."""
        super().__init__(make, free, **options)
        self.data, self.dt = tuple(logs), logs[0].dt

    def shifted(self, logs: Sequence[Log]) -> tuple[Log, ...]:
        """Other logs for this family, unchanged."""
        return tuple(logs)


class AnyStepFamily:
    """A family of a plant, whose models take the step ratios of logs on their own stamps.

    Attributes:
        plain: the family itself, whose values are written.
        free: its free parameters.
        data: the logs.

    Raises:
        ValueError: for free clock offsets, which move the stamps, or a model of one sample time.
    """

    def __init__(self, plain: Any, logs: Sequence[Log]):
        """Check the model."""
        self.plain, self.free, self.data, self.dt = plain, plain.free, tuple(logs), logs[0].dt
        moving = next(
            (parameter.name for parameter in self.free if parameter.name.startswith("clock_offset_")), None
        )
        if moving is not None:
            raise ValueError(f"parameters on a log's own stamps must not move these, but got {moving}")
        self.model()

    def model(self, **values: float) -> StateSpaceModel:
        """The model for values, with one input more."""
        return in_any_steps(self.plain.model(**values), self.dt)

    def shifted(self, logs: Sequence[Log]) -> tuple[Log, ...]:
        """Other logs for this family, unchanged."""
        return tuple(logs)


def remarks(runs: Sequence[Log], proving: Sequence[Log], result: Identification) -> list[str]:
    """Findings in the logs, remedies, and the meaning of a gate for a filter with these parameters.

    Args:
        runs: training runs, or their pieces between gaps.
        proving: held-out ones.
        result: what was identified.
    """
    logs = (*runs, *proving)
    sentences = remarks_on(logs)
    if any(log.uncut is not None for log in logs):
        sentences.append(
            "Runs are cut at gaps: each piece is a separate run with its own initial state (--hold-gaps, "
            "hold_gaps=True, does not cut)."
        )
    if has_outliers(runs) and not result.left_out:
        sentences.append(
            "Outliers bias the result: --gate 5 (gate=5) leaves out samples beyond five standard deviations."
        )
    gate = result.objective.gate
    if gate < math.inf:
        held_out, training_note = "held-out runs count all samples", "the runs it has seen are of the same samples"
        sentences.append(
            "R and Q are those of the samples within the gate: a filter that also meets the outliers needs a "
            f"gate (session(gate={gate:g})), or to be robust (ekf-robust). Figures of "
            f"{(held_out if proving else training_note)}."
        )
    return sentences


def check_offsets(parameters: Sequence[Parameter], logs: Sequence[Log]) -> None:
    """Raise ValueError unless ranges of clock offsets are short: without common data any model would fit."""
    most = min(log.times[-1] for log in logs) / OFFSET_SHARE
    for parameter in parameters:
        if parameter.name.startswith("clock_offset_") and max(-parameter.low, parameter.high) > most:
            raise ValueError(
                f"the range of {parameter.name} must be within a quarter of the shortest log, {most:g} s, but is "
                f"from {parameter.low:g} to {parameter.high:g}"
            )


def write_found(path: str | Path, result: Identification, family: Any, logs: Sequence[str]) -> None:
    """Write the preset file of a thruster, or the values of a model.

    Args:
        path: path of a file that ends in .toml.
        result: from `tuning.identification.identify`.
        family: from `family_of`.
        logs: names of the training runs.

    Raises:
        ValueError: if the path has another ending or cannot be written.
    """
    if not str(path).endswith(".toml"):
        raise ValueError(f"a file of identified parameters must end in .toml, but got {short_repr(str(path))}")
    family = family.plain if isinstance(family, AnyStepFamily) else family
    if isinstance(family, ModelFamily):
        write_values(path, result, logs, getattr(family, "dt", None))  # of a family of logs
    else:
        logs_package().write_identified(path, result, family, logs)
