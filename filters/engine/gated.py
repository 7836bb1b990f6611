"""Sessions that leave out measurements too far from what the filter expects."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from filters.engine.compile import PREDICT, UPDATE
from filters.engine.session import Session
from thruster_env.core.checks import positive

if TYPE_CHECKING:
    from filters.filter import Filter


class GatedSession(Session):
    """A session whose steps leave out channels with |v_i| > gate sqrt(S_ii), as if they were missing.

    Attributes:
        rejected: how often each channel was left out so far, (m,).

    Source: Bar-Shalom, Li, Kirubarajan (2001), Estimation with Applications to Tracking and Navigation, 3.6.
    """

    def __init__(self, filter_: Filter, gate: float):
        """Allocate the memory of a filter; `gate` is in standard deviations."""
        super().__init__(filter_)
        self.gate = positive("gate", gate)
        if not filter_.has_covariance:
            raise ValueError(f"a gate needs a filter with a covariance, but {filter_.name!r} has none")
        self.rejected = np.zeros(len(self.innovation), dtype=int)
        self._kept = tuple(part.copy() for part in self._memory)

    def step(self, u, z) -> None:
        """Predict with input u (p,), then update with the channels of z (m,) that are within the gate."""
        self._set(u, z)
        self.divergences = self._operate(*self._given, PREDICT)
        for kept, part in zip(self._kept, self._memory, strict=True):
            kept[...] = part
        self.divergences = self._operate(*self._given, UPDATE)
        far = np.abs(self.innovation) > self.gate * np.sqrt(self.innovation_cov.diagonal())
        if far.any():
            for kept, part in zip(self._kept, self._memory, strict=True):
                part[...] = kept
            self._z[far] = np.nan
            self.rejected += far
            self.divergences = self._operate(*self._given, UPDATE)

    def __getstate__(self) -> tuple:
        """The state of a session, the gate, and the counts."""
        return super().__getstate__(), self.gate, self.rejected

    def __setstate__(self, state: tuple) -> None:
        """Continue from the belief."""
        of_session, gate, rejected = state
        filter_, divergences, arrays = of_session
        GatedSession.__init__(self, filter_, gate)
        self._go_on(divergences, arrays)
        self.rejected[:] = rejected
