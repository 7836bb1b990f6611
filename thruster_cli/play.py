"""`thruster play`: watch a trained policy, as a film or in a window."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from thruster_cli.output import announce_compilation, emit, progress_console
from training.extras import check_installed
from tuning.problems.seeds import held_out_seeds


def command(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="Folder that `thruster train` made.")],
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="An .mp4 or .gif; by default an .mp4 in MODEL.")
    ] = None,
    window: Annotated[bool, typer.Option("--window", help="Show it in a window instead, at true speed.")] = False,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Seed of the episode; by default one that is held out.")
    ] = None,
) -> None:
    """Show one episode of a trained policy, beside what it believes of the hidden state.

    The policy sees what it was trained on: the same measurements, filter and scaling. The strip charts show the
    thrust, its reference and its measurement, and the filter's estimate with a band of two standard deviations.

    Needs the extras rl and render: pip install 'thruster-env[rl,render]'

    Example: thruster play out/policies/tracking-nominal-ekf-ppo-seed0 --out ekf.gif
    """
    check_installed()
    if window and out is not None:
        raise ValueError("give either --window or --out FILE, but got both")
    with progress_console.status("loading torch ..."):
        from training.play import check_drawing, play
        from training.saved import find_saved, read_setup
    folder = find_saved(model)
    if seed is None:
        seed = held_out_seeds(read_setup(folder).seed, 2)[0]
    film = None if window else out or model / f"episode-seed{seed}.mp4"
    check_drawing(film)
    announce_compilation()
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, console=progress_console) as progress:
        task = progress.add_task("drawing", total=None)
        played = play(folder, film, seed, lambda steps, count: progress.update(task, completed=steps, total=count))
    shown = [f"Episode {seed}: return {played.total_reward:.3f} in {played.steps} steps, {played.seconds:.1f} s."]
    if film is not None:
        shown.append(f"Film: {film}")
    emit(shown, {}, None)
