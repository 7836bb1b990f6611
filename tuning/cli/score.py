"""`thruster score`: trained and classical policies on held-out episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

from rich.console import RenderableType
from rich.text import Text

from filters.consistency.nees import mean_interval
from thruster_env.core.checks import one_of
from thruster_env.core.text_tables import Table
from tuning.api.markers import INPUT, RUNS, Argument, Option, PresetOption, Seed
from tuning.api.result import Printed
from tuning.cli.output import progress_console
from tuning.cli.train import LEARNABLE
from tuning.plants.thruster_logs import of_preset
from tuning.policies.algorithms import check_installed, find_observation_set
from tuning.policies.setup import TrainingConfiguration, in_scenario, plant_of
from tuning.problems.data import held_out_seeds
from tuning.problems.scenario import PlantScenario
from tuning.reporting.leaderboard import about, unless_blank
from tuning.search.plan import HELD_OUT_SEEDS

if TYPE_CHECKING:
    from tuning.policies.saved import Scores

SEEN = "seen"  # heads the column of what the policy is shown


class Scored(NamedTuple):
    """A policy and its scores."""

    label: str
    folder: Path | None  # of a learnt policy
    setup: TrainingConfiguration
    scores: Scores


def command(
    models: Annotated[list[Path], Argument(INPUT, metavar="MODEL")],
    scenario: Annotated[str | None, Option(INPUT, listed=f"{LEARNABLE}.")] = None,
    preset: Annotated[str | Path | None, PresetOption] = None,
    classical: Annotated[Sequence[str], Option(INPUT)] = (),
    seeds: Annotated[int, Option(RUNS)] = HELD_OUT_SEEDS,
    seed: Seed = 0,
) -> Printed:
    """Score trained policies on held-out episodes, the same for all, without exploration.

    Returns come with 95 % intervals. Thrust errors are root mean squares of the true thrust against the reference:
    within 0.15 s of its steps, elsewhere, and within 0.15 s of changes of its sign. Several policies are compared
    with the first one episode by episode.

    With --scenario the plant changes, including its noise and sensors, but filters and controllers do not: a
    filter still assumes the plant of training, a classical controller keeps its gains. A scenario's settings for
    filters are ignored.

    Needs the extra rl: pip install '.[rl]' in the project's folder

    mpc plans a few steps ahead with the thruster's equations, one-step plans one step; lqr is linear.

    Example: thruster score out/policies/* --classical mpc --scenario ambient

    Args:
        models: folders that `thruster train` made.
        scenario: a plant other than that of training:
        preset: the scenario of another thruster:
        classical: a controller with the observations of each policy: pi, lqr, one-step or mpc; all but pi need a
            state; may be repeated.
        seeds: number of held-out episodes.
        seed: seed of all randomness; the same seed gives the same results.
    """
    check_installed()
    if preset is not None and scenario is None:
        raise ValueError(f"--preset must come with --scenario, but got --preset {preset} alone")
    held_out = held_out_seeds(seed, seeds)
    with progress_console.status("loading torch ..."):
        from tuning.policies.saved import find_saved, read_configuration
    folders = {model: find_saved(model) for model in models}
    setups = {model: read_configuration(folder) for model, folder in folders.items()}
    kind = plant_of(next(iter(setups.values())).task)
    for name in classical:
        one_of("classical", name, kind.controllers)
    plant = None if scenario is None else of_preset(kind.find_scenario(scenario), preset)
    check_alike(list(setups.values()), plant)
    scored = []
    with progress_console.status("scoring ...") as status:
        for model, folder in folders.items():
            status.update(Text(f"scoring {model} on {seeds} episodes ..."))
            scored.append(_learnt(model, folder, setups[model], plant, held_out))
        for name in classical:
            for setup in _each_arm(setups.values()):
                if name in kind.of_states and not find_observation_set(setup.observe).shows_state:
                    continue
                status.update(Text(f"scoring {name} on {setup.observe} ..."))
                scored.append(_classical(name, setup, plant, held_out))
    return Printed(report(scored, held_out), as_json(scored, held_out))


def check_alike(setups: Sequence[TrainingConfiguration], plant: PlantScenario | None) -> None:
    """Raise ValueError unless all policies do the same task, on the same plant once a scenario is given."""
    for name in ("task", "env_id") + (("scenario",) if plant is None else ()):
        values = sorted({getattr(setup, name) for setup in setups})
        if len(values) > 1:
            way_out = ": give one with --scenario" if name == "scenario" else ""
            raise ValueError(
                f"models to compare must have one {name.replace('_', ' ')}, but got {', '.join(values)}{way_out}"
            )


def _learnt(
    model: Path, folder: Path, setup: TrainingConfiguration, plant: PlantScenario | None, seeds: Sequence[int]
) -> Scored:
    from tuning.policies.environments import make_environments
    from tuning.policies.saved import load, score

    met = setup if plant is None else in_scenario(setup, plant)
    policy = load(folder, make_environments(met, seeds[:1]))
    name = setup.algo if setup.controller is None else f"{setup.algo}+{setup.controller}"
    return Scored(f"{setup.observe} {name}", model, setup, score(policy, met, seeds))


def _classical(
    name: str, setup: TrainingConfiguration, plant: PlantScenario | None, seeds: Sequence[int]
) -> Scored:
    from tuning.policies.saved import classical_policy, score

    setup = replace(setup, controller=None)  # there is no policy to correct it
    met = setup if plant is None else in_scenario(setup, plant)
    return Scored(f"{setup.observe} {name}", None, setup, score(classical_policy(name, setup), met, seeds))


def _each_arm(setups) -> list[TrainingConfiguration]:
    """One setup for each way to observe, filter arguments included."""
    arms: list[TrainingConfiguration] = []
    for setup in setups:
        if all((setup.observe, setup.filter_arguments) != (arm.observe, arm.filter_arguments) for arm in arms):
            arms.append(setup)
    return arms


def report(scored: Sequence[Scored], seeds: range) -> list[RenderableType]:
    """A table of policies, and the folders of the learned ones."""
    kind = plant_of(scored[0].setup.task)
    rows, first, shown_parts = [], scored[0].scores.returns, [part for part in kind.parts if part != "all"]
    for number, (label, _, _, scores) in enumerate(scored, start=1):
        over = "" if number == 1 else about(mean_interval(scores.returns - first), 3)
        errors = [unless_blank(scores.parts[part].rms, ".2f") for part in shown_parts]
        rows.append([f"{number} {label}", about(mean_interval(scores.returns), 3), over, *errors])
    headers = [f"{SEEN if part == 'observed' else part}\n[{kind.parts[part]}]" for part in shown_parts]
    columns = ["policy", "mean return", "over the\nfirst", *headers]
    title = f"Held-out episodes {seeds.start} to {seeds.stop - 1}, {scored[0].setup.task}"
    caption = (
        f"±: half of the 95 % interval. The other columns are root mean square errors: {kind.errors}; blank: "
        "no such step."
    )
    output: list[RenderableType] = [Table(title, columns, rows, caption=caption)]
    learnt = [(number, policy) for number, policy in enumerate(scored, start=1) if policy.folder is not None]
    return output + [f"{number} {policy.label}: {policy.folder}" for number, policy in learnt]


def as_json(scored: Sequence[Scored], seeds: range) -> dict:
    """The same as plain data, with the return of every episode."""
    first = scored[0].scores.returns
    return {
        "seeds": [seeds.start, seeds.stop],
        "policies": [
            {
                "policy": label,
                "folder": None if folder is None else str(folder),
                "mean_return": mean_interval(scores.returns)._asdict(),
                "over_the_first": mean_interval(scores.returns - first)._asdict(),
                **{f"{name}_rms": part.rms for name, part in scores.parts.items()},
                "returns": scores.returns,
            }
            for label, folder, _, scores in scored
        ],
    }
