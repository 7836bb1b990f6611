"""How far single precision moves the estimates of a filter in C: its programs, run as Python with float32."""

from __future__ import annotations

from math import prod

import numpy as np

from filters.c.programs import FilterPrograms
from filters.engine.batch import run
from filters.filter import Filter
from thruster_env.core.angles import difference, wrapped_where
from thruster_env.core.streams import (
    FILTER_MEASUREMENT,
    FILTER_PRIOR,
    FILTER_PROCESS,
    GROUP,
    fill_normals,
    filter_keys,
)
from thruster_env.graphs.precision import as_single
from thruster_env.graphs.programs import Program, work_names
from thruster_env.model.layout import LANES, padded


class _Single:
    """In place of `float` in a program's text."""

    @staticmethod
    def fromhex(text: str) -> np.float32:
        return np.float32(as_single(float.fromhex(text)))


def single_error(filter_: Filter, programs: FilterPrograms, inputs: np.ndarray, z: np.ndarray) -> float:
    """The largest difference between estimates in single and double precision, in standard deviations.

    Args:
        filter_: the filter.
        programs: what it is made of.
        inputs: u of a run, (K, p).
        z: its measurements, (K + 1, m).
    """
    key = filter_keys([0])
    exact = run(filter_, key, inputs[None], z[None])
    stds = np.sqrt(np.einsum("kii->ki", exact.covs[0]))
    with np.errstate(all="ignore"):
        found = _means(programs, key[0], inputs.astype(np.float32), z.astype(np.float32))
    off = abs(difference(found, exact.means[0], programs.model.shape.state_angles))
    return float(np.max(off / np.where(stds > 0, stds, 1.0)))


def _means(programs: FilterPrograms, key: np.ndarray, inputs: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Means of a run, (K + 1, n), without restarts."""
    model, n, m = programs.model, programs.model.n, programs.model.m
    start, begin, advance, settle, update, _ = map(_compiled, programs.all)
    names = {**work_names(), "float": _Single, "X": np.zeros(programs.flying, np.float32)}
    names |= {"P": model.prior_cov.ravel().astype(np.float32), "S": np.zeros(m * m, np.float32)}
    names |= {name: np.zeros(prod(shape), np.float32) for name, shape in programs.kept.items()}
    x = names["x"] = wrapped_where(model.prior_mean, model.shape.state_angles).astype(np.float32)
    names["innovation"], found = np.zeros(m, np.float32), []
    size, width = programs.members, padded(programs.members, LANES)
    names |= {"size": size, "table": np.zeros((n, size), np.float32)}

    def draw(stream: int, step: int, rows: int) -> None:
        normals = np.empty(padded(rows * width, GROUP))
        fill_normals(normals, rows * width * (size > 0), step, stream, *key)
        names["draws"] = normals[: rows * width].reshape(rows, width)[:, :size].astype(np.float32)

    draw(FILTER_PRIOR, 0, n)
    exec(start, names)
    for k in range(len(z)):
        if k > 0:
            names["u"] = inputs[k - 1]
            exec(begin, names)
            for _ in range(model.substeps):
                for point in names["X"].reshape(-1, n) if programs.points else [x]:
                    exec(advance, names | {"x": point})
            draw(FILTER_PROCESS, k, n)
            exec(settle, names)
        names["z"] = z[k]
        draw(FILTER_MEASUREMENT, k, m)
        exec(update, names)
        found.append(x.astype(np.float64))
    return np.array(found)


def _compiled(program: Program):
    text = "\n".join(program.text).replace("filter->", "")
    return compile(text, "<a filter in single precision>", "exec")
