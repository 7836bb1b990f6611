"""Named models of recorded runs: the columns that they are of, and their numbers by maximum likelihood.

Numbers that the user did not give are those of `tuning.fit` on the rows from which a study learns; held-out rows
count for nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from filters.models import named_model
from filters.named import AUTO, NamedMaker, model_named, text_of
from thruster_env.core.checks import listed, short_repr
from thruster_env.logs.findings import Remark
from thruster_env.logs.log import Log
from tuning.problems.problem import Parameter
from tuning.series.column import Column, log_of_columns

MODEL = "model"  # kind of a finding


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
        remark = Remark(MODEL, "", text)
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
