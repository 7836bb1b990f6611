"""`python -m benchmarks.gpu`: filters on tensors on a GPU, beside JAX's dynamax and cuthbert, and torch-kf.

Each row is one program for one filter, size, precision and direction: the median time of several runs after a
warm-up, which waits for the device. Log-likelihoods are compared with those of `filters.run` in float64. All
programs return means, covariances and log-likelihoods; with gradients, also the gradient of the summed negative
log-likelihood along Q and R. JAX keeps the memory that it had, so on one card

    python -m benchmarks.gpu --out build/gpu --programs eager,compiled,torch-kf,"machine code" --processes 12
    python -m benchmarks.gpu --out build/gpu --programs dynamax,cuthbert

measures in two processes, and `--table build/gpu/gpu.json` prints the tables of docs/speed.md. Nothing of it is
imported by the package, and peers may be missing.
"""

from __future__ import annotations

import argparse
import gc
import json
import multiprocessing
import os
import platform
from collections.abc import Callable, Iterator
from functools import cache
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from time import perf_counter, time
from typing import Any, NamedTuple

import numpy as np

import filters
from filters import make_filter, run, thruster_model
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import episode_keys, filter_keys
from thruster_env.model.affine import affine_model
from thruster_env.model.simulate import simulate

STEPS = 10  # of each trajectory, after the update of the prior
DISTINCT = 16  # trajectories; a batch repeats them
SIZES = (1_000, 10_000, 100_000, 1_000_000)
MEMBERS = 100  # of the ensembles of a batch
KINDS = ("kf", "ekf", "ukf", "enkf")
PEERS = {"kf": ("dynamax", "torch-kf"), "ekf": ("dynamax",), "ukf": ("dynamax",), "enkf": ("cuthbert",)}
PACKAGES = ("torch", "triton", "jax", "dynamax", "cuthbert", "torch-kf", "numpy", "numba")


class Case(NamedTuple):
    """What one row measures.

    Attributes:
        kind: of the filter.
        program: "machine code", "eager", "compiled", or the name of a peer.
        batch: trajectories.
        members: of each ensemble; 0 for a filter without.
        single: whether in float32.
        gradient: whether with the gradient along Q and R.
        device: "cpu" or "cuda"; machine code runs on all cores of the processor.
    """

    kind: str
    program: str
    batch: int
    members: int
    single: bool
    gradient: bool
    device: str


