"""Recorded logs as a problem: of a study, from options or from a tuned file, and of an identification.

An identification has training runs, held-out runs, and a family of models.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from filters.logs.estimate import estimate_with
from filters.logs.findings import findings
from filters.named import NamedMaker, is_model_name
from filters.plants import PLANTS
from filters.registry import make_filter
from filters.tuned_file import check_preset_file, made_with, read_tuned_file, tune_options
from thruster_env.core.checks import short_repr
from thruster_env.env.model_env import read_for
from thruster_env.logs.findings import has_outliers, remarks_on
from thruster_env.logs.log import FEWEST_STEPS, Log, in_any_steps, piece_of
from thruster_env.model.continuous import in_discrete_time
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.turns import innovations_of
from tuning.likelihood.identify import identify
from tuning.likelihood.parametric import ModelFamily
from tuning.likelihood.recorded import clock_offsets, shifted
from tuning.likelihood.result import Identification
from tuning.logs.read import (
    check_model,
    check_on_grid,
    is_auto,
    maker_of,
    name_of,
    offer_of,
    read_named,
    texts,
    with_numbers,
)
from tuning.problems.assumed import name_and_unknown
from tuning.problems.find import logs_package, named
from tuning.problems.log_parts import check_apart, check_times, parts_of
from tuning.problems.log_problem import MISSING, LogProblem, without_outliers
from tuning.problems.problem import Parameter, Problem

# Of `read_named`.
OPTIONS = ("preset", "model", "sensors", "columns", "clock_offset", "dt", "grid", "inputs_act", "stamps")
CUTS = ("held_out", "blocks", "lead", "hold_gaps", "start", "outliers")
EVERY_THIRD = 3
LAST_PART = 4  # of a run the rows that are held out: one in so many, at its end
SHORTEST_HELD_OUT = 50  # rows of that part
SHORTEST_PIECE = 10  # rows of a run between gaps: fewer tell little beside how they begin
GYROSCOPE = ("gyroscope", "bias_walk")  # numbers of `attitude` that a log of motion does not determine
CORRELATED = 0.1  # of innovations with later ones, at least


def log_problem(
    logs: Any,
    held_out: Any = None,
    blocks: int | None = None,
    lead: int | None = None,
    hold_gaps: bool = False,
    start: str | None = None,
    outliers: str | None = None,
    *,
    apart: bool = True,
    **options: Any,
) -> LogProblem:
    """The problem of some logs.

    Args:
        logs: a recorded run or several: paths, tables or `Log`s, as `read_named` takes them. Names of
            tables are run1, run2, ...
        held_out: held-out runs, or their paths or names; those that are not among the logs are added to them. A
            run among the logs with the same content is the held-out one, whatever its path or name.
        blocks: number of blocks of each run.
        lead: rows of a block's lead-in.
        hold_gaps: whether runs are not cut at gaps, and their inputs are held there.
        start: where blocks begin, "prior" or "measurement", as `LogProblem` takes it.
        outliers: "kept" or "missing", likewise.
        apart: whether to check that held-out runs are not among the others; a tuned file's digests have settled
            it.
        **options: options of `read_named`.

    Raises:
        ValueError: states the rule and the value.
    """
    runs, held_names = runs_by_name(logs, held_out)
    if not runs:
        raise ValueError(
            "a problem of logs must have at least one, in (model, logs) or by --log FILE, but got none"
        )
    pairs = [read_named(log, **options, name=name) for name, log in runs.items()]
    recorded = [log for log, _ in pairs]
    recorded = without_rescaled(recorded, held_names) if apart else recorded
    runs = {log.name: runs[log.name] for log in recorded}
    offer = pairs[0][1]
    cuts: dict[str, Any] = {"held_out": held_names, "blocks": blocks, "lead": lead, "hold_gaps": hold_gaps or None}
    cuts |= {"start": start, "outliers": outliers}
    cuts = {key: value for key, value in cuts.items() if value is not None and value != []}
    if free_numbers(offer):
        return _of_numbers(offer, recorded, cuts, apart, _content(runs, options, cuts))
    if not isinstance(offer, NamedMaker):
        content = _content(runs, options, cuts)
        return LogProblem(recorded, read_for(recorded[0], offer)[1](), **cuts, apart=apart, content=content)
    run, (maker, parameters, log) = _learnt(offer, recorded, cuts)
    if is_auto(options["model"]):
        axes = len(maker.quantities)
        options["model"] = maker.name + f":axes={axes}" * (axes > 1)
    content = _content(runs, options, cuts)
    recorded[run] = replace(log, measurements=recorded[run].measurements)
    assumed = partial(maker, dt=recorded[0].dt)
    return LogProblem(recorded, assumed, parameters=parameters, **cuts, apart=apart, content=content)


def _of_numbers(
    offer: Any, logs: list[Log], cuts: Mapping[str, Any], apart: bool, content: dict | None
) -> LogProblem:
    """The problem of a model of a few numbers, which begin at the maximum-likelihood ones of the training rows."""
    options = {"hold_gaps": cuts.get("hold_gaps", False), "sizes": True}
    parts = parts_of(logs, cuts.get("lead"), cuts.get("blocks"), cuts.get("held_out"), **options)
    counted = [np.zeros(log.steps + 1, dtype=bool) for log in logs]
    for index in parts.training:
        block = parts.blocks[index]
        counted[block.run][block.first : block.first + block.rows] = True
    training = [
        replace(log, measurements=np.where(rows[:, None], log.measurements, np.nan))
        for log, rows in zip(logs, counted, strict=True)
        if rows.any()
    ]
    family = LoggedFamily(training, offer, free_numbers(offer), noise=False, dt=logs[0].dt)
    values = identify(training, family.model, family.free, starts=1, against=False).values
    parameters = [
        replace(parameter, default=min(max(values[parameter.name], parameter.low), parameter.high))
        for parameter in family.free
    ]
    assumed = partial(offer, dt=logs[0].dt)
    return LogProblem(logs, assumed, parameters=parameters, **cuts, apart=apart, content=content)


def _learnt(maker: NamedMaker, logs: Sequence[Log], cuts: Mapping[str, Any]) -> tuple[int, tuple]:
    """The run that has most rows in training blocks, and what `with_numbers` returns of these."""
    check_on_grid(maker, logs)
    logs = list(map(without_outliers, logs)) if cuts.get("outliers") == MISSING else logs
    options = {"hold_gaps": cuts.get("hold_gaps", False), "sizes": True}
    parts = parts_of(logs, cuts.get("lead"), cuts.get("blocks"), cuts.get("held_out"), **options)
    rows = [np.zeros(log.steps + 1, dtype=bool) for log in logs]
    for block in parts.blocks[: len(parts.training)]:
        rows[block.run][block.first + parts.lead : block.first + block.rows] = True
    run = max(range(len(logs)), key=lambda index: int(rows[index].sum()))
    return run, with_numbers(maker, logs[run], rows[run])


def runs_by_name(logs: Any, held_out: Any = None) -> tuple[dict[str, Any], list[str]]:
    """All runs by name, with further held-out runs at the end, and the names of the held-out runs."""
    runs: dict[str, Any] = {}
    for log in listed(logs):
        _add(runs, name_of(log, len(runs)), log)
    names = []
    for log in listed(held_out):
        name = next((known for known, run in runs.items() if _is_same(run, log)), name_of(log, len(runs)))
        if not (isinstance(log, str) and name in runs):
            _add(runs, name, log)
        names.append(name)
    return runs, list(dict.fromkeys(names))


def without_rescaled(logs: Sequence[Log], held_names: Sequence[str]) -> list[Log]:
    """The logs without those that are the content of a held-out one under another name.

    Args:
        logs: recorded runs.
        held_names: names of the held-out ones.

    Raises:
        ValueError: if nothing is left to learn from.
    """
    proving = {log.digest for log in logs if log.name in held_names}
    left = [log for log in logs if log.name in held_names or log.digest not in proving]
    if held_names and all(log.name in held_names for log in left):
        raise ValueError("at least one log must be left to learn from, but all are held out")
    return left


def _is_same(first: Any, other: Any) -> bool:
    """Whether two runs are one object, or paths of one file."""
    if isinstance(first, str | PathLike) and isinstance(other, str | PathLike):
        return Path(first).resolve() == Path(other).resolve()
    return first is other


def listed(logs: Any) -> list:
    """Recorded runs as a list; a single run need not be in one. Empty for None."""
    if logs is None:
        return []
    return list(logs) if isinstance(logs, list | tuple) else [logs]


def _add(runs: dict[str, Any], name: str, log: Any) -> None:
    if name in runs and not isinstance(log, str | PathLike) and runs[name] is not log:
        raise ValueError(f"logs must have different names, but got two called {name}")
    runs.setdefault(name, log)


def _content(runs: Mapping[str, Any], options: Mapping[str, Any], cuts: Mapping[str, Any]) -> dict | None:
    """The options of the problem as data for JSON; None where a log is not a file, or the model is an object."""
    model, plain = options.get("model"), dict(options)
    if not all(isinstance(log, str | PathLike) for log in runs.values()) or not isinstance(model, str | None):
        return None
    for name in ("columns", "clock_offset"):
        plain[name] = texts(plain.get(name))
    plain["preset"] = None if plain.get("preset") is None else str(plain["preset"])
    plain["sensors"] = None if plain.get("sensors") is None else list(plain["sensors"])
    set_options = {name: plain[name] for name in options if plain[name] is not None}
    return {"options": {**set_options, **cuts}}


def problems_in(file: Path, model: Any = None, preset: str | Path | None = None) -> list[Problem]:
    """The problems of logs that a tuned file names, read again; empty if it names none.

    A model that is code is not imported because a file names it: the caller has to give it again, as
    "module:object" or as a model, or what makes or offers one.

    Args:
        file: the tuned file.
        model: of the logs, if it is code.
        preset: where the file's preset is now; of a scenario the preset with which the file was made.

    Raises:
        ValueError: if a log cannot be read, the options in the file are damaged, or a model that is code is not
            given.
    """
    if not file.is_file():
        return []
    problems: list[Problem] = []
    of_file = read_tuned_file(file)
    for name, entry in of_file["problems"].items():
        content = entry.get("content") if isinstance(entry, dict) else None
        if isinstance(content, dict) and isinstance(content.get("of"), dict):  # that of an augmented problem
            name, content = name_and_unknown(name)[0], content["of"].get("content")
        if not isinstance(content, dict) or "logs" not in content:
            continue
        try:
            paths = [log["file"] for log in content["logs"]]
            options = dict(content["options"])
            if not all(isinstance(path, str) for path in paths) or set(options) - {*OPTIONS, *CUTS}:
                raise TypeError
        except (KeyError, TypeError):
            raise ValueError(
                f"logs in a tuned file must have paths and options, but {file} has {short_repr(content)}"
            ) from None
        check_model(options.get("model"), model, file)
        check_preset_file(options, preset, file)
        _check_logs_are_there(paths, file)
        options |= {} if preset is None else {"preset": str(preset)}
        options |= {} if model is None else {"model": model}
        problem = log_problem(paths, **options, apart=False)
        if name not in (problem.name, re.sub(r" and (\d+) more$", r"+\1", problem.name)):  # as it was until 0.1
            rule = f"logs in a tuned file must be those of {short_repr(name)}"
            raise ValueError(f"{rule}, but {file} has {problem.name}")
        problems.append(named(problem, name))
    if preset is not None and not problems and str(preset) != tune_options(of_file).get("preset"):
        raise ValueError(
            f"preset (--preset) must be that of the tuned file, but got {preset}, and {file} was made with "
            f"{made_with(of_file)}, whose contents it holds: leave --preset out"
        )
    return problems


def _check_logs_are_there(paths: Sequence[str], file: Path) -> None:
    """Raise ValueError if one of the logs that a tuned file names is not there."""
    missing = [path for path in paths if not Path(path).exists()]
    if missing:
        raise ValueError(
            f"the logs of {file} must be where they were, but there is no file {', '.join(missing)}: run the "
            "command in the folder in which thruster tune ran, or put them back"
        )


def model_named_in(problem: Problem) -> str | None:
    """The model that must be given again (--model) with a tuned file of a problem; None where none must."""
    content = problem.as_mapping()
    if content is None or "logs" not in content:
        return None
    model = content["options"].get("model")
    return None if is_model_name(model) else model


def cut_at_gaps(log: Log, shortest: int = FEWEST_STEPS + 1) -> list[Log]:
    """The pieces of a log between gaps with at least `shortest` rows, each a log; the log itself without gaps."""
    long = [(first, rows) for first, rows in log.pieces if rows >= max(shortest, FEWEST_STEPS + 1)]
    return [log] if len(log.pieces) == 1 else [piece_of(log, first, rows) for first, rows in long]


def split_runs(
    logs: Any,
    held_out: Any = None,
    *,
    use_all: bool = False,
    hold_gaps: bool = False,
    outliers: str | None = None,
    **options: Any,
) -> tuple[list[Log], list[Log]]:
    """The training logs, and the held-out ones for validation: by default every third of three or more.

    Of fewer the last quarter of each is held out, unless it is short, or the logs are on their own stamps.

    Args:
        logs: recorded runs, as `tuning.logs.read.read_named` takes them.
        held_out: the held-out runs, or their paths or names.
        use_all: whether no run is held out.
        hold_gaps: whether runs are not cut at gaps, and their inputs are held there; on their own stamps they are.
        outliers: "missing" leaves out samples that the logs' findings call outliers.
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
    read = list(map(without_outliers, read)) if outliers == MISSING else read
    parts = [log for log in read if log.name not in validating], [log for log in read if log.name in validating]
    check_apart(*parts)
    if any(log.stamps is not None for log in read):
        return parts
    if not validating and not use_all:
        pieces = [[piece for log in read for piece in _part(log, late, hold_gaps)] for late in (False, True)]
    elif hold_gaps:
        return parts
    else:
        pieces = [[piece for log in logs_ for piece in cut_at_gaps(log, SHORTEST_PIECE)] for logs_ in parts]
    if not pieces[0]:
        raise ValueError(
            f"logs must have {SHORTEST_PIECE} rows without a gap (or give hold_gaps, --hold-gaps), but "
            f"{', '.join(log.name for log in parts[0])} do not"
        )
    return pieces[0], pieces[1]


