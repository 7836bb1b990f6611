"""Numbers that took long to compute, kept beside the machine code that computed them, for the next process."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from thruster_env.core.compiled import CompiledOrPython, made_by
from thruster_env.core.files import write_whole

_known: dict[str, tuple[float, ...]] = {}  # of this process


def cached_numbers(
    name: str, count: int, follows_from: bytes, code: CompiledOrPython, compute: Callable
) -> np.ndarray:
    """Return the vector compute(), from the cache if it was computed from the same inputs before.

    Numbers lie as JSON where the code is compiled to (`thruster_env.core.compiled`), for one kind of
    processor, and go with it. A file that is damaged is as if it were not there, a folder that takes none is as it
    is.

    Args:
        name: first part of the file's name.
        count: n, how many numbers there are.
        follows_from: everything that the numbers follow from, also the sources of what computes them.
        code: what computes them, or most of them.
        compute: a function that returns finite numbers (n,); others are not kept.
    """
    folder = code.folder
    key = hashlib.sha256(follows_from + (made_by() if folder else "Python").encode()).hexdigest()
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