class Data(NamedTuple):
    """Some trajectories (DISTINCT, ...) of a filter's model and their log-likelihoods (DISTINCT,)."""

    inputs: np.ndarray
    measurements: np.ndarray
    log_likelihoods: np.ndarray

    def batch(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Inputs (count, K, p) and measurements (count, K + 1, m)."""
        rows = np.arange(count) % DISTINCT
        return self.inputs[rows], self.measurements[rows]


def plane_model():
    """Position and velocity in a plane, of which the position is measured: four states without an input."""
    dt, eye = 0.1, np.eye(2)
    a = np.block([[eye, dt * eye], [0.0 * eye, eye]])
    return affine_model(
        a=a,
        b=np.zeros((4, 1)),
        c=np.eye(2, 4),
        process_noise_cov=[1e-3, 1e-3, 0.1, 0.1],
        measurement_noise_cov=[0.2, 0.3],
        prior_mean=[0.0, 0.0, 1.0, -1.0],
        prior_cov=[1.0, 1.0, 0.5, 0.5],
    )


@cache
def filter_of(kind: str, members: int):
    """The filter: "kf" on `plane_model`, the others on the thruster, of two states and two Runge-Kutta steps."""
    if kind == "kf":
        return make_filter(kind, plane_model())
    return make_filter(kind, thruster_model(), **({"ensemble_size": members} if members else {}))


@cache
def data_of(kind: str) -> Data:
    """Trajectories of the filter's own model; an ensemble is compared with the UKF's log-likelihoods."""
    filter_ = filter_of("ukf" if kind == "enkf" else kind, 0)
    voltages = 8.0 + 4.0 * np.random.default_rng(1).random((DISTINCT, 1, filter_.model.inputs))
    inputs = np.tile(voltages, (1, STEPS, 1))
    with interpreted():
        z = simulate(filter_.model, episode_keys(range(DISTINCT)), inputs).measurements
        estimates = run(filter_, None, inputs, z)
    return Data(inputs, z, estimates.log_likelihoods.sum(axis=1))


def machine_code(case: Case) -> Callable:
    """`filters.run` on all cores, or `log_likelihood` of tensors with its gradient."""
    filter_, (inputs, z) = filter_of(case.kind, case.members), data_of(case.kind).batch(case.batch)
    if case.gradient:
        return _of_torch(
            filters.torch(filter_), inputs, z, lambda tensors, u, z: tensors.log_likelihood(u, z), True
        )
    keys = filter_keys(range(DISTINCT))[np.arange(case.batch) % DISTINCT]
    return lambda: run(filter_, keys, inputs, z).log_likelihoods[:DISTINCT].sum(axis=1)


def tensors(case: Case) -> Callable:
    """`filters.torch`, eager or compiled."""
    import torch

    arguments = {"dtype": torch.float32 if case.single else torch.float64, "device": case.device}
    ours = filters.torch(filter_of(case.kind, case.members), compiled=case.program == "compiled", **arguments)
    inputs, z = (torch.as_tensor(part, **arguments) for part in data_of(case.kind).batch(case.batch))
    keys = filter_keys(range(DISTINCT))[np.arange(case.batch) % DISTINCT] if case.members else None

    def log_likelihoods(tensors, u, z):
        return tensors.run(u, z, keys).log_likelihoods.sum(-1)

    return _of_torch(ours, inputs, z, log_likelihoods, case.gradient)


def _of_torch(ours: Any, inputs: Any, z: Any, function: Callable, gradient: bool) -> Callable:
    """Run function(tensors, u, z), which returns log-likelihoods (B,), with their gradient if asked."""
    import torch

    def call():
        if not gradient:
            with torch.no_grad():
                values = function(ours, inputs, z)
        else:
            q, r = (cov.clone().requires_grad_() for cov in (ours.process_noise_cov, ours.measurement_noise_cov))
            values = function(ours.replace(process_noise_cov=q, measurement_noise_cov=r), inputs, z)
            torch.autograd.grad(-values.sum(), (q, r))
        return values[:DISTINCT].detach().cpu().double().numpy()  # waits for the device

    return call


def torch_kf(case: Case) -> Callable:
    """The Kalman filter of torch-kf, which has no input."""
    import torch
    from torch_kf import GaussianState, KalmanFilter

    model = filter_of("kf", 0).model
    a, _, _, c, _ = model.matrices()
    dtype = torch.float32 if case.single else torch.float64
    arrays = a, c, model.process_noise_cov, model.measurement_noise_cov, model.prior_mean[:, None], model.prior_cov
    a, c, q, r, mean, cov = (torch.as_tensor(np.array(part), dtype=dtype, device=case.device) for part in arrays)
    z = torch.as_tensor(data_of("kf").batch(case.batch)[1], dtype=dtype, device=case.device)
    rows = z.movedim(-2, 0)[..., None].contiguous().unbind()

    def log_likelihoods(q, r):
        filter_ = KalmanFilter(a, c, q, r)
        state = GaussianState(mean.expand(case.batch, -1, -1), cov.expand(case.batch, -1, -1))
        total, states = 0.0, []
        for k, row in enumerate(rows):
            state = filter_.predict(state) if k else state
            projected = filter_.project(state)
            total = total + projected.log_likelihood(row)
            state = filter_.update(state, row, projection=projected)
            states.append((state.mean, state.covariance))
        torch.stack([state[0] for state in states]), torch.stack([state[1] for state in states])
        return total

    def call():
        if not case.gradient:
            with torch.no_grad():
                values = log_likelihoods(q, r)
        else:
            leaves = q.clone().requires_grad_(), r.clone().requires_grad_()
            values = log_likelihoods(*leaves)
            torch.autograd.grad(-values.sum(), leaves)
        return values[:DISTINCT].detach().cpu().double().numpy()

    return call


def _jax(case: Case) -> Any:
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    import jax

    jax.config.update("jax_enable_x64", not case.single)
    jax.config.update("jax_default_matmul_precision", "highest")  # not the GPU's shortened products
    if case.device == "cpu":
        jax.config.update("jax_platforms", "cpu")
    return jax


def _jax_model(case: Case) -> tuple[Any, Any, Any, list]:
    """JAX, functions f(x, u) over a step and h(x) of arrays, and m0, P0, Q, R of the filter's model."""
    jax = _jax(case)
    from thruster_env.thruster import dynamics
    from thruster_env.thruster.model import observe, transition

    jnp, model = jax.numpy, filter_of(case.kind, case.members).model
    c = model.given_constants

    def traced(function, *arguments):
        before = dynamics._REST  # keeps a divisor from zero, which float32 rounds it to
        dynamics._REST = float(np.finfo(np.float32).tiny) if case.single else before
        try:
            return jnp.stack(function(*arguments, c))
        finally:
            dynamics._REST = before

    def f(x, u):
        for _ in range(model.substeps):
            x = traced(transition, (x[0], x[1]), (u[0],))
        return x

    def h(x, u=None):
        return traced(observe, (x[0], x[1]))

    covs = model.process_noise_cov, model.measurement_noise_cov
    numbers = [
        jnp.asarray(np.array(part), dtype=_float(case)) for part in (model.prior_mean, model.prior_cov, *covs)
    ]
    return jax, f, h, numbers


def _float(case: Case) -> type:
    return np.float32 if case.single else np.float64


def dynamax(case: Case) -> Callable:
    """The Kalman, extended and unscented filter of dynamax, under jit and vmap."""
    jax, f, h, (mean, cov, q, r) = _jax_model(case)
    jnp = jax.numpy
    from dynamax.linear_gaussian_ssm import lgssm_filter
    from dynamax.linear_gaussian_ssm.inference import make_lgssm_params
    from dynamax.nonlinear_gaussian_ssm import (
        ParamsNLGSSM,
        UKFHyperParams,
        extended_kalman_filter,
        unscented_kalman_filter,
    )

    filter_ = filter_of(case.kind, 0)
    inputs, z = (jnp.asarray(part, dtype=_float(case)) for part in data_of(case.kind).batch(case.batch))
    rows = jnp.concatenate([inputs[:, :1], inputs], axis=1)  # a measurement's row has the input that led to it
    fields = {"output_fields": ["filtered_means", "filtered_covariances", "marginal_loglik"]}

    def filtered(q, r, u, z):
        if case.kind == "kf":
            a, b, offset, c, shift = (jnp.asarray(part, dtype=_float(case)) for part in filter_.model.matrices())
            params = make_lgssm_params(mean, cov, a, q, c, r, offset, b, shift)
            return lgssm_filter(params, z, u)
        params = ParamsNLGSSM(mean, cov, f, q, h, r)
        if case.kind == "ekf":
            return extended_kalman_filter(params, z, inputs=u, **fields)
        points = UKFHyperParams(filter_.alpha, filter_.beta, filter_.kappa)
        return unscented_kalman_filter(params, z, points, inputs=u, **fields)

    def score(posterior):
        values = posterior.marginal_loglik
        return values[..., -1] if values.ndim > 1 else values  # of the nonlinear filters, sums up to each step

    return _of_jax(jax, filtered, score, (q, r), (rows, z), case.gradient)


def cuthbert(case: Case) -> Callable:
    """The ensemble Kalman filter of cuthbert, under jit and vmap, with random numbers of its own."""
    jax, f, h, (mean, cov, q, r) = _jax_model(case)
    jnp = jax.numpy
    from cuthbert import filter as run_filter
    from cuthbert.ensemble_kalman import ensemble_kalman_filter

    inputs, z = (jnp.asarray(part, dtype=_float(case)) for part in data_of(case.kind).batch(case.batch))
    rows = jnp.concatenate([inputs[:, :1], inputs], axis=1)
    first = jnp.zeros(rows.shape[:2], dtype=bool).at[:, 0].set(True)  # there is no prediction before it
    keys = jax.random.split(jax.random.key(0), case.batch)
    prior_root = jnp.linalg.cholesky(cov)

    def filtered(q, r, u, z, first, key):
        q_root, r_root = jnp.linalg.cholesky(q), jnp.linalg.cholesky(r)

        def normals(key, size):
            return jax.random.normal(key, (size,), dtype=_float(case))

        def dynamics(row):
            u, _, first = row
            return lambda x, key: jnp.where(first, x, f(x, u) + q_root @ normals(key, len(q)))

        ensemble = ensemble_kalman_filter.build_filter(
            lambda key: mean + prior_root @ normals(key, len(mean)),
            dynamics,
            lambda row: (h, r_root, row[1]),
            case.members,
        )
        begin, later = jax.random.split(key)
        states = run_filter(ensemble, (u, z, first), ensemble.init_prepare(key=begin), key=later)
        members = states.ensemble  # (K + 2, N, n)
        centred = members - members.mean(axis=1, keepdims=True)
        covs = jnp.einsum("kni,knj->kij", centred, centred) / (case.members - 1)
        return members.mean(axis=1), covs, states.log_normalizing_constant[-1]

    data = rows, z, first, keys
    return _of_jax(jax, filtered, lambda results: results[-1], (q, r), data, case.gradient)


def _of_jax(jax: Any, filtered: Callable, score: Callable, covs: tuple, data: tuple, gradient: bool) -> Callable:
    """Run filtered(q, r, ...) of each trajectory, compiled, with the gradient along Q and R if asked."""

    def batch(q, r, *data):
        return jax.vmap(lambda *row: filtered(q, r, *row))(*data)

    def loss(q, r, *data):
        results = batch(q, r, *data)
        return -score(results).sum(), results

    program = jax.jit(jax.value_and_grad(loss, (0, 1), has_aux=True) if gradient else batch)

    def call():
        results = jax.block_until_ready(program(*covs, *data))
        return np.asarray(score(results[0][1] if gradient else results)[:DISTINCT], dtype=np.float64)

    return call


PROGRAMS: dict[str, Callable[[Case], Callable]] = {
    "machine code": machine_code,
    "eager": tensors,
    "compiled": tensors,
    "dynamax": dynamax,
    "cuthbert": cuthbert,
    "torch-kf": torch_kf,
}


# Measuring


def cases(device: str, quick: bool) -> Iterator[Case]:
    """What is measured, the most informative first, for time may run out."""
    if quick:
        for kind in KINDS:
            for gradient in (False, True):
                yield from _of_size(kind, 32, gradient, (False, True), device)
        return
    for size, singles, gradients in (
        (SIZES[3], (False, True), (False, True)),
        (SIZES[0], (False,), (False, True)),
        (SIZES[2], (False,), (False,)),
    ):
        for gradient in gradients:
            for kind in KINDS:
                yield from _of_size(kind, size, gradient, singles, device)
    for members in SIZES[::-1]:
        for single in (False, True):
            for program in ("eager", "compiled", "cuthbert"):
                if program == "eager" or members in (SIZES[3], SIZES[1]) and not single:
                    yield Case("enkf", program, 1, members, single, False, device)
        yield Case("enkf", "machine code", 1, members, False, False, "cpu")
    for kind in KINDS:
        for case in _of_size(kind, SIZES[1], False, (False,), device):
            if case.program in ("eager", "machine code", "torch-kf"):
                yield case


def _of_size(kind: str, size: int, gradient: bool, singles: tuple[bool, ...], device: str) -> Iterator[Case]:
    members = MEMBERS if kind == "enkf" else 0
    batch = max(size // 10, 32) if members else size
    for single in singles:
        for program in ("eager", "compiled", *PEERS[kind]):
            if program == "compiled" and gradient and members and (single or size < SIZES[1]):
                continue  # some minutes of compilation
            yield Case(kind, program, batch, members, single, gradient, device)
    if not (members and gradient):
        yield Case(kind, "machine code", batch, members, False, gradient, "cpu")


class Prepared(NamedTuple):
    """A case that has run once.

    Attributes:
        call: runs it once more; None if it cannot.
        row: its row without times.
    """

    call: Callable | None
    row: dict[str, Any]


def prepared(case: Case) -> Prepared:
    """Run a case for the first time, or state why it cannot run."""
    row: dict[str, Any] = {**case._asdict(), "steps": STEPS}
    if case.program in ("dynamax", "cuthbert", "torch-kf"):
        if find_spec(case.program.replace("-", "_")) is None:
            return Prepared(None, row | {"skipped": f"{case.program} is not installed"})
        if case.program != "torch-kf":
            _cached_jax(case)
    try:
        begin = perf_counter()
        call = PROGRAMS[case.program](case)
        values = call()
        first = perf_counter() - begin
    except Exception as error:  # a row that fails says so, and the others go on
        return Prepared(None, row | {"skipped": _reason(error)})
    expected = data_of(case.kind).log_likelihoods[: len(values)]
    deviation = float(np.max(np.abs(values - expected)) / np.max(np.abs(expected)))
    return Prepared(call, row | {"first_seconds": first, "deviation": deviation})


def timed(case: Prepared, seconds: float = 0.6, repetitions: int = 7) -> dict[str, Any]:
    """A row with the median time of some runs, after one more that does not count."""
    call, row = case
    if call is None:
        return row
    times: list[float] = []
    try:
        call()
        while len(times) < repetitions and (len(times) < 3 or sum(times) < seconds):
            begin = perf_counter()
            call()
            times.append(perf_counter() - begin)
    except Exception as error:
        return row | {"skipped": _reason(error)}
    steps = row["batch"] * STEPS * max(row["members"], 1)
    return row | {"seconds": median(times), "steps_per_second": steps / median(times)}


def _reason(error: Exception) -> str:
    if any(part in f"{type(error).__name__} {error}" for part in ("OutOfMemory", "RESOURCE_EXHAUSTED")):
        return "out of memory"
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0][:120]}"