def _part(log: Log, late: bool, hold_gaps: bool) -> list[Log]:
    """The last quarter of a log, or the rows before it, cut at gaps; of a short log all rows are early."""
    end = log.steps + 1
    cut = end - end // LAST_PART if end >= LAST_PART * SHORTEST_HELD_OUT else end
    first, last = (cut, end) if late else (0, cut)
    if first == last:
        return []
    bounds = [(0, end)] if hold_gaps else log.pieces
    spans = [(max(begin, first), min(begin + rows, last)) for begin, rows in bounds]
    long = [(begin, stop - begin) for begin, stop in spans if stop - begin >= SHORTEST_PIECE]
    return [log if rows == end else piece_of(log, begin, rows) for begin, rows in long]


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
    stamped, maker = logs[0].stamps is not None, maker_of(model)
    if stamped and filter != "ekf":
        raise ValueError(f"logs on their own stamps must be identified with the ekf, but got filter {filter}")
    if model is None:
        if filter != "ekf":
            raise ValueError(f"a thruster must be identified with the ekf, but got filter {filter} (--filter)")
        whose = None if preset is None else str(preset)
        of_preset = logs_package().family_of_preset(logs, whose, sensors, list(free), noise=noise)
        return AnyStepFamily(of_preset, logs) if stamped else of_preset
    if maker is not None:
        check_on_grid(maker, logs)
        longest = max(logs, key=lambda log: log.steps)
        maker, parameters, _ = with_numbers(replace(maker, quantities=tuple(longest.measured)), longest)
        return NamedFamily(logs, maker, parameters, list(free))
    offered = offer_of(model)
    numbers = free_numbers(offered)  # which make Q and R
    free, noise = free or numbers, noise and not numbers
    if not free:
        raise ValueError("free (--free) must name at least one parameter of the model, but got none")
    family = LoggedFamily(logs, in_discrete_time(offered), list(free), noise=noise, dt=logs[0].dt)
    return AnyStepFamily(family, logs) if stamped else family


