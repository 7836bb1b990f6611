"""Measured inputs of a model, such as an attitude from an AHRS, appended to the action.

    x_{k+1} = f(x_k, (u_k, a_k)) + w,   z_k

The method `measured_inputs(model)` of an env says which of its channels are such inputs a, and which are the
model's measurements z. A filter predicts with the last measured a, and updates with z.
"""

from __future__ import annotations

import numpy as np

from thruster_env.model.split import Split
from thruster_env.model.state_space import StateSpaceModel

HOOK = "measured_inputs"  # method of an env; what it returns is a `Split`, or None for an ordinary model


def split_of(env, model: StateSpaceModel) -> Split:
    """The split of an env's channels for a model; without the hook all channels are measurements."""
    found = getattr(env.unwrapped, HOOK, lambda model: None)(model)
    return Split((), tuple(range(model.m)), model.m) if found is None else found


class WithMeasuredInputs:
    """A session, or the beliefs of all copies, that takes all measurements and uses some of them as inputs.

    If such a measurement is missing, the last one is used, and zero before the first.

    Attributes:
        used: the inputs of the last step, the action and what was measured.
    """

    used: np.ndarray | None = None

    def __init__(self, runs, split: Split):
        """Take what runs the filter, a session or beliefs; `start` comes next."""
        self._runs, self._inputs, self._measurements = runs, list(split.inputs), list(split.measurements)
        self._last: np.ndarray | None = None

    def __getattr__(self, name: str):
        """The estimate and everything else are those of the session or the beliefs."""
        if name.startswith("_"):
            raise AttributeError(name)
        return getattr(self._runs, name)

    def start(self, *arguments) -> None:
        """Start with a key and a measurement, or copies (which, keys, measurements)."""
        *which, keys, z = arguments
        first = np.nan_to_num(z[..., self._inputs])
        last = first if not which or self._last is None else self._last
        if which:
            last[which[0]] = first[which[0]]
        self._last = last
        self._runs.start(*which, keys, z[..., self._measurements])

    def step(self, u, z: np.ndarray, **idle) -> None:
        """Predict with the action and the inputs measured at the step's beginning, and update."""
        last = self._last
        assert last is not None  # `start` comes first
        self.used = np.concatenate([u, last], axis=-1)
        self._runs.step(self.used, z[..., self._measurements], **idle)
        now = z[..., self._inputs]
        self._last = np.where(np.isnan(now), last, now)
