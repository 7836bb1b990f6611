"""Optuna's CMA-ES, which stores its state in the study, made safe for studies of unknown origin."""

from __future__ import annotations

import io
import pickle

import optuna
from optuna.trial import FrozenTrial

# The classes in the state of an optimizer of `cmaes`. Any pickle may name any function of any module, and call it.
_OPTIMIZERS = ("CMA", "SepCMA", "CMAwM")
_ARRAYS = {("numpy", "ndarray"), ("numpy", "dtype")} | {
    (f"numpy.{core}.{module}", name)
    for core in ("_core", "core")  # of NumPy 2 and 1
    for module, name in (("multiarray", "_reconstruct"), ("multiarray", "scalar"), ("numeric", "_frombuffer"))
}


class CmaEsSampler(optuna.samplers.CmaEsSampler):
    """`optuna.samplers.CmaEsSampler` that reads only its own state from a journal or database.

    Optuna unpickles the state in a study's trials, so another person's study could run code.
    """

    def _restore_optimizer(self, completed_trials: list[FrozenTrial]):
        key = self._attr_key_optimizer
        for trial in reversed(completed_trials):
            parts = {name: value for name, value in trial.system_attrs.items() if name.startswith(key)}
            if parts:
                return read_state(self._concat_optimizer_attrs(parts))
        return None


def read_state(text: str):
    """The optimizer stored in a study, a pickle as hexadecimal digits.

    Raises:
        ValueError: if it is not such a state, or names anything but an optimizer of `cmaes` and arrays of NumPy.
    """
    try:
        return _Unpickler(io.BytesIO(bytes.fromhex(text))).load()
    except ValueError:
        raise
    except Exception as error:  # a damaged pickle raises nearly anything
        raise ValueError(f"the state of CMA-ES must be whole, but a trial's is not: {error}") from None


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str):
        if (module, name) in _ARRAYS or (module.partition(".")[0] == "cmaes" and name in _OPTIMIZERS):
            return super().find_class(module, name)
        raise ValueError(f"the state of CMA-ES must be that of an optimizer, but a trial's names {module}.{name}")
