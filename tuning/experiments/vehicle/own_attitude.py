"""An extended Kalman filter of six velocities that takes roll and pitch from its own dead reckoning."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

from filters.engine.belief import Kernels, memory_places
from filters.gaussian.extended import ExtendedKalmanFilter
from filters.pages.kernels import page_kernels
from thruster_env.core.compiled import inlined
from thruster_env.model.shape import Functions, Shape, constants_reader, number_places
from tuning.experiments.vehicle.pose import next_attitude

KEPT = 5  # roll, pitch and the last p, q, r


@lru_cache(maxsize=64)
def own_attitude_kernels(functions: Functions, shape: Shape) -> Kernels:
    """Kernels of the extended filter for a model whose last two inputs are roll and pitch."""
    n, m, inner = shape.n, shape.m, page_kernels(ExtendedKalmanFilter.page, functions, shape)
    places, source, constants = memory_places(n, m), number_places(n, m), constants_reader(shape)
    start_filter, predict_filter, update_filter = inner.start, inner.predict, inner.update
    mean, step, kept, substeps = places.mean, places.step, places.extras, source.substeps
    roll, pitch = shape.inputs - 2, shape.inputs - 1

    @inlined
    def start(memory, numbers, size):
        start_filter(memory, numbers, size)
        for i in range(KEPT):
            memory[0][kept + i] = 0.0

    @inlined
    def predict(memory, u, numbers, size):
        row, _, _ = memory
        u[roll] = row[kept]
        u[pitch] = row[kept + 1]
        predict_filter(memory, u, numbers, size)

    @inlined
    def update(memory, z, numbers, size):
        row, _, _ = memory
        update_filter(memory, z, numbers, size)
        after = row[mean + 3], row[mean + 4], row[mean + 5]
        if row[step] > 0.0:
            before = row[kept + 2], row[kept + 3], row[kept + 4]
            dt = constants(numbers).substep * numbers[substeps]
            row[kept], row[kept + 1] = next_attitude(row[kept], row[kept + 1], before, after, dt)
        row[kept + 2], row[kept + 3], row[kept + 4] = after

    return inner._replace(start=start, predict=predict, update=update, extras=KEPT, vectors=())


@dataclass(frozen=True, kw_only=True, eq=False)
class OwnAttitudeKalmanFilter(ExtendedKalmanFilter):
    """The extended Kalman filter of u, v, w, p, q, r with its own attitude.

        predict: with roll and pitch as inputs, integrated from its estimates of p, q, r
        update:  that of `ExtendedKalmanFilter`, then roll and pitch a step further by Heun's rule

    It treats the attitude as known, so its covariance is too small. The given roll and pitch, the last two inputs
    of the model `auv_model(states="velocities")`, are overwritten. The vehicle starts level.
    """

    name: ClassVar[str] = "own attitude"

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        model = self.kernel_model
        return own_attitude_kernels(model.functions, model.shape)
