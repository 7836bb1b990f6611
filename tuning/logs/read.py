"""Logs as users give them: the log, and the source of its model at its sample time.

The model comes from a pair (model, logs), from a model, or from a thruster's preset.
Of a model by name, such as "constant" or "auto", it also finds the columns, and the numbers that the user did not
give. Those are of `tuning.fit` on the rows from which a study learns; held-out rows count for nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from filters.models import NAMES, named_model
from filters.named import AUTO, NamedMaker, is_model_name, model_named, text_of
from filters.plants import PLANTS
from filters.tuned_file import check_preset_file, read_tuned_file, tune_options
from thruster_env.core.checks import finite, listed, short_repr
from thruster_env.core.files import read_toml
from thruster_env.core.modules import is_code, object_named
from thruster_env.env.model_env import ANY_DT, read_for
from thruster_env.logs.columns import NO_COLUMN
from thruster_env.logs.findings import Remark
from thruster_env.logs.log import Log
from thruster_env.logs.recorders.registry import ENDINGS
from thruster_env.logs.table import SUFFIXES
from thruster_env.model.affine import LETTERS, AffineModel, affine_model
from thruster_env.model.continuous import ContinuousModel, in_discrete_time
from thruster_env.model.state_space import StateSpaceModel
from tuning.likelihood.recorded import CLOCK
from tuning.likelihood.result import read_values
from tuning.problems.find import logs_package
from tuning.problems.problem import Parameter
from tuning.series.column import Column, log_of_columns

Named = Mapping[str, Any] | Sequence[str] | None  # a mapping, or texts NAME=VALUE as on a command line


def read_named(
    path: Any,
    preset: str | Path | None = None,
    model: Any = None,
    sensors: Sequence[str] | None = None,
    columns: Named = None,
    clock_offset: Named = None,
    dt: float | None = None,
    name: str | None = None,
    grid: bool = True,
    inputs_act: str | None = None,
    stamps: str | None = None,
) -> tuple[Log, Any]:
    """A log, and the source of its model at its sample time.

    Args:
        path: path of a file; a table, as a pandas.DataFrame or a mapping from headers to arrays; or a `Log`.
        preset: the recorded thruster, by name or file, whose clock offsets are corrected; for a model a FILE.toml
            with its values.
        model: instead of a thruster: a `StateSpaceModel`, what makes or offers one, "module:object", or a name
            (`filters.named`), of one that is `NamedMaker` for columns of numbers.
        sensors: measured channels of a thruster.
        columns: headers by quantity, a mapping or texts NAME=HEADER[UNIT]; of a model by name also HEADER or X,Y.
        clock_offset: seconds by quantity, a mapping or texts NAME=SECONDS.
        dt: sample time [s].
        name: name of a log that is not a file.
        grid: whether samples are put on a grid; else the log is on its own stamps.
        inputs_act: whether the input of a row acts "from" it on or "until" it (`thruster_env.logs.read.read_log`).
        stamps: "header" or "receipt" of a bag.

    Raises:
        ValueError: states the rule and the value.
    """
    if model is not None and (sensors or (preset is not None and not str(preset).endswith(".toml"))):
        raise ValueError(
            "a log must be of model (--model) or of a thruster (preset, sensors; --preset, --sensor), but got both"
        )
    offsets, maker = pairs("clock_offset (--clock-offset)", clock_offset), maker_of(model)
    options: dict[str, Any] = {
        "columns": pairs("columns (--column)", columns if maker is None else _named_by_headers(columns)),
        "clock_offset": {key: _seconds(key, value) for key, value in offsets.items()},
        "dt": dt,
        "grid": None if grid else False,
        "inputs_act": inputs_act,
        "stamps": stamps,
    }
    if isinstance(path, Log):
        option = next((key for key, value in options.items() if value not in (None, {})), None)
        if option is not None:
            raise ValueError(f"{option} must come with a file or a table, but {path.name} is a Log already")
    elif name is not None:
        options["name"] = name
    if model is not None and preset is not None:
        from tuning.likelihood.result import values_in, with_values

        if not isinstance(path, Log):  # a user's offsets have priority
            options["clock_offset"] = clock_offsets_in(preset) | options["clock_offset"]
        if maker is None:
            offer = offer_of(model)
            log, offer = read_for(path, offer, **options)[0], with_values(in_discrete_time(offer), preset)
            offer(log.dt)  # or the values are of another sample time
            return log, offer
        maker = with_values_of(maker, values_in(preset), preset)
    if maker is not None:
        return read_columns(maker, path, **options)
    if model is not None:
        offer = offer_of(model)
        return read_for(path, offer, **options)[0], offer
    room = logs_package()
    whose = room.DEFAULT_PRESET if preset is None else str(preset)
    thruster = room.Preset(whose, sensors, ANY_DT)
    try:
        log, _ = read_for(path, thruster.state_space_model(), any_dt=True, **options)
    except ValueError as error:
        lacks_all = all(part in str(error) for part in (NO_COLUMN, "the input ", "the measurement "))
        if preset is not None or sensors or options["columns"] or not lacks_all:
            raise
        raise ValueError(_of_another_plant(path, str(error))) from None
    known = {key: value for key, value in thruster.clock_offset.items() if f"measurement:{key}" not in log.offsets}
    if known and not isinstance(path, Log):  # offsets of the user or of the log itself have priority
        options["clock_offset"] |= known
        log, _ = read_for(path, thruster.state_space_model(), any_dt=True, **options)
    return log, room.Preset(whose, sensors, log.dt)


def _of_another_plant(path: Any, error: str) -> str:
    """What to do with a log without a model that is not a thruster's."""
    rule = "a log must have the columns of its model, a thruster's by default"
    names = ", ".join((*NAMES, *PLANTS))
    fit = f"`thruster fit {path}` (tuning.fit)" if isinstance(path, str | PathLike) else "tuning.fit"
    return (
        f"{rule}, but {error.partition(', but ')[2].partition('; ')[0]}: {fit} finds a "
        f"model with Q and R, --model auto (model='auto') uses it; other models are {names} and MODULE:OBJECT, "
        "with --column HEADER where there are several columns of numbers"
    )


