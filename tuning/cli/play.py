"""`thruster play`: show a policy, a sequence of voltages or a log, as a video or in a window."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from thruster_env.core.checks import at_least, one_of, short_repr
from thruster_env.env.env import LARGEST, SMALLEST
from thruster_env.render.renderer import Played, check_drawing
from tuning.cli.options import (
    FILTER,
    FILTER_HELP,
    INPUT,
    OUTPUT,
    RUNS,
    ColumnOption,
    JsonOption,
    LogPresetOption,
    SensorOption,
    filter_option,
)
from tuning.cli.output import announce_compilation, check_targets, emit, progress_console
from tuning.problems.seeds import held_out_seeds

STEPS = 500


def command(
    model: Annotated[
        Path | None, typer.Argument(metavar="MODEL", help="Folder of a policy, that `thruster train` made.")
    ] = None,
    policy: Annotated[
        str | None,
        typer.Option(
            help="pi, the default: the controller on the measured thrust follows a reference.",
            rich_help_panel=INPUT,
        ),
    ] = None,
    voltage: Annotated[float | None, typer.Option(help="A constant voltage [V].", rich_help_panel=INPUT)] = None,
    excitation: Annotated[
        str | None,
        typer.Option(help="A sequence of voltages: steps, prbs, levels, multi-sine, ...", rich_help_panel=INPUT),
    ] = None,
    log: Annotated[Path | None, typer.Option(help="A recorded run of a thruster.", rich_help_panel=INPUT)] = None,
    preset: LogPresetOption = None,
    sensor: SensorOption = None,
    column: ColumnOption = None,
    filter_name: Annotated[
        str | None, filter_option(f"Filter whose estimate is drawn; ekf by default. {FILTER_HELP}")
    ] = None,
    tuned: Annotated[
        Path | None, typer.Option(help="Tuned file, in place of --filter.", rich_help_panel=FILTER)
    ] = None,
    steps: Annotated[
        int | None, typer.Option(help=f"Steps of an episode; {STEPS} by default.", rich_help_panel=RUNS)
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(
            min=0, help="Seed of the episode; for a policy a held-out one by default.", rich_help_panel=RUNS
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="An .mp4 or .gif; by default an .mp4 in MODEL, or in out.",
            rich_help_panel=OUTPUT,
        ),
    ] = None,
    window: Annotated[
        bool,
        typer.Option("--window", help="Show it in a window instead, in real time.", rich_help_panel=OUTPUT),
    ] = False,
    size: Annotated[
        str | None,
        typer.Option(
            metavar="WIDTHxHEIGHT",
            help="Size of the picture in pixels; 640x400 by default.",
            rich_help_panel=OUTPUT,
        ),
    ] = None,
    json: JsonOption = None,
) -> None:
    """Show an episode: the motion of the thruster, and a filter's estimate of its hidden state.

    Without MODEL no policy is loaded, and torch is not needed: a PI controller follows a reference, a
    constant voltage or a sequence drives the thruster, or a recorded log is shown, with the estimate instead of
    the truth if the log has none.

    A policy gets the observations of its training: the same measurements, filter and scaling. The strip charts
    show the thrust, its reference and its measurement, and the filter's estimate with a band of two standard
    deviations.

    Needs the extra render, for MODEL also rl: pip install '.[rl,render]' in the project's folder

    Example: thruster play --policy pi --filter enkf --out pi.gif

    Example: thruster play out/policies/tracking-nominal-ekf-ppo-seed0
    """
    if window and out is not None:
        raise ValueError(f"give either --window or --out FILE, but got both, --out {out}")
    if filter_name is not None and tuned is not None:
        raise ValueError(f"give either --tuned FILE or --filter NAME, but got both, {tuned} and {filter_name}")
    chosen = {"MODEL": model, "--policy": policy, "--voltage": voltage, "--excitation": excitation, "--log": log}
    if all(value is None for value in chosen.values()):
        chosen["--policy"] = "pi"
    what = one_given(chosen)
    picture = None if size is None else size_of(size)
    _check_options(what, {"--sensor": sensor, "--column": column}, ("--log",))
    _check_options(what, {"--steps": steps}, ("--policy", "--voltage", "--excitation"))
    if model is not None:  # then it is what is played
        given = {"--preset": preset, "--filter": filter_name, "--tuned": tuned}
        _check_options(what, given, tuple(name for name in chosen if name != "MODEL"))
        played, shown, video = _of_policy(model, out, window, seed, picture, json)
    else:
        video = None if window else out or Path("out") / f"play-{_name(chosen[what])}.mp4"
        check_drawing(video)
        _check_even(video, picture)
        check_targets((video,), json, read=(log, tuned, preset))
        options = {"filter": filter_name, "tuned": tuned, "size": picture}
        played, shown = _without_policy(
            what, chosen[what], video, seed or 0, preset, steps, sensor, column, options
        )
    data = {**played._asdict(), "video": None if video is None else str(video)}
    if video is not None:
        shown.append(f"Video: {video}")
    emit(shown, data, json)


def one_given(chosen: dict) -> str:
    """The only name with a value; ValueError unless there is exactly one."""
    given = [name for name, value in chosen.items() if value is not None]
    if len(given) != 1:
        rule = f"play must be given one of {', '.join(chosen)}"
        raise ValueError(f"{rule}, but got {' and '.join(given) or 'none'}")
    return given[0]


def size_of(text: str) -> tuple[int, int]:
    """A picture's (width, height) [px] from a text such as 640x400; ValueError for any other."""
    found = re.fullmatch(r"(\d+)x(\d+)", text.strip().lower(), re.ASCII)
    if found is None:
        raise ValueError(f"--size must be WIDTHxHEIGHT in pixels, as 640x400, but got {short_repr(text)}")
    width, height = (
        at_least(f"the {side} of --size", int(value), SMALLEST, LARGEST)
        for side, value in zip(("width", "height"), found.groups(), strict=True)
    )
    return width, height


