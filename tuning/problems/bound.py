"""The posterior Cramer-Rao bound of a problem, stored beside the machine code that computes it."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from filters.bounds import gathering_code, posterior_variances, sequences_taken
from thruster_env.core.files import write_whole
from thruster_env.model.state_space import StateSpaceModel
from tuning.problems.data import Data

if TYPE_CHECKING:
    from thruster_env.graphs.loops import Loops

_known: dict[str, tuple[float, ...]] = {}  # of this process


def average_bound(model: StateSpaceModel, data: Data, truths: int = 100) -> np.ndarray:
    """Root of the bound's variances (n,), averaged over the scored steps of all runs.

    A minute's work for a model of many substeps, and the same for each command on a problem: it is kept beside
    the machine code, by everything that it follows from.

    Args:
        model: the model that draws the truth; Q must be positive definite.
        data: its inputs are those of the bound, a sequence a run.
        truths: truths drawn for each sequence.
    """
    inputs = np.ascontiguousarray(data.seen.inputs, dtype=np.float64)
    code, sources = gathering_code(model)
    parts = sources, model.digest, data.first_scored, truths, inputs.shape
    counted = b"" if data.counted is None else np.ascontiguousarray(data.counted).tobytes()
    follows_from = repr(parts).encode() + model.numbers.tobytes() + inputs.tobytes() + counted

    def compute() -> np.ndarray:
        variances = posterior_variances(model, inputs, truths=truths)
        if data.counted is None:
            return np.sqrt(data.pooled(variances))
        sequences = sequences_taken(inputs, truths, model)
        if len(sequences) == 1:  # of all sequences, where they are the same
            variances, sequences = np.repeat(variances, len(inputs), axis=0), np.arange(len(inputs))
        return np.sqrt(data._replace(counted=data.counted[sequences]).pooled(variances))

    return cached_numbers("bound", model.n, follows_from, code, compute)


def cached_numbers(name: str, count: int, follows_from: bytes, code: Loops, compute: Callable) -> np.ndarray:
    """Return the vector compute(), from the cache if it was computed from the same inputs before.

    Numbers lie as JSON where machine code is kept (`thruster_env.graphs.machine_code`), for one kind of
    processor, and go with it. A file that is damaged is as if it were not there, a folder that takes none is as it
    is.

    Args:
        name: first part of the file's name.
        count: n, how many numbers there are.
        follows_from: everything that the numbers follow from, also the sources of what computes them.
        code: what computes them, or most of them.
        compute: a function that returns finite numbers (n,); others are not kept.
    """
    from thruster_env.graphs.machine_code import host

    folder = code.folder
    key = hashlib.sha256(follows_from + (host() if folder else "Python").encode()).hexdigest()
    if key not in _known:
        file = None if folder is None else Path(folder) / f"{name}-{key[:32]}.json"
        numbers = None if file is None else _read(file, count)
        if numbers is None:
            numbers = tuple(np.asarray(compute(), dtype=np.float64).tolist())
            if not np.isfinite(numbers).all():
                return np.array(numbers)
            if file is not None:
                with contextlib.suppress(ValueError):  # nothing can be written there
                    write_whole(file, json.dumps(numbers))
        _known[key] = numbers
    return np.array(_known[key])


def _read(file: Path, count: int) -> tuple[float, ...] | None:
    try:
        numbers = tuple(map(float, json.loads(file.read_bytes())))
    except (OSError, TypeError, ValueError):
        return None
    return numbers if len(numbers) == count and np.isfinite(numbers).all() else None
