"""A step of the extended Kalman filter in C: ours beside CasADi's code of the same equations."""

from __future__ import annotations

import ctypes
import subprocess
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

import numpy as np

from benchmarks.timing import Measure, Row, side_by_side
from filters import make_filter, thruster_model
from filters.c.project import c_filter
from thruster_env.model.state_space import StateSpaceModel

STEPS, GOAL = 20_000, 1.0
RUNS = """\
#include "ours.h"

int peer(const double **given, double **found, long long *whole, double *work, int memory);

void run_ours(const double *u, const double *z, int steps, double *x)
{
    ours filter;

    ours_init(&filter);
    for (int k = 0; k < steps; k++) {
        ours_predict(&filter, u + k);
        ours_update(&filter, z + k);
        x[2 * k] = filter.x[0];
        x[2 * k + 1] = filter.x[1];
    }
}

void run_peer(const double *u, const double *z, int steps, double *x)
{
    ours prior;
    double work[@WORK@ + 1], told[3], last[2][6];
    long long whole[@WHOLE@ + 1];

    ours_init(&prior);
    for (int i = 0; i < 2; i++) {
        last[0][i] = prior.x[i];
    }
    for (int i = 0; i < 4; i++) {
        last[0][2 + i] = prior.P[i];
    }
    for (int k = 0; k < steps; k++) {
        double *from = last[k % 2], *to = last[(k + 1) % 2];
        const double *given[4] = {from, from + 2, u + k, z + k};
        double *found[5] = {to, to + 2, told, told + 1, told + 2};

        peer(given, found, whole, work, 0);
        x[2 * k] = to[0];
        x[2 * k + 1] = to[1];
    }
}
"""


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """Measure a step of the thruster's filter, compiled by gcc with -O2 -march=native."""
    if find_spec("casadi") is None:
        return
    with TemporaryDirectory() as folder:
        ours, peer = measures(Path(folder), seed)
        timing = side_by_side(ours, peer, 5 if quick else 100)
    yield Row("EKF in C: a step", "CasADi's C", timing, ratio_goal=GOAL)


def measures(folder: Path, seed: int) -> tuple[Measure, Measure]:
    """Measures of a step of either filter on the same inputs and measurements; both find the same estimates."""
    model, rng = thruster_model(), np.random.default_rng(seed)
    u, z = rng.uniform(-12, 12, STEPS), rng.normal(0.0, 5.0, STEPS)
    library = _compiled(folder, model)
    estimates: dict[str, np.ndarray] = {}

    def measure(name: str) -> Measure:
        x = estimates[name] = np.zeros((STEPS, model.n))
        arguments = [array.ctypes.data_as(ctypes.c_void_p) for array in (u, z)]
        run = getattr(library, f"run_{name}")

        def measured() -> float:
            begin = perf_counter()
            run(*arguments, STEPS, x.ctypes.data_as(ctypes.c_void_p))
            return (perf_counter() - begin) / STEPS

        return measured

    measures = measure("ours"), measure("peer")
    for warm_up in measures:
        warm_up()
    np.testing.assert_allclose(estimates["ours"], estimates["peer"], rtol=1e-9, atol=1e-9)
    return measures


def _compiled(folder: Path, model: StateSpaceModel) -> Any:
    from casadi import CodeGenerator

    code = c_filter(make_filter("ekf", model), "ours")
    peer = casadi_step(model)
    runs = RUNS.replace("@WORK@", str(peer.sz_w())).replace("@WHOLE@", str(peer.sz_iw()))
    generator = CodeGenerator("peer.c")
    generator.add(peer)
    texts = {"ours.h": code.header, "ours.c": code.source, "runs.c": runs, "peer.c": generator.dump()}
    for name, text in texts.items():
        (folder / name).write_text(text)
    command = "gcc -std=c99 -O2 -march=native -fPIC -shared ours.c peer.c runs.c -lm -o both.so"
    subprocess.run(command.split(), cwd=folder, check=True)
    return ctypes.CDLL(str(folder / "both.so"))


def casadi_step(model: StateSpaceModel) -> Any:
    """A step (x, P, u, z) of the filter as CasADi's function: x, P, innovation, S and log-likelihood.

    The equations are those of `filters.gaussian.extended`, for a model with one channel, which is never missing.
    """
    import casadi

    x, p, u, z = (
        casadi.SX.sym(*declaration)
        for declaration in (("x", model.n), ("P", model.n, model.n), ("u", 1), ("z", 1))
    )
    mean, cov = x, p
    for _ in range(model.substeps):
        state = casadi.SX.sym("state", model.n)
        propagated = casadi.vertcat(*model.transition(tuple(casadi.vertsplit(state)), (u,), model.constants))
        by = casadi.Function("by", [state, u], [propagated, casadi.jacobian(propagated, state)])
        mean, f = by(mean, u)
        cov = f @ cov @ f.T
    cov = cov + model.process_noise_cov
    state = casadi.SX.sym("state", model.n)
    observed = casadi.vertcat(*model.observe(tuple(casadi.vertsplit(state)), model.constants))
    expected, h = casadi.Function("seen", [state], [observed, casadi.jacobian(observed, state)])(mean)
    v, s = z - expected, h @ cov @ h.T + model.measurement_noise_cov
    k = cov @ h.T / s
    a = casadi.SX.eye(model.n) - k @ h
    level = -0.5 * (v * v / s + casadi.log(2 * np.pi * s))
    cov = a @ cov @ a.T + k @ model.measurement_noise_cov @ k.T
    return casadi.Function("peer", [x, p, u, z], [mean + k @ v, cov, v, s, level], {"cse": True})