def _check_even(video: Path | None, size: tuple[int, int] | None) -> None:
    """Raise ValueError for an .mp4 of an odd size, whose colours would be coded as browsers do not show them."""
    if video is not None and video.suffix == ".mp4" and size is not None:
        for side, value in zip(("width", "height"), size, strict=True):
            if value % 2:
                raise ValueError(f"the {side} of --size must be even for an .mp4, but got {value}")


def _check_options(what: str, given: dict, fitting: tuple[str, ...]) -> None:
    """Raise ValueError for an option that does not apply to what is played."""
    for name, value in given.items():
        if value is not None and what not in fitting:
            raise ValueError(f"{name} must come with {' or '.join(fitting)}, but got it with {what}")


def _name(chosen) -> str:
    return chosen.stem if isinstance(chosen, Path) else f"{chosen:g}V" if isinstance(chosen, float) else chosen


def _of_policy(
    model: Path,
    out: Path | None,
    window: bool,
    seed: int | None,
    size: tuple[int, int] | None,
    json: str | None,
) -> tuple:
    from tuning.policies.extras import check_installed

    check_installed()
    with progress_console.status("loading torch ..."):
        from tuning.policies.play import play
        from tuning.policies.saved import find_saved, read_configuration
    folder = find_saved(model)
    seed = held_out_seeds(read_configuration(folder).seed, 2)[0] if seed is None else seed
    video = None if window else out or model / f"episode-seed{seed}.mp4"
    check_drawing(video)
    _check_even(video, size)
    check_targets((video,), json)
    announce_compilation()
    played = _drawn(lambda on_step: play(folder, video, seed, on_step, size))
    said = f"Episode {seed}: return {played.total_reward:.3f} in {played.steps} steps, {played.seconds:.1f} s."
    return played, [said], video


def _without_policy(what, given, video, seed, preset, steps, sensor, column, options) -> tuple[Played, list[str]]:
    from tuning.cli.episodes import POLICIES, play_log, play_pi, play_voltages
    from tuning.logs.read import read_named

    announce_compilation()
    if what == "--log":
        log, offer = read_named(given, preset, None, sensor, column)
        played = _drawn(lambda on_step: play_log(video, log, offer, on_step, seed=seed, **options))
        return played, [f"{log.name}: {played.steps} steps, {played.seconds:.1f} s."]
    options |= {"preset": preset or "tunnel", "steps": STEPS if steps is None else steps}
    if what == "--policy":
        one_of("policy", given, POLICIES)
        played = _drawn(lambda on_step: play_pi(video, seed, on_step, **options))
        said = f"return {played.total_reward:.3f} in "
    else:
        played, said = _drawn(lambda on_step: play_voltages(video, seed, on_step, given, **options)), ""
    return played, [f"Episode {seed}: {said}{played.steps} steps, {played.seconds:.1f} s."]


def _drawn(play) -> Played:
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, console=progress_console) as progress:
        task = progress.add_task("drawing", total=None)
        return play(lambda steps, count: progress.update(task, completed=steps, total=count))
