"""A small recurrent network that learns to estimate from the training seeds of a scenario, and nothing else.

It stands beside the filters in docs/ranking.md, by Python or by name:

    thruster compare --filter ekf --filter pages.ranking_network:for_mismatch --scenario mismatch

which trains it first, in some minutes on one core, and keeps it in out/networks. It needs torch (the extra "rl").
"""

from __future__ import annotations

import io
import time
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import nn

from thruster_env.numerics.files import write_whole
from thruster_env.plants.state_space import StateSpaceModel
from tuning.problems.data import Data
from tuning.problems.problem import Problem
from tuning.problems.seeds import training_seeds
from tuning.thruster.find import find_scenario

UNITS = 32  # of the hidden state
RUNS = 512  # of training: seeds 0 to 511, of which a study has the first 32
WINDOW, UNSCORED = 150, 50  # steps that are unrolled, and those of them in which the hidden state finds its place
BATCH, UPDATES = 64, 2000
KEPT = Path("out") / "networks"
RATE = 4e-3  # of Adam at first; it falls to zero along half a cosine


class Moments(NamedTuple):
    """Mean and standard deviation of each column, by which it is standardised."""

    mean: np.ndarray
    std: np.ndarray

    @classmethod
    def of(cls, values: np.ndarray) -> Moments:
        """Of all rows, NaN left out."""
        rows = values.reshape(-1, values.shape[-1])
        return cls(np.nanmean(rows, axis=0), np.nanstd(rows, axis=0))


class Network(nn.Module):
    """A gated recurrent unit and a linear readout, all standardised.

        h_k = GRU(h_{k-1}, g_k),  x_k = W h_k + V g_k + b,  g_k = (u_{k-1}, z_k, which channels of z_k are there)

    Args:
        inputs: p.
        channels: m.
        states: n.
        units: length of h.

    Source: Cho et al. (2014), "Learning phrase representations using RNN encoder-decoder".
    """

    def __init__(self, inputs: int, channels: int, states: int, units: int = UNITS):
        super().__init__()
        width = inputs + 2 * channels
        self.memory = nn.GRU(width, units, batch_first=True)
        self.read = nn.Linear(units + width, states)

    def forward(self, given: torch.Tensor, hidden: torch.Tensor | None = None):
        """Estimates (B, K, n) of what is given (B, K, p + 2 m), and the last hidden state (1, B, units)."""
        remembered, last = self.memory(given, hidden)
        return self.read(torch.cat([remembered, given], dim=-1)), last


class NetworkEstimator:
    """A trained network as an estimator: means alone, from the inputs and measurements so far.

    Attributes:
        name: for tables.
        network: that was trained.
        moments: of inputs, measurements and states, by which all is standardised.
        seconds: that its training took.
    """

    has_covariance = False

    def __init__(self, name: str, network: Network, moments: tuple[Moments, Moments, Moments], seconds: float):
        """Of a network and the moments of inputs, measurements and states by which all is standardised."""
        self.name, self.seconds = name, seconds
        self.network, self.moments = network, moments
        self._hidden: torch.Tensor | None = None

    def reset(self, key, z):
        """The estimate (n,) after the first measurement; the input before it counts as zero volts."""
        self._hidden = None
        return self.step(np.zeros(len(self.moments[0].mean)), z)

    def step(self, u, z):
        """The estimate (n,) after input u (p,) and measurement z (m,), NaN where missing."""
        given = rows_of(np.asarray(u)[None], np.asarray(z)[None], self.moments)
        with torch.no_grad():
            found, self._hidden = self.network(torch.from_numpy(given)[None], self._hidden)
        return self._in_units(found)[0, 0]

    def run(self, keys, inputs, measurements):
        """The estimates (B, K + 1, n) of many runs at once."""
        with torch.no_grad():
            found, _ = self.network(torch.from_numpy(rows_of(inputs, measurements, self.moments)))
        return self._in_units(found)

    def _in_units(self, found: torch.Tensor) -> np.ndarray:
        mean, std = self.moments[2]
        return mean + std * found.numpy().astype(np.float64)


