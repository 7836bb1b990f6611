"""Attacks on filters of tensors: random models, filters, forms of missing samples and sizes of batches."""

from __future__ import annotations

from collections import Counter

import numpy as np
import torch

import filters
from filters import StateSpaceModel, run
from tests.fuzz.arithmetic import drawn
from tests.fuzz.python_interface import _line, _until
from tests.models import small, state_space
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import filter_keys

NAMES = ("ekf", "ukf", "ckf", "iekf", "fading", "vb", "schmidt", "ekf-robust", "enkf", "etkf")
STEPS = 6


def models_of_tensors(rng: np.random.Generator, seconds: float) -> str:
    """Models of random expressions: tensors, of one trajectory or some, have the estimates of `run`."""
    counts: Counter = Counter()
    with interpreted():
        for k in _until(seconds):
            name, gate = NAMES[k % len(NAMES)], drawn(rng, 1)[0].text
            names: dict = {"np": np, "math": __import__("math")}
            exec(f"def gate(x, y):\n    return {gate}\n", names)
            try:
                filter_ = small(name, model(names["gate"]))
            except ValueError:  # no value at the prior mean
                counts["without a value"] += 1
                continue
            count = int(rng.integers(1, 4))
            plain, given = samples(rng, count)
            inputs = rng.normal(size=(count, STEPS, 1))
            try:
                found = run(filter_, filter_keys(range(count)), inputs, plain)
            except ValueError:
                counts["refused"] += 1
                continue
            if not np.isfinite(found.means).all() or found.divergences.any():
                counts["restarted"] += 1
                continue
            try:
                tensors = filters.torch(filter_).run(torch.tensor(inputs) if rng.random() < 0.5 else inputs, given)
            except (TypeError, ValueError) as error:  # of what is not traced, and takes no tensor
                assert "tensor" in str(error), (name, gate)
                counts["refused of tensors"] += 1
                continue
            assert tensors.means.dtype is torch.float64
            off = np.abs(tensors.means.numpy() - found.means) / (1.0 + np.abs(found.means))
            assert off.max() < 1e-6, (name, gate, off.max())
            counts["runs"] += 1
    return _line("models of tensors", counts)


def model(gate) -> StateSpaceModel:
    """A stable model with a bounded part that jumps."""

    def transition(x, u, c):
        jumps = np.clip(gate(np.round(x[0]), np.round(x[1])), -1.0, 1.0)
        return 0.9 * x[0] + 0.1 * x[1] + (x[0] > 30.0) * 0.1, 0.8 * x[1] + u[0] + 0.0625 * (jumps == 1.0)

    noise, prior = {"q": [0.1, 0.1], "r": [0.1]}, {"mean": [0.31, 0.17], "cov": [1.0, 1.0]}
    return state_space(transition, lambda x, c: (x[0] + 0.1 * x[1] * x[1],), **noise, **prior, inputs=1)


def samples(rng: np.random.Generator, count: int):
    """Measurements with NaN where they are missing, and the same in a form that a user may have."""
    values = rng.normal(size=(count, STEPS + 1, 1))
    lost = rng.random(values.shape) < 0.3
    plain, objects = np.where(lost, np.nan, values), values.astype(object)
    objects[lost] = None
    masked = np.ma.masked_array(np.where(lost, 1e6, values), lost)
    forms = plain, objects, masked, objects.tolist(), list(masked), torch.tensor(plain)
    return plain, forms[rng.integers(len(forms))]