def free_numbers(offered: Any) -> list[str]:
    """The numbers of a function of `filters.plants` that are free if none is named, but for those that it has."""
    function = getattr(offered, "func", offered)
    names = getattr(function, "free", ()) if any(function is plant for plant in PLANTS.values()) else ()
    return [name for name in names if name not in getattr(offered, "keywords", {})]


class LoggedFamily(ModelFamily):
    """A model's family with the logs that it is identified on, whose channels may have free clock offsets."""

    def __init__(self, logs: Sequence[Log], make: Any, free: Sequence[str], **options: Any):
        """Keep the logs."""
        self.logs, self.dt = tuple(logs), logs[0].dt
        super().__init__(make, free, **options)

    @property
    def channels(self) -> list[str]:
        """Symbols of the measurements, then of the inputs of other symbols."""
        return list(dict.fromkeys(q.symbol for q in (*self.logs[0].measured, *self.logs[0].input_quantities)))

    @property
    def known(self) -> dict[str, Parameter]:
        """Every parameter that may be free, clock offsets last."""
        return super().known | clock_offsets(self.channels, self.logs)

    @property
    def data(self) -> Any:
        """The logs, or a function of the free clock offsets."""
        return self.shifted(self.logs)

    def shifted(self, logs: Sequence[Log]) -> Any:
        """Some logs for this family: unchanged, or a function of the free clock offsets."""
        return shifted(logs, self.free)