def rows_of(inputs: np.ndarray, measurements: np.ndarray, moments) -> np.ndarray:
    """What a network is given, (..., K + 1, p + 2 m) in float32: u, z with 0 where missing, whether it is there.

    Inputs (..., K, p) get a zero in front, for there is none before the first measurement.
    """
    of_inputs, of_measurements, _ = moments
    missing = measurements.shape[-2] - inputs.shape[-2]
    inputs = np.concatenate([np.zeros((*inputs.shape[:-2], missing, inputs.shape[-1])), inputs], axis=-2)
    u = (inputs - of_inputs.mean) / of_inputs.std
    z = (measurements - of_measurements.mean) / of_measurements.std
    there = ~np.isnan(z)
    return np.concatenate([u, np.where(there, z, 0.0), there], axis=-1).astype(np.float32)


def trained(
    name: str, data: Data, seed: int, *, units: int = UNITS, updates: int = UPDATES, on_loss: Callable = print
) -> NetworkEstimator:
    """A network that has learnt the states of some data from its inputs and measurements.

    The loss is the mean square error of the standardised states over the last steps of random windows. The same
    seed gives the same network on the same machine: it draws weights and windows, and one thread does the sums.

    Args:
        name: for tables.
        data: with truth; of training seeds alone.
        seed: of the weights and the windows.
        units: of the hidden state.
        updates: of the weights.
        on_loss: told of the loss now and then, in words.
    """
    started, generator = time.perf_counter(), torch.Generator().manual_seed(seed)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        moments = Moments.of(data.inputs), Moments.of(data.measurements), Moments.of(data.states)
        given = torch.from_numpy(rows_of(data.inputs, data.measurements, moments))
        wanted = torch.from_numpy(((data.states - moments[2].mean) / moments[2].std).astype(np.float32))
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network = Network(data.inputs.shape[-1], data.measurements.shape[-1], wanted.shape[-1], units)
        optimiser = torch.optim.Adam(network.parameters(), RATE)
        falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, updates)
        window = min(WINDOW, given.shape[1])
        for i in range(updates):
            runs = torch.randint(len(given), (BATCH,), generator=generator)[:, None]
            starts = torch.randint(given.shape[1] - window + 1, (BATCH,), generator=generator)
            starts[: BATCH // 4] = 0  # the start of a run, too, where the hidden state is right
            steps = starts[:, None] + torch.arange(window)
            found, _ = network(given[runs, steps])
            wrong = (found - wanted[runs, steps]) ** 2
            scored = (steps >= starts[:, None] + UNSCORED) | (starts[:, None] == 0)
            loss = wrong[scored].mean()
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimiser.step()
            falling.step()
            if (i + 1) % max(1, updates // 10) == 0:
                on_loss(f"{name}: {i + 1} updates, root mean square {loss.item() ** 0.5:.4f} standard deviations")
    finally:
        torch.set_num_threads(threads)
    return NetworkEstimator(name, network.eval(), moments, time.perf_counter() - started)


@lru_cache(maxsize=4)
def trained_on(scenario: str, seed: int = 0) -> NetworkEstimator:
    """The network that has learnt from RUNS training seeds of a scenario, or that was kept of it."""
    problem: Problem = find_scenario(scenario)
    kept = KEPT / f"{scenario}-{problem.digest}-{UNITS}-{RUNS}-{UPDATES}-{seed}.npz"
    if kept.exists():
        return _read(kept)
    found = trained(f"gru {UNITS}", problem.data(training_seeds(seed, RUNS)), seed)
    write_whole(kept, _as_bytes(found))
    return found


def _as_bytes(estimator: NetworkEstimator) -> bytes:
    parts = {f"weight {key}": value.numpy() for key, value in estimator.network.state_dict().items()}
    parts |= {f"moments {i}": np.stack(one) for i, one in enumerate(estimator.moments)}
    with io.BytesIO() as file:
        np.savez(file, seconds=estimator.seconds, **parts)
        return file.getvalue()


def _read(path: Path) -> NetworkEstimator:
    with np.load(path, allow_pickle=False) as kept:
        moments = tuple(Moments(*kept[f"moments {i}"]) for i in range(3))
        network = Network(*(len(one.mean) for one in moments))
        weights = {key.removeprefix("weight "): kept[key] for key in kept if key.startswith("weight ")}
        network.load_state_dict({key: torch.from_numpy(value) for key, value in weights.items()})
        return NetworkEstimator(f"gru {UNITS}", network.eval(), moments, float(kept["seconds"]))


def for_mismatch(model: StateSpaceModel) -> NetworkEstimator:
    """The network for `mismatch`, by name; of the filters' model it wants to know nothing."""
    return trained_on("mismatch")


def for_outliers(model: StateSpaceModel) -> NetworkEstimator:
    """The network for `outliers`, by name."""
    return trained_on("outliers")
