"""Attacks on identification: runs that begin anywhere, and free effects that are not in them.

Each takes a generator and how long it may take [s], and returns a line with what it counted.
"""

from __future__ import annotations

import time

import numpy as np

from tests.tuning.test_identify_starts import NOISE, OWN, PRESET, thruster_logs
from tests.tuning.test_null_tests import EFFECTS
from thruster_env.thruster.model import Recorder
from thruster_env.thruster.plant import make_plant
from tuning.likelihood.identify import identify
from tuning.likelihood.result import Identification
from tuning.plants.thruster_logs import ThrusterFamily

SENSORS = ("thrust", "speed")
WIDE = 6.0  # standard errors: nobody meets that by chance in a year of attacks
SAME = 0.05  # of log-likelihoods of two searches that end at one maximum


def starts_and_effects(rng: np.random.Generator, seconds: float) -> str:
    """Random first speeds, gaps and free effects: the truth within wide intervals, and no lower likelihood."""
    end, count, begun = time.monotonic() + seconds, 0, 0
    while count == 0 or time.monotonic() < end:
        logs, said = _logs(rng)
        effects = tuple(rng.choice(EFFECTS, int(rng.integers(1, 4)), replace=False))
        plain, found = _identified(logs, ()), _identified(logs, effects)
        given = f"{said}, free {', '.join(effects)}"
        fall = plain.log_likelihood - found.log_likelihood
        same = plain.begun_elsewhere == found.begun_elsewhere  # or other rows count
        assert not same or fall <= SAME, f"log L is {fall:.3g} lower with more parameters, given {given}"
        _check(plain, given)
        _check(found, given)
        count, begun = count + 1, begun + len(found.begun_elsewhere)
    return f"starts: {count} identifications withstood, {begun} runs began elsewhere"


def _logs(rng: np.random.Generator):
    """Random runs, and what they are."""
    speeds = tuple(
        None if rng.random() < 0.4 else tuple(np.sort(rng.uniform(-160.0, 160.0, 2)).tolist())
        for _ in range(int(rng.integers(2, 5)))
    )
    gap = None
    if rng.random() < 0.4:
        first = int(rng.integers(0, 100))
        gap = slice(first, first + int(rng.integers(1, 60)))
    options = {
        "first": int(rng.integers(2**20)),
        "speeds": speeds,
        "steps": int(rng.integers(150, 350)),
        "gap": gap,
    }
    return thruster_logs(**options), f"thruster_logs(**{options})"


def _identified(logs, effects: tuple[str, ...]) -> Identification:
    family = ThrusterFamily(
        logs, make_plant(PRESET, sensors=SENSORS, max_voltage=12.0), Recorder(), (*OWN[:2], *effects)
    )
    return identify(family.data, family.model, family.free, starts=1)


def _check(found: Identification, given: str) -> None:
    truth = {name: getattr(make_plant(PRESET).parameters, name) for name in OWN[:2]} | NOISE
    truth |= {name: 0.0 for name in found.names if name in EFFECTS}
    for name in found.names:
        value, error = found.values[name], found.standard_errors[name]
        assert np.isfinite([value, error]).all(), f"{name} is {value} +- {error}, given {given}"
        if found.determined[name] or name in EFFECTS:
            off = abs(value - truth[name])
            assert off <= WIDE * error or found.at_end[name], (
                f"{name} is {value:.4g} +- {error:.2g}, given {given}"
            )
    for name, test in found.null_tests.items():
        assert test.log_likelihood <= found.log_likelihood + SAME, f"without {name} it is likelier, given {given}"