def offer_of(model: Any) -> Any:
    """The source of a model: one of `filters.plants` by its name, the object of "module:object", or itself."""
    if not isinstance(model, str):
        return model
    return model_named(model) if is_model_name(model) else object_named(model, "model")


def _named_by_headers(columns: Named) -> Named:
    """Headers of a named model's axes, also as texts HEADER or X,Y, by these."""
    if not isinstance(columns, list | tuple):
        return columns
    headers = [part for text in columns for part in (text.split(",") if "=" not in str(text) else [text])]
    return [text if "=" in text else f"{text}={text}" for text in headers]


def pairs(option: str, named: Named) -> dict[str, Any]:
    """A mapping, from a mapping or from texts NAME=VALUE; ValueError for another form, or a repeated name."""
    if isinstance(named, Mapping):
        return dict(named)
    if isinstance(named, str) or not isinstance(named, Sequence | None):
        raise ValueError(f"{option} must be a mapping by name, or texts NAME=VALUE, but got {short_repr(named)}")
    values: dict[str, str] = {}
    for text in named or []:
        name, equals, value = text.partition("=")
        if not (name and equals and value) or name in values:
            rule = "be given once for each name" if name in values else "have the form NAME=VALUE"
            raise ValueError(f"{option} must {rule}, but got {short_repr(text)}")
        values[name.strip()] = value.strip()
    return values


def texts(named: Named) -> list[str] | None:
    """The same as texts NAME=VALUE, as in files; None for nothing."""
    if named is None:
        return None
    return [f"{name}={value}" for name, value in named.items()] if isinstance(named, Mapping) else list(named)


def _seconds(name: str, value: Any) -> float:
    try:
        return finite(f"the clock offset of {name}", value)
    except ValueError:
        raise ValueError(
            f"clock_offset (--clock-offset) of {name} must be seconds, but got {short_repr(value)}"
        ) from None


def as_tuned(named: Mapping[str, Any], tuned: str | Path | None) -> dict[str, Any]:
    """Options for reading a log, with the preset and sensors of a tuned file's own logs where none are given.

    Raises:
        ValueError: if no model is given, and the file only names one that is code.
    """
    if tuned is None or named.get("model") is not None:
        return dict(named)
    options = tune_options(read_tuned_file(tuned))
    check_preset_file(options, named.get("preset"), tuned)
    if named.get("preset") is None:
        check_model(options.get("model"), None, tuned)
    names = ("preset", "sensors", *(["model"] if is_model_name(options.get("model")) else []))
    stored: dict[str, Any] = {name: value for name, value in options.items() if name in names}
    return {**stored, **{name: value for name, value in named.items() if value not in (None, [])}}


