"""A filter over a log on its own stamps: by the clock, as `filter.live()` goes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from filters.engine.batch import Estimates, estimates_of
from filters.estimators.foreign import ForeignFilter
from filters.filter import Filter
from filters.live import Live
from filters.restarts import Restarts
from thruster_env.logs.log import Log
from thruster_env.model.continuous import ContinuousModel
from thruster_env.model.state_space import StateSpaceModel


def by_the_clock(
    filter_: Filter,
    key: np.ndarray,
    log: Log,
    noise: Callable[[float], np.ndarray] | None,
) -> tuple[Estimates, Restarts | None]:
    """What `filters.run` gives of one trajectory, of a log on its own stamps, and its restarts.

    Args:
        filter_: of a model whose sample time is one of its constants.
        key: random key (2,).
        log: on its own stamps.
        noise: Q by the length of a step [s]; None for one in proportion to it.

    Raises:
        ValueError: for a model of one sample time, or another package's estimator.
    """
    if isinstance(filter_, ForeignFilter):
        raise ValueError(f"a log on its own stamps must be for a filter of ours, but got {filter_.name!r}")
    live = Live(filter_, noise=noise, resolution=log.resolution)
    times, z = log.times.tolist(), log.measurements
    live.start(0.0, z[0], key)
    rows = [live.told()]
    for k, u in enumerate(log.inputs, 1):
        live.predict_to(times[k], u)
        live.update(times[k], None, z[k])
        rows.append(live.told())
    return estimates_of(rows, live.divergences), live.restarts


def noise_by_rates(
    plant: ContinuousModel | None, model: StateSpaceModel, dt: float
) -> Callable[[float], np.ndarray] | None:
    """Q by the length of a step [s], of a plant in continuous time whose noise at dt is still the model's.

    Of a model with another Q, as tuning gives, it is None: in proportion to the length.
    """
    if plant is None or not np.array_equal(plant.noise(dt), model.process_noise_cov):
        return None
    return plant.noise
