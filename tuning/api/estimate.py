"""`tuning.estimate`: a filter or a smoother over a recorded run."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from pathlib import Path
from typing import TYPE_CHECKING, Any

from filters.logs.estimate import estimate as estimate_log
from filters.logs.findings import findings
from thruster_env.core.checks import short_repr
from tuning.api.estimates import LogEstimates
from tuning.logs.model_of_logs import model_of_logs
from tuning.logs.problem import name_of
from tuning.logs.read import as_tuned, read_named

if TYPE_CHECKING:
    from tuning.api.study import Study


def estimate(
    log: Any,
    tuned: str | Path | Study | None = None,
    *,
    filter: Any = None,
    model: Any = None,
    preset: str | Path | None = None,
    sensors: Sequence[str] | None = None,
    columns: Any = None,
    clock_offset: Any = None,
    dt: float | None = None,
    grid: bool = True,
    stamps: str | None = None,
    smoother: bool = False,
    lag: int | None = None,
    skip: int | None = None,
    seed: int = 0,
    **numbers: Any,
) -> LogEstimates:
    """Estimate the state of a recorded run, and report what the innovations say about filter and model.

    States or outputs of the model in the log, such as the thrust of a load cell that the filter does not see, are
    compared with the estimate.

        estimates = tuning.estimate("run.csv", tuned="tuned.json")
        estimates.to_frame()
        estimates.plot_states()

    Args:
        log: the path of a .csv, .parquet or .npz file, or of a recorder's; a table, as a pandas.DataFrame or a
            mapping from headers to arrays; or a `Log`; or a pair (model, log).
        tuned: a tuned file or a `Study`, with filter, Q, R and other parameters.
        filter: without these, the name of a filter, or another package's estimator; "ekf" if None.
        model: the log's model, if it is not a thruster's: a `StateSpaceModel`, an object that makes or offers one,
            "module:object", or a thruster's preset.
        preset: the log's thruster, by name or file.
        sensors: a thruster's channels that the filter sees.
        columns: headers by quantity: {"speed": "motor_rpm", "thrust": "loadcell[kgf]"}.
        clock_offset: seconds by quantity that a channel's clock is ahead.
        dt: sample time [s] of a log without times, or of the grid.
        grid: whether to put the log on a grid; otherwise the filter uses its own time stamps.
        stamps: of a bag, "header" or "receipt": the clock of all topics.
        smoother: correct estimates by later measurements.
        lag: number of later measurements, also without `smoother`; all by default.
        skip: initial rows that are not scored; 50, or a quarter of a short log, by default.
        seed: of the filter's random numbers.
        **numbers: the filter's own, such as `ensemble_size`.

    Returns:
        `LogEstimates`: `means`, `stds`, `findings`, `to_frame()`, `plot_states()`, `plot_innovations()`, `save()`.

    Raises:
        ValueError: states the rule and the value.
    """
    if tuned is not None and filter is not None:
        raise ValueError(
            f"give either a tuned file or a filter, but got both, {short_repr(tuned)} and {short_repr(filter)}"
        )
    log, model, preset = model_of_logs(log, model, preset)
    named = {"preset": preset, "model": model, "sensors": sensors, "columns": columns, "stamps": stamps}
    with _as_file(tuned) as file:
        named = as_tuned(named, file)
        read, offer = read_named(log, **named, clock_offset=clock_offset, dt=dt, name=name_of(log, 0), grid=grid)
        found = estimate_log(read, filter, offer, tuned=file, smoother=smoother, lag=lag, seed=seed, **numbers)
    return LogEstimates(found, findings(found, skip))


@contextmanager
def _as_file(tuned: Any) -> Iterator[str | Path | None]:
    """A tuned file, of a study one that is gone afterwards."""
    if tuned is None or isinstance(tuned, str | Path):
        yield tuned
        return
    if not hasattr(tuned, "save"):
        raise ValueError(f"tuned must be a tuned file or a Study, but got {short_repr(tuned)}")
    with tempfile.TemporaryDirectory() as folder:
        yield copy(tuned).save(Path(folder) / "tuned.json")  # the study itself does not remember this one