def released() -> None:
    """Give memory back that the last row used."""
    gc.collect()
    if find_spec("torch") is not None:
        import torch

        if torch.cuda.is_available():
            torch.cuda.empty_cache()


def _cached_jax(case: Case) -> None:
    """JAX, with programs that processes compiled before in the cache on the disk."""
    jax = _jax(case)
    jax.config.update("jax_compilation_cache_dir", os.environ.get("JAX_COMPILATION_CACHE_DIR", "build/jax_cache"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def _work(wanted: list[Case], until: float, connection: Any) -> None:
    """Compile cases until a time, say so, wait, and then time those of torch, which cannot leave the process."""
    import torch

    torch.set_num_threads(1)
    ready = []
    for case in wanted:
        if time() < until:
            case_ready = prepared(case)
            print(*case, case_ready.row.get("skipped") or f"{case_ready.row['first_seconds']:.0f} s", flush=True)
            ready.append(case_ready if case.program == "compiled" else None)
        elif case.program == "compiled":
            ready.append(Prepared(None, {**case._asdict(), "steps": STEPS, "skipped": "not compiled in time"}))
        released()
    connection.send("ready")
    connection.recv()
    connection.send([timed(case) for case in ready if case is not None])


def _compiled_rows(wanted: list[Case], processes: int, seconds: float) -> list[dict[str, Any]]:
    """Rows of the compiled cases, compiled in several processes and timed one after another."""
    context, workers = multiprocessing.get_context("spawn"), []
    ours = [case for case in wanted if case.program == "compiled"]
    peers = [case for case in wanted if case.program != "compiled"]
    of_peers = max(processes // 4, 1)
    shares = [peers[k::of_peers] for k in range(of_peers)]
    shares += [ours[k :: processes - of_peers] for k in range(processes - of_peers)]
    for share in shares:
        mine, theirs = context.Pipe()
        process = context.Process(target=_work, args=(share, time() + seconds, theirs), daemon=True)
        process.start()
        theirs.close()
        workers.append((process, mine))
    latest = time() + 1.5 * seconds
    answered = [mine for _, mine in workers if _received(mine, latest - time()) is not None]
    rows: list[dict[str, Any]] = []
    for mine in answered:
        mine.send("go")
        rows += _received(mine, 60.0) or []
    for process, _ in workers:
        process.terminate()
    return rows


def _received(connection: Any, seconds: float) -> Any:
    """What a process sends within so many seconds; None if it does not, or has ended."""
    try:
        return connection.recv() if connection.poll(max(seconds, 0.0)) else None
    except EOFError:
        return None


def measure(wanted: list[Case], seconds: float, processes: int) -> Iterator[dict[str, Any]]:
    """Rows of cases, for so many seconds; with several processes these compile beforehand."""
    begin = perf_counter()
    if processes:
        slow = [case for case in wanted if case.program in ("compiled", "dynamax", "cuthbert")]
        slow.sort(key=lambda case: (case.program != "compiled", not case.gradient))
        yield from _compiled_rows(slow, processes, 0.4 * seconds)
        wanted = [case for case in wanted if case.program != "compiled"]
        print(f"compiled and timed after {perf_counter() - begin:.0f} s", flush=True)
    for case in wanted:
        if perf_counter() - begin > seconds:
            yield {**case._asdict(), "steps": STEPS, "skipped": "time ran out"}
            continue
        yield timed(prepared(case))
        released()


def facts(device: str) -> dict[str, Any]:
    """The card, the processor's cores, and versions."""
    import torch

    return {
        "card": torch.cuda.get_device_name() if device == "cuda" else "none",
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "python": platform.python_version(),
        **{name: version(name) for name in PACKAGES if find_spec(name.replace("-", "_"))},
    }


# The table of docs/speed.md


def main(arguments: list[str] | None = None) -> None:
    """Measure and write JSON, or print the Markdown table of such a file."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gpu", description=__doc__)
    parser.add_argument("--out", type=Path, help="folder for gpu.json")
    parser.add_argument("--quick", action="store_true", help="small sizes only, to see that all runs")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cuda")
    parser.add_argument("--seconds", type=float, default=420.0, help="after which no further row is measured")
    parser.add_argument("--processes", type=int, default=0, help="that compile beforehand")
    parser.add_argument(
        "--programs",
        metavar="NAMES",
        default=",".join(PROGRAMS),
        help="to measure; JAX's separately, for it keeps memory",
    )
    parser.add_argument("--table", type=Path, metavar="FILE", help="print the table of such a gpu.json")
    chosen = parser.parse_args(arguments)
    if chosen.table:
        from benchmarks.gpu_table import page_section

        print(page_section(json.loads(chosen.table.read_text())))
        return
    if chosen.out is None:
        parser.error("--out must be a folder, but got none")
    chosen.out.mkdir(parents=True, exist_ok=True)
    target, programs = chosen.out / "gpu.json", chosen.programs.split(",")
    before = json.loads(target.read_text())["rows"] if target.exists() else []
    rows = [row for row in before if row["program"] not in programs]
    wanted = [case for case in cases(chosen.device, chosen.quick) if case.program in programs]
    for row in measure(wanted, chosen.seconds, chosen.processes):
        rows.append(row)
        result = row.get("skipped") or f"{row['steps_per_second']:.3g}/s, off by {row['deviation']:.1g}"
        precision = "float32" if row["single"] else "float64"
        direction = "gradient" if row["gradient"] else "forward"
        what = row["kind"], row["program"], row["batch"], row["members"], precision, direction
        print(*what, result, f"first {row.get('first_seconds', 0.0):.1f} s", flush=True)
        content = {"machine": facts(chosen.device), "rows": rows}
        target.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
