"""`Data`: inputs and measurements of many runs and, where they are known, true states and outputs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

FIRST_SCORED_STEP = 50  # RMSE is of steps 50 to 500; the start-up is reported separately


class Data(NamedTuple):
    """What a problem makes for B seeds and K steps; filters update with measurement k + 1 after input k."""

    seeds: tuple[int, ...]
    inputs: np.ndarray  # (B, K, p)
    measurements: np.ndarray  # (B, K + 1, m), NaN where missing
    filter_keys: np.ndarray  # (B, 2), keys of the filters' random numbers
    first_scored: int = FIRST_SCORED_STEP  # the first step that is scored
    states: np.ndarray | None = None  # (B, K + 1, n), the first states of the model; None where there is no truth
    outputs: Mapping[str, np.ndarray] | None = None  # (B, K + 1) each, by symbol; None where there is no truth

    @property
    def scored(self) -> slice:
        """The scored steps."""
        return slice(self.first_scored, None)

    @property
    def known_states(self) -> np.ndarray:
        """The true states, (B, K + 1, n); ValueError where they are unknown."""
        if self.states is None:
            raise ValueError("data must have true states, but got data without truth")
        return self.states

    @property
    def steps(self) -> int:
        """Number K of steps."""
        return self.inputs.shape[1]

    @property
    def beginning(self) -> Data:
        """The steps before the first scored one, without truth."""
        first = self.first_scored
        inputs, measurements = self.inputs[:, : max(first - 1, 0)], self.measurements[:, :first]
        return self._replace(inputs=inputs, measurements=measurements, states=None, outputs=None)

    def slice(self, first: int, last: int) -> Data:
        """The runs from `first` up to, but without, `last`."""
        part = slice(first, last)
        return self._replace(
            seeds=self.seeds[part],
            inputs=self.inputs[part],
            measurements=self.measurements[part],
            filter_keys=self.filter_keys[part],
            states=None if self.states is None else self.states[part],
            outputs=None if self.outputs is None else {name: one[part] for name, one in self.outputs.items()},
        )

    def read_only(self) -> Data:
        """The same data with arrays that cannot be written to, so that they can be shared."""
        arrays = [self.inputs, self.measurements, self.filter_keys, self.states, *(self.outputs or {}).values()]
        for array in arrays:
            if array is not None:
                array.setflags(write=False)
        return self
