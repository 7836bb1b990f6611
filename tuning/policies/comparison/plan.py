"""The policies of a comparison and their noise levels: a list of runs, each a training or a classical policy.

Beside the three noise levels, at medium noise: filters with other Q and R (`untuned`, `tuned`), and three
situations in which filter and controller assume a wrong model (`WRONG`). A policy is trained in the situation
itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import NamedTuple

import numpy as np

from tuning.policies.setup import TrainingConfiguration, make_configuration
from tuning.search.plan import Plan
from tuning.search.study import open_study, quiet_optuna, run_study
from tuning.thruster.scenario import Scenario
from tuning.thruster.scenarios import find_scenario

TASK = "manoeuvre"
NOISES = {"low": "low_noise", "medium": "medium_noise", "high": "high_noise"}  # names of scenarios
LEARNT = ("raw", "raw+action", "stack", "ekf", "enkf", "belief", "true")
FOR_PI = ("raw", "lowpass", "ekf", "enkf", "true")
FOR_STATES = ("lowpass", "kf", "ekf", "ukf", "enkf", "true")
CLASSICAL = {"pi": FOR_PI, "lqr": FOR_STATES, "one-step": FOR_STATES, "mpc": FOR_STATES}
BEST = "mpc"  # the best known controller: on the true state the end of "gap closed", and the one that is corrected
CORRECTING = {"ppo+mpc": "ppo", "sac+mpc": "sac"}  # policies that correct it, and their algorithm
OF_MEDIUM = {"sac": ("ekf", "true"), "ppo+mpc": ("true",), "sac+mpc": ("ekf", "true")}  # at medium noise only
VARIANT_NOISE = "medium"
WRONG = {
    "wrong model": "mismatch",
    "dead band": "deadband",
    "unknown flow": "ambient",
}  # and the scenario it is of
VARIANTS = (
    ("ekf", "untuned"),
    ("ekf", "tuned"),
    ("ekf", "wrong model"),
    ("ekf", "wrong model tuned"),
    ("enkf", "wrong model"),
    ("ekf", "dead band"),
    ("ekf", "unknown flow"),
)
TUNING_TRIALS = 60


class Comparison(NamedTuple):
    """The size of a comparison; the defaults are those of docs/policies.md."""

    noises: tuple[str, ...] = tuple(NOISES)
    observation_sets: tuple[str, ...] = LEARNT
    seeds: int = 5  # training seeds of each learnt policy
    steps: int | None = None  # training steps; None for the algorithm's default
    episodes: int = 200  # held-out episodes, the same for all
    variants: bool = True  # filters with other Q and R, and wrong models
    recurrent: bool = False  # PPO with an LSTM on raw measurements, which is slow


QUICK = Comparison(noises=("medium",), seeds=2, steps=8_192, episodes=16, variants=False)


class Run(NamedTuple):
    """One policy, trained with one seed."""

    noise: str
    kind: str  # an algorithm, one of `CORRECTING`, or a controller of `CLASSICAL`
    variant: str  # variant of the filter or of the situation; may be empty
    setup: TrainingConfiguration

    @property
    def label(self) -> str:
        """Observation set and variant."""
        return f"{self.setup.observe}, {self.variant}" if self.variant else self.setup.observe

    @property
    def name(self) -> str:
        """Name of its files."""
        words = [self.noise, self.kind, self.setup.observe, *self.variant.split(), f"seed{self.setup.seed}"]
        return "-".join(words).replace("+", "-and-")


def runs_of(comparison: Comparison) -> list[Run]:
    """All runs of a comparison; seed by seed, so that early results include each observation set."""
    variants = VARIANTS if comparison.variants else ()
    cases = [
        (noise, kind, observed, "")
        for noise in comparison.noises
        for kind in CLASSICAL
        for observed in CLASSICAL[kind]
    ]
    cases += [(VARIANT_NOISE, BEST, observed, variant) for observed, variant in variants]
    cases += [(VARIANT_NOISE, BEST, "true", variant) for variant in WRONG if variants and variant != "wrong model"]
    classical = [_run(comparison, *case) for case in cases]
    return classical + [
        _run(comparison, *case, seed) for seed in range(comparison.seeds) for case in _learnt(comparison)
    ]


def _learnt(comparison: Comparison) -> list[tuple[str, str, str, str]]:
    """Noise, kind, observation set and variant of the learnt policies."""
    cases = []
    for noise in comparison.noises:
        cases += [(noise, "ppo", observed, "") for observed in comparison.observation_sets]
        cases.append((noise, "ppo+mpc", "ekf", ""))
        if noise == VARIANT_NOISE:
            cases += [
                (noise, kind, observed, "")
                for kind, observation_sets in OF_MEDIUM.items()
                for observed in observation_sets
            ]
        if comparison.recurrent:
            cases.append((noise, "recurrent-ppo", "raw", ""))
    if comparison.variants:
        cases += [(VARIANT_NOISE, "ppo", observed, variant) for observed, variant in VARIANTS]
        cases += [(VARIANT_NOISE, "ppo+mpc", "ekf", variant) for variant in WRONG]
    return cases


def _run(comparison: Comparison, noise: str, kind: str, observed: str, variant: str = "", seed: int = 0) -> Run:
    scenario = _scenario(noise, variant)
    arguments: Mapping = {}
    if variant.endswith("untuned"):
        arguments = scenario.untuned
    elif variant.endswith("tuned"):
        arguments = _tuned(observed, noise, variant)
    algo = "ppo" if kind in CLASSICAL else CORRECTING.get(kind, kind)
    setup = make_configuration(
        TASK,
        scenario,
        observed,
        algo,
        steps=comparison.steps,
        seed=seed,
        filter_arguments=_plain(arguments),
        controller=BEST if kind in CORRECTING else None,
    )
    return Run(noise, kind, variant, setup)


def _scenario(noise: str, variant: str) -> Scenario:
    """The scenario of a noise level, with the fields that a variant takes from another one."""
    scenario = find_scenario(NOISES[noise])
    if (name := variant.removesuffix(" tuned")) in WRONG:
        other = find_scenario(WRONG[name])
        parts = {part: getattr(other, part) for part in ("parameter_factors", "amplifier", "flow")}
        return scenario.replace(**parts)
    return scenario


@cache
def _tuned(filter_name: str, noise: str, variant: str) -> Mapping:
    """Q and R of a study on the scenario, in which voltages are held at random levels."""
    quiet_optuna()
    scenario = _scenario(noise, variant)
    plan = Plan(filter_name, (scenario,))
    study = open_study("policies", plan, None)
    return run_study(study, plan, TUNING_TRIALS).or_interrupted().choice.model


def _plain(arguments: Mapping) -> dict:
    return {name: np.asarray(value).tolist() for name, value in arguments.items()}