class NamedFamily(LoggedFamily):
    """A model by name with the logs that it is identified on; its numbers give Q and R."""

    def __init__(self, logs: Sequence[Log], maker: NamedMaker, parameters: Sequence[Parameter], free: list[str]):
        """All numbers are free if none is named, within the ranges that follow from the data."""
        super().__init__(logs, maker, free or list(maker.names), noise=False, dt=logs[0].dt)
        by_name = {parameter.name: parameter for parameter in parameters}
        self.free = tuple(by_name.get(parameter.name, parameter) for parameter in self.free)


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
    if any(log.uncut is not None and len(log.uncut.pieces) > 1 for log in logs):
        sentences.append(
            "Runs are cut at gaps: each piece is a separate run with its own initial state (--hold-gaps, "
            "hold_gaps=True, does not cut)."
        )
    if has_outliers(runs) and not result.left_out:
        sentences.append(
            "Outliers bias the result: --gate 5 (gate=5) leaves out samples beyond five standard deviations."
        )
    sentences += of_gyroscope(result.names, result.objective.model_at(result.at), runs)
    gate = result.objective.gate
    if gate < math.inf:
        held_out, training_note = "held-out runs count all samples", "the runs it has seen are of the same samples"
        sentences.append(
            "R and Q are those of the samples within the gate: a filter that also meets the outliers needs a "
            f"gate (session(gate={gate:g})), or to be robust (ekf-robust). Figures of "
            f"{(held_out if proving else training_note)}."
        )
    return sentences