def check_model(named, trusted: Any, file: str | Path) -> None:
    """Raise ValueError unless the caller gives the code that a file names, by this name or as an object."""
    if trusted is None and (is_auto(named) or is_model_name(named)):
        return  # it is data
    if named is None and trusted is not None:
        raise ValueError(
            f"model (--model) must be left out for logs of a thruster, as in {file}, but got {short_repr(trusted)}"
        )
    if named != trusted and isinstance(trusted, str | None):
        raise ValueError(
            f"the model of logs must be given by its name if it is code, but {file} names {short_repr(named)} and "
            f"got {short_repr(trusted)}: use --model {named} (model={named!r} in Python), if you trust it"
        )


def name_of(log: Any, index: int) -> str:
    """Name of a log: its path, its own name, or for a table its number."""
    if isinstance(log, Log):
        return log.name
    return str(log) if isinstance(log, str | PathLike) else f"run{index + 1}"


def model_of_logs(logs: Any, model: Any, preset: str | Path | None) -> tuple[Any, Any, str | Path | None]:
    """Logs, their model (None for a thruster) and the preset, from what a user gives.

    Args:
        logs: recorded runs, or a pair (model, logs) as `tuning.tune` takes it.
        model: a model, what makes or offers one, "module:object", or a thruster's preset.
        preset: a thruster, by name or file.

    Raises:
        ValueError: if a model or a preset is given twice, or a model is neither code nor a preset.
    """
    if isinstance(logs, tuple) and len(logs) == 2 and _is_model(logs[0]):
        if model is not None:
            raise ValueError(f"a pair (model, logs) must come without another model, but got {short_repr(model)}")
        model, logs = logs
    if is_auto(model) or is_model_name(model):
        return logs, model, preset
    if not isinstance(model, str | Path) or is_code(str(model)):
        return logs, model, preset
    if Path(model).suffix == ".toml" and Path(model).is_file():
        matrices = read_toml(model, "a model's file")
        if LETTERS.keys() & matrices.keys():
            return logs, _model_of_matrices(matrices, model), preset
    if preset is not None:
        raise ValueError(
            f"give either a model or a preset, but got both, {short_repr(model)} and {short_repr(preset)}"
        )
    if not logs_package().is_preset(model):
        names = ", ".join((AUTO, *NAMES, *PLANTS))
        rule = f"a model must be an object, 'module:object', one of {names}, or a thruster's preset"
        raise ValueError(f"{rule}, but got {short_repr(model)}")
    return logs, None, model


def _model_of_matrices(content: Mapping[str, Any], path: str | Path) -> AffineModel:
    """The model of a file with F, H, Q, R, P0, perhaps B, x0, and quantities, each [name, symbol, unit]."""
    names = {"inputs": "input_quantities"}
    named = {names.get(key, key): value for key, value in content.items()}
    for key in ("states", "input_quantities", "measurements"):
        if key in named:
            named[key] = [tuple(entry) if isinstance(entry, list) else entry for entry in named[key]]
    try:
        return affine_model(**named)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{error} (in {path})") from None


def _is_model(candidate: Any) -> bool:
    """Whether something is a model, what makes or offers one, code, or a thruster's preset, but no log."""
    if isinstance(candidate, str | Path):
        if Path(candidate).suffix in (*SUFFIXES, *ENDINGS):  # a log in a folder of Windows has a colon, too
            return False
        return (
            is_code(str(candidate))
            or is_model_name(candidate)
            or is_auto(candidate)
            or logs_package().is_preset(candidate)
        )
    return (
        isinstance(candidate, StateSpaceModel | ContinuousModel)
        or hasattr(candidate, "state_space_model")
        or _makes_one(candidate)
    )


def _makes_one(candidate: Any) -> bool:
    return callable(candidate) and not isinstance(candidate, Log) and not hasattr(candidate, "columns")


def clock_offsets_in(path: str | Path) -> dict[str, float]:
    """Clock offsets [s] by channel among the values in a file."""
    values = read_values(path).items()
    return {name.removeprefix(CLOCK): seconds for name, seconds in values if name.startswith(CLOCK)}


def is_auto(model: Any) -> bool:
    """Whether a model is to be chosen: "auto", perhaps with settings."""
    return isinstance(model, str) and model.partition(":")[0].strip().lower() == AUTO


def maker_of(model: Any) -> NamedMaker | None:
    """A model of columns of numbers, by its name or "auto"; None for any other model."""
    if is_auto(model):
        constant = model_named("constant" + model.strip()[len(AUTO) :])
        assert isinstance(constant, NamedMaker)
        if constant.values:
            raise ValueError(
                f"{AUTO} must come with axes or dt alone, as {AUTO}:axes=2, but got {short_repr(model)}"
            )
        return replace(constant, name=AUTO)
    maker = model if isinstance(model, NamedMaker) else model_named(model)
    return maker if isinstance(maker, NamedMaker) else None


