"""`thruster train`: train a policy on raw, filtered or true state, with progress and resumption."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.console import RenderableType
from rich.progress import TextColumn

from filters.tuned_file import read_tuned_file
from thruster_env.core.checks import at_least
from thruster_env.core.text_tables import Table
from tuning.api.markers import FILTER, INPUT, LEARNING, OUTPUT, READ, Option, PresetOption
from tuning.api.progress import bar
from tuning.api.result import Printed
from tuning.api.study import INTERRUPTED
from tuning.api.tune import file_name
from tuning.cli.output import progress_console
from tuning.plants.thruster_logs import of_preset
from tuning.policies.algorithms import ALGORITHMS, OBSERVATION_SETS, check_installed
from tuning.policies.setup import PLANTS, TASKS, TrainingConfiguration, make_configuration, plant_of
from tuning.problems.scenario import plain

if TYPE_CHECKING:
    from tuning.policies.learn import Trained

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
    preset: Annotated[str | Path | None, PresetOption] = None,
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
    setup = make_configuration(
        task,
        chosen,
        observe,
        algo,
        steps,
        seed,
        filter_arguments={name: plain(value) for name, value in chosen.untuned.items()} if untuned else None,
        tuned=tuned,
        num_envs=envs,
        controller=controller,
    )
    evaluations, checkpoints = (
        at_least("evaluations", evaluations, 1, 10_000),
        at_least("checkpoints", checkpoints, 1, 10_000),
    )
    check_installed()
    folder = out or POLICIES / name_of(setup, tuned, untuned)
    if tuned is not None and (meant := read_tuned_file(tuned)["problem"]) != chosen.name:
        progress_console.print(
            f"{tuned} was tuned on {meant}, and its filter keeps the assumptions of that scenario."
        )
    with progress_console.status("loading torch ..."):
        from tuning.policies.learn import train
    with _bar(f"{algo} on {observe}", setup.steps) as on_progress:
        trained = train(
            setup,
            folder,
            evaluations=evaluations,
            checkpoints=checkpoints,
            tensorboard=not no_tensorboard,
            on_progress=on_progress,
        )
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