def of_gyroscope(names: Sequence[str], model: StateSpaceModel, runs: Sequence[Log]) -> list[str]:
    """That a free noise of a gyroscope is a trap, where innovations show that the acceleration is another one.

    The likelihood is then higher with more noise of the gyroscope, and attitudes are worse (docs/attitude.md).

    Args:
        names: of the free parameters.
        model: with the identified values.
        runs: of which the longest is filtered.
    """
    free = [name for name in names if name in GYROSCOPE]
    if not free or not model.turns:
        return []
    run = max(runs, key=lambda log: log.steps)
    white = findings(estimate_with(make_filter("ekf", model), run)).whiteness
    if white is None:
        return []
    sizes = np.abs(np.einsum("lii->li", white.correlations)).max(axis=0)
    if sizes.max() < max(CORRELATED, 5.0 / math.sqrt(run.steps)):
        return []
    channel = innovations_of(model)[int(sizes.argmax())].symbol
    return [
        f"Beware of {' and '.join(free)}: innovations of {channel} are correlated, up to {sizes.max():.2f}, so "
        "the acceleration is not that of the model, for which noise of the gyroscope then pays: the likelihood "
        "rises, and attitudes get worse. Hold it at the number of the data sheet, or of a log at rest (thruster "
        "log --allan)."
    ]
