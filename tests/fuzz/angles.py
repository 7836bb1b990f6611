"""Attacks on angles: of filters about any heading, and of logs."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np

from filters import FILTERS, run
from filters.bounds import wrapped_variances
from tests.fuzz.python_interface import _line, _until
from tests.models import small
from tests.thruster_env.core.test_angles import data_of, makers, plain_run, rotated
from tests.thruster_env.logs.test_logs_of_angles import model, recorded
from thruster_env.core.angles import difference, on_one_branch, wrapped
from thruster_env.core.compiled import interpreted
from thruster_env.logs.log import at_offset

WITHIN = 2e-8  # of angle filters about another heading


def headings(rng: np.random.Generator, seconds: float) -> str:
    """Every filter about any heading, with any whole turns in its compass: it errs as about 0."""
    counts, names = Counter(), list(FILTERS)
    with interpreted():
        for k in _until(seconds):
            name, heading = names[k % len(names)], rng.uniform(-20.0, 20.0)
            _, plain, make = makers(name)
            keys, inputs, measurements = data_of(plain)
            seen = rotated(measurements, heading, rng.integers(-5, 6, size=measurements.shape[:2]))
            found = run(small(name, make(heading)), keys, inputs, seen)
            off = difference(found.means, plain_run(name).means + [0.0, heading], (False, True))
            assert np.abs(off).max() < WITHIN, (name, heading)
            assert (np.abs(found.means[..., 1]) <= math.pi).all(), (name, heading)
            np.testing.assert_allclose(found.covs, plain_run(name).covs, rtol=WITHIN, atol=WITHIN)
            counts["runs"] += 1
    return _line("headings", counts)


def angles_of_logs(rng: np.random.Generator, seconds: float) -> str:
    """Clock offsets, spreads and bounds of an angle: those of the same motion about another heading."""
    counts, far = Counter(), recorded(0.0)
    for _ in _until(seconds):
        heading, offset = rng.uniform(-math.pi, math.pi), rng.uniform(-0.3, 0.3)
        near = recorded(heading)
        for channel in ("measurement:z", "state:psi"):
            pair = [at_offset(log, channel, offset) for log in (far, near)]
            values = [
                one.references[channel] if channel in one.references else one.measurements[:, 0] for one in pair
            ]
            off = wrapped(values[1] - values[0] - heading)
            assert np.nanmax(np.abs(off)) < 1e-9 and (np.isnan(off) == np.isnan(values[0])).all(), (
                heading,
                offset,
            )
        spreads = [on_one_branch(log.measurements, (True,)).std() for log in (far, near)]
        assert math.isclose(*spreads, rel_tol=1e-6), (heading, spreads)
        variance = np.array([10.0 ** rng.uniform(-20, 20)])
        bound = wrapped_variances(variance, model().shape.state_angles[:1])
        assert 0.0 < bound[0] <= min(variance[0], math.pi**2 / 3), variance
        counts["logs"] += 1
    return _line("angles of logs", counts)