def with_values_of(maker: NamedMaker, values: Mapping[str, float], file: Any) -> NamedMaker:
    """The model with values of a file; ValueError for others than its numbers."""
    wrong = sorted(set(values) - set(maker.names))
    if wrong:
        raise ValueError(f"{file} must have numbers of {maker.name}, {', '.join(maker.names)}, but has {wrong[0]}")
    return replace(maker, values={**values, **maker.values})


def read_columns(
    maker: NamedMaker, source: Any, columns: Mapping[str, str], **options: Any
) -> tuple[Log, NamedMaker]:
    """A log of some columns of numbers, and the named model of these.

    Args:
        maker: from `maker_of`.
        source: a file, a table, an array (K,) or (K, axes), or a `Log`.
        columns: headers by any name, one for each axis; empty for a file with as many columns as axes.
        **options: others of `thruster_env.logs.read.read_log`.

    Raises:
        ValueError: for another number of columns than axes, or a file that cannot be read.
    """
    axes, log = len(maker.quantities), source
    if not isinstance(source, Log):
        options["dt"] = options.get("dt") if maker.dt is None else maker.dt
        log = log_of_columns(source, list(columns.values()) or None, axes, **options)
    if axes not in (1, len(log.measured)):
        symbols = listed(quantity.symbol for quantity in log.measured)
        raise ValueError(f"{maker.name} of {axes} axes must have as many columns, but got {symbols}")
    if log.inputs.shape[1]:
        raise ValueError(f"{maker.name} has no inputs, but log {log.name} has some: write the model as a function")
    return log, replace(maker, quantities=tuple(log.measured))


def check_on_grid(maker: NamedMaker, logs: Sequence[Log]) -> None:
    """Raise ValueError for a log on its own stamps, where Q of a step is in proportion to its length."""
    stamped = next((log.name for log in logs if log.stamps is not None), None)
    if stamped is not None:
        raise ValueError(
            f"{maker.name} must be tuned or identified on a grid, but {stamped} is on its own stamps: leave "
            "--no-grid out, or use thruster fit and estimate, which have the Q of each step"
        )


def with_numbers(
    maker: NamedMaker, log: Log, rows: np.ndarray | None = None
) -> tuple[NamedMaker, tuple[Parameter, ...], Log]:
    """A named model with all numbers, these as parameters of a study, and the log with a remark on them.

    They are those that the text gives, the others by maximum likelihood on some rows of the log.

    Args:
        maker: from `read_columns`.
        log: the log.
        rows: that count, (K + 1,); all if None.

    Raises:
        ValueError: for data without a likelihood.
    """
    from tuning.series.answer import choose_among_all  # with what only a search needs
    from tuning.series.fit import choose
    from tuning.series.likelihood import ColumnLikelihood

    values = log.measurements if rows is None else np.where(rows[:, None], log.measurements, np.nan)
    column = Column(values[:, 0] if values.shape[1] == 1 else values, log.dt, maker.quantities, stamps=log.stamps)
    known, axes = dict(maker.values), len(maker.quantities)
    if maker.name == AUTO or not maker.is_complete:
        if any(log.offsets.values()):
            rule = f"{maker.name} must come with all its numbers where columns have own clock offsets"
            raise ValueError(
                f"{rule}, since noise of interpolated samples is correlated, but log {log.name} has some: leave "
                "them out, or give the numbers"
            )
        chosen = (choose_among_all(column) if maker.name == AUTO else choose(column, (maker.name,))).chosen
        maker, known = replace(maker, name=chosen.name), {**chosen.values, **known}
        numbers = {name: known[name] for name in maker.names}
        of = "this log" if rows is None else "the training rows"
        model = text_of(maker.name, numbers, axes)
        text = f'the model\'s numbers are the maximum-likelihood ones of {of}, --model "{model}"'
        remark = Remark("model", "", text)
        log = replace(log, recording=log.recording._replace(remarks=(*log.recording.remarks, remark)))
    sum_ = named_model(maker.name)
    free = ColumnLikelihood(sum_, column).coordinates.free
    parameters = tuple(
        replace(
            number,
            low=min(number.low, known[number.name]),
            high=max(number.high, known[number.name]),
            default=known[number.name],
        )
        for number in free
    )
    mean = tuple(column.mean.tolist()) if maker.mean is None and sum_.about_mean else maker.mean
    first, spread = tuple(column.first.tolist()), column.scales.spread
    return replace(maker, values=known, mean=mean, first=first, spread=spread), parameters, log
