"""`thruster demo`: the main job from end to end: tune, prove, picture, and the published tables."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from thruster_cli import reproduce
from thruster_cli.output import JsonOption, SeedOption, emit
from thruster_cli.tune import DEFAULT_STORAGE, Tuning, as_json, report, tune
from tuning.figures import comparison_figure, estimates_figure, history_figure
from tuning.scenarios import find_scenario, held_out_seeds
from tuning.space import true_choice

FILTER, SCENARIO = "enkf", "mismatch"  # where tuning earns its keep


def command(
    out: Annotated[Path, typer.Option(help="Folder of pictures and of the tuned file.")] = Path("out"),
    trials: Annotated[int, typer.Option(help="Trials of the study.")] = 50,
    seed: SeedOption = 0,
    json: JsonOption = None,
) -> None:
    """Tune an ensemble Kalman filter, prove it on held-out seeds, and reproduce the published tables."""
    started = time.perf_counter()
    tuning = tune(FILTER, SCENARIO, trials, str(out / Path(DEFAULT_STORAGE).name), None, None, seed)
    pictures = draw(tuning, out, seed)
    published = reproduce.run_studies(["nurhadi2022", "kiki2020"], seed=seed)
    seconds = time.perf_counter() - started
    closing = [
        "",
        f"What it found: {conclusion(tuning)}",
        "Pictures: " + ", ".join(str(picture) for picture in pictures),
        f"Tuned filter: {tuning.file} (use it: EstimateState(env, tuned={str(tuning.file)!r}))",
        f"All of it took {seconds:.0f} s.",
    ]
    data = {"tuning": as_json(tuning), "pictures": [str(p) for p in pictures], "seconds": seconds}
    emit([*report(tuning), *reproduce.report(published), *closing], data, json)


def draw(tuning: Tuning, out: Path, seed: int) -> list[Path]:
    """Draw estimates over time, the study's history and the errors before and after; return the files."""
    nominal = find_scenario("nominal")
    data = nominal.data(held_out_seeds(seed, 200))
    filters = {
        "Kalman filter, affine about 12 V": true_choice("kf", nominal).filter(nominal),
        "Ensemble Kalman filter, N = 100": true_choice("enkf", nominal).with_size(100).filter(nominal),
    }
    label = f"{tuning.result.choice.name} on {tuning.scenario.name}"
    return [
        estimates_figure(out / "estimates.png", filters, data, 0, nominal.plant.dt),
        history_figure(out / "history.png", tuning.result.trials, f"Study of {label}"),
        comparison_figure(
            out / "rmse.png", tuning.proof, f"{label}: RMSE on {len(tuning.proof.seeds)} held-out seeds"
        ),
    ]
