"""`thruster train` and `score`: train a policy with progress and resumption, score it on held-out episodes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from rich.console import RenderableType
from rich.progress import TextColumn
from rich.text import Text

from filters.consistency.nees import mean_interval
from filters.tuned_file import read_tuned_file
from thruster_env.core.checks import at_least, one_of
from thruster_env.core.text_tables import Table
from tuning.api.markers import FILTER, INPUT, LEARNING, OUTPUT, READ, RUNS, Argument, Option, Preset, Seed
from tuning.api.progress import bar
from tuning.api.result import INTERRUPTED, Printed
from tuning.api.tune import file_name
from tuning.cli.output import progress_console
from tuning.plants.thruster_logs import of_preset
from tuning.policies.algorithms import ALGORITHMS, OBSERVATION_SETS, check_installed, find_observation_set
from tuning.policies.setup import PLANTS, TASKS, TrainingConfiguration, in_scenario, make_configuration, plant_of
from tuning.problems.data import held_out_seeds
from tuning.problems.scenario import PlantScenario, plain
from tuning.reporting.tables import about, unless_blank
from tuning.search.plan import HELD_OUT_SEEDS

if TYPE_CHECKING:
    from tuning.policies.learn import Trained
    from tuning.policies.saved import Scores

POLICIES = Path("out") / "policies"
SHOWN_EVALUATIONS = 8
LEARNABLE = ", ".join([*(name for plant in PLANTS.values() for name in plant.scenarios), "or a .toml file"])
DEFAULTS = ", ".join(f"{plant.scenario} for the {name}" for name, plant in PLANTS.items())
CORRECTABLE = ", ".join(name for plant in PLANTS.values() for name in plant.correctable)
FEWEST_STEPS = ", ".join(f"{name} {algorithm.steps}" for name, algorithm in ALGORITHMS.items())


def command(
    task: Annotated[str, Option(INPUT, choices=TASKS)] = "tracking",
    observe: Annotated[str, Option(FILTER, metavar="ARM", choices=OBSERVATION_SETS)] = "ekf",
    algo: Annotated[str, Option(LEARNING, choices=ALGORITHMS)] = "ppo",
    steps: Annotated[int | None, Option(LEARNING, metavar="N", listed=f"{FEWEST_STEPS}.")] = None,
    scenario: Annotated[str | None, Option(INPUT, listed=f"{LEARNABLE}; by default {DEFAULTS}.")] = None,
    preset: Preset = None,
    tuned: Annotated[Path | None, Option(FILTER, metavar="FILE", file=READ)] = None,
    untuned: Annotated[bool, Option(FILTER)] = False,
    controller: Annotated[str | None, Option(LEARNING, listed=f"{CORRECTABLE}.")] = None,
    envs: Annotated[int | None, Option(LEARNING, metavar="N")] = None,
    evaluations: Annotated[int, Option(LEARNING, metavar="N")] = 20,
    checkpoints: Annotated[int, Option(OUTPUT, metavar="N")] = 10,
    no_tensorboard: Annotated[bool, Option(OUTPUT)] = False,
    out: Annotated[Path | None, Option(OUTPUT, metavar="FOLDER")] = None,
    seed: Annotated[int, Option(LEARNING, least=0)] = 0,
) -> Printed:
    """Train a policy on raw, filtered or true state, with Stable-Baselines3.

    The reward depends on the true thrust, whatever the policy sees. A filter uses the plant's Q and R, unless
    --tuned or --untuned is given. The return shown is that of 32 fixed validation episodes; for
    held-out ones use `thruster score`.

    Training uses whole rollouts, so it may end some steps later. In FOLDER, final/ is the policy for score and
    play (until it exists, the latest checkpoint), best/ the one with the highest return so far.

    With --controller the policy sees the action of a controller and adds up to a fifth of the maximum voltage to
    it. The controller needs an estimate, or the true state.

    Ctrl-C saves a checkpoint. The same command continues from it, also after a crash or with more steps.

    Needs the extra rl: pip install '.[rl]' in the project's folder. To watch it learn:
    tensorboard --logdir out/policies

    Example: thruster train --task manoeuvre --observe enkf --seed 1

    Args:
        task: what the policy does:
        observe: what the policy sees:
        algo: how it learns:
        steps: training steps of the env, by default:
        scenario: the plant and its noise:
        preset: the scenario of another thruster:
        tuned: tuned file of the filter, from `thruster tune`.
        untuned: give the filter R from the sensor's data sheet and Q from a rule of thumb.
        controller: let the policy correct a controller instead of acting alone:
        envs: copies of the env, stepped together.
        evaluations: number of validations of the policy during training.
        checkpoints: number of checkpoints during training.
        no_tensorboard: do not write logs for TensorBoard.
        out: by default one in out/policies, named after these options.
        seed: seed of the network, the noise and the episodes.
    """
    plant = plant_of(task)
    scenario = plant.scenario if scenario is None else scenario
    chosen = of_preset(plant.find_scenario(scenario), preset)
    if untuned and tuned is not None:
        raise ValueError(f"give either --tuned FILE or --untuned, but got both, --tuned {tuned}")
    arguments = {name: plain(value) for name, value in chosen.untuned.items()} if untuned else None
    options: dict[str, Any] = {"tuned": tuned, "num_envs": envs, "controller": controller}
    setup = make_configuration(task, chosen, observe, algo, steps, seed, filter_arguments=arguments, **options)
    options = {"tensorboard": not no_tensorboard}
    for name, count in (("evaluations", evaluations), ("checkpoints", checkpoints)):
        options[name] = at_least(name, count, 1, 10_000)
    check_installed()
    folder = out or POLICIES / name_of(setup, tuned, untuned)
    if tuned is not None and (meant := read_tuned_file(tuned)["problem"]) != chosen.name:
        progress_console.print(
            f"{tuned} was tuned on {meant}, and its filter keeps the assumptions of that scenario."
        )
    with progress_console.status("loading torch ..."):
        from tuning.policies.learn import train
    with _bar(f"{algo} on {observe}", setup.steps) as on_progress:
        trained = train(setup, folder, on_progress=on_progress, **options)
    return Printed(report(setup, trained), as_json(setup, trained), INTERRUPTED if trained.interrupted else 0)


def name_of(setup: TrainingConfiguration, tuned: Path | None = None, untuned: bool = False) -> str:
    """Name of the folder of a training: task, observation set, algorithm."""
    parts = [setup.task, file_name(setup.scenario), setup.observe]
    parts += ["untuned"] * untuned + ([] if tuned is None else [tuned.stem])
    parts += [] if setup.controller is None else [setup.controller]
    return "-".join([*parts, setup.algo, f"seed{setup.seed}"])


def report(setup: TrainingConfiguration, trained: Trained) -> list[RenderableType]:
    """What to print about a training: the course of the return, the speed, and the next commands."""
    curve, title = trained.curve, f"{setup.algo} on {setup.observe}, {setup.task}, scenario {setup.scenario}"
    last = len(curve) - 1
    picked = sorted({round(i * last / (SHOWN_EVALUATIONS - 1)) for i in range(SHOWN_EVALUATIONS)}) if curve else []
    rows = [[curve[i][0], f"{curve[i][1]:.3f}"] for i in picked]
    speed = (
        f"{trained.learnt / trained.seconds:.0f} steps/s" if trained.learnt else "training was already complete"
    )
    output: list[RenderableType] = []
    if rows:
        caption = f"0 is perfect; actions of zero have {trained.idle:.3f} on the same episodes."
        output += [title, Table("", ["steps", "mean return"], rows, caption=caption)]
        if curve[-1][1] <= trained.idle:
            output.append("At the end the policy is no better than actions of zero: it needs more --steps.")
    output.append(f"{trained.steps} steps, {trained.learnt} of them now in {trained.seconds:.1f} s: {speed}.")
    output.append(f"Policy: {trained.folder}")
    if trained.interrupted:
        return [*output, "Interrupted: a checkpoint is saved, and the same command continues from it."]
    return [*output, f"Watch it: thruster play {trained.folder}", f"Score it: thruster score {trained.folder}"]


def as_json(setup: TrainingConfiguration, trained: Trained) -> dict:
    """The same as plain data."""
    return {
        "folder": str(trained.folder),
        "steps": trained.steps,
        "learnt_now": trained.learnt,
        "seconds": trained.seconds,
        "evaluations": [{"steps": steps, "mean_return": value} for steps, value in trained.curve],
        "mean_return_of_zero_actions": trained.idle,
        "interrupted": trained.interrupted,
        "setup": vars(setup),
    }


@contextmanager
def _bar(title: str, total: int) -> Iterator[Callable[[int, float], None]]:
    speed = TextColumn("{task.fields[speed]} steps/s  return {task.fields[mean_return]}", markup=False)
    with bar(title, progress_console, speed, total=total, speed="-", mean_return="-") as update:
        first: list[tuple[int, float]] = []

        def advance(steps: int, mean_return: float) -> None:
            first.append((steps, time.perf_counter())) if not first else None
            seconds = time.perf_counter() - first[0][1]
            update(
                completed=min(steps, total),
                speed=f"{(steps - first[0][0]) / seconds:.0f}" if seconds > 1 else "-",
                mean_return="-" if isnan(mean_return) else f"{mean_return:.2f}",
            )

        yield advance


SEEN = "seen"  # heads the column of what the policy is shown


class Scored(NamedTuple):
    """A policy and its scores."""

    label: str
    folder: Path | None  # of a learnt policy
    setup: TrainingConfiguration
    scores: Scores


def score(
    models: Annotated[list[Path], Argument(INPUT, metavar="MODEL")],
    scenario: Annotated[str | None, Option(INPUT, listed=f"{LEARNABLE}.")] = None,
    preset: Preset = None,
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
    return Printed(scores_report(scored, held_out), scores_json(scored, held_out))


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


def scores_report(scored: Sequence[Scored], seeds: range) -> list[RenderableType]:
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


def scores_json(scored: Sequence[Scored], seeds: range) -> dict:
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
