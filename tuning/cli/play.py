"""`thruster play`: show a policy, a sequence of voltages or a log, as a video or in a window."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import gymnasium as gym
import numpy as np

import thruster_env  # noqa: F401 - registers the envs
from filters import EstimateState
from filters.logs.estimate import LogEstimate
from filters.logs.estimate import estimate as estimate_log
from thruster_env.core.checks import at_least, one_of, short_repr, within
from thruster_env.core.streams import episode_keys
from thruster_env.env.env import LARGEST, SMALLEST
from thruster_env.logs.log import Log
from thruster_env.render.renderer import OnStep, Played, check_drawing, steps_a_frame, write_video
from thruster_env.thruster.controllers import PIController
from thruster_env.thruster.env import renderer_of
from thruster_env.thruster.rendering import ChartEntry, Overlay
from tuning.api.markers import FILTER, INPUT, OUTPUT, READ, RUNS, WRITTEN, Argument, FilterOption, Option, Preset
from tuning.api.progress import bar
from tuning.api.result import Printed
from tuning.cli.output import check_targets, progress_console, warn_beyond
from tuning.plants.thruster import voltages_of
from tuning.problems.data import held_out_seeds
from tuning.problems.excitation import EXCITATIONS
from tuning.problems.scenario import excitation_of

STEPS = 500


def command(
    model: Annotated[Path | None, Argument(INPUT, metavar="MODEL")] = None,
    policy: Annotated[str | None, Option(INPUT)] = None,
    voltage: Annotated[float | None, Option(INPUT)] = None,
    excitation: Annotated[str | None, Option(INPUT)] = None,
    log: Annotated[Path | None, Option(INPUT, file=READ)] = None,
    preset: Preset = None,
    sensor: Annotated[Sequence[str] | None, Option(INPUT, choices="sensors")] = None,
    column: Annotated[Sequence[str] | None, Option(INPUT, metavar="NAME=HEADER[UNIT]")] = None,
    filter: Annotated[str | None, FilterOption] = None,
    tuned: Annotated[Path | None, Option(FILTER, file=READ)] = None,
    steps: Annotated[int | None, Option(RUNS)] = None,
    seed: Annotated[int | None, Option(RUNS, least=0)] = None,
    out: Annotated[Path | None, Option(OUTPUT, metavar="FILE", file=WRITTEN)] = None,
    window: Annotated[bool, Option(OUTPUT)] = False,
    size: Annotated[str | None, Option(OUTPUT, metavar="WIDTHxHEIGHT")] = None,
) -> Printed:
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

    Args:
        model: folder of a policy, that `thruster train` made.
        policy: the controller pi on the measured thrust, the default, which follows a reference.
        voltage: a constant voltage [V].
        excitation: a sequence of voltages: steps, prbs, levels, multi-sine, ...
        log: a recorded run of a thruster.
        preset: the thruster:
        sensor: a thruster's sensor that the filter sees, thrust by default:
        column: the column of an input, measurement, state or output; may be repeated.
        filter: name of the filter whose estimate is drawn, as `thruster filters` lists them; ekf by default.
        tuned: tuned file, in place of --filter.
        steps: steps of an episode; 500 by default.
        seed: seed of the episode; for a policy a held-out one by default.
        out: an .mp4 or .gif; by default an .mp4 in MODEL, or in out.
        window: show it in a window instead, in real time.
        size: size of the picture in pixels; 640x400 by default.
    """
    if window and out is not None:
        raise ValueError(f"give either --window or --out FILE, but got both, --out {out}")
    if filter is not None and tuned is not None:
        raise ValueError(f"give either --tuned FILE or --filter NAME, but got both, {tuned} and {filter}")
    chosen = {"MODEL": model, "--policy": policy, "--voltage": voltage, "--excitation": excitation, "--log": log}
    if all(value is None for value in chosen.values()):
        chosen["--policy"] = "pi"
    what = one_given(chosen)
    picture = None if size is None else size_of(size)
    _check_options(what, {"--sensor": sensor, "--column": column}, ("--log",))
    _check_options(what, {"--steps": steps}, ("--policy", "--voltage", "--excitation"))
    if model is not None:  # then it is what is played
        arguments = {"--preset": preset, "--filter": filter, "--tuned": tuned}
        _check_options(what, arguments, tuple(name for name in chosen if name != "MODEL"))
        played, output, video = _of_policy(model, out, window, seed, picture)
    else:
        video = None if window else out or Path("out") / f"play-{_name(chosen[what])}.mp4"
        check_drawing(video)
        _check_even(video, picture)
        check_targets((video,), None, read=(log, tuned, preset))
        options = {"filter": filter, "tuned": tuned, "size": picture}
        played, output = _without_policy(
            what, chosen[what], video, seed or 0, preset, steps, sensor, column, options
        )
    data = {**played._asdict(), "video": None if video is None else str(video)}
    if video is not None:
        output.append(f"Video: {video}")
    return Printed(output, data)


def one_given(chosen: dict) -> str:
    """The only name with a value; ValueError unless there is exactly one."""
    names = [name for name, value in chosen.items() if value is not None]
    if len(names) != 1:
        rule = f"play must be given one of {', '.join(chosen)}"
        raise ValueError(f"{rule}, but got {' and '.join(names) or 'none'}")
    return names[0]


def size_of(text: str) -> tuple[int, int]:
    """A picture's (width, height) [px] from a text such as 640x400; ValueError for any other."""
    match = re.fullmatch(r"(\d+)x(\d+)", text.strip().lower(), re.ASCII)
    if match is None:
        raise ValueError(f"--size must be WIDTHxHEIGHT in pixels, as 640x400, but got {short_repr(text)}")
    width, height = (
        at_least(f"the {side} of --size", int(value), SMALLEST, LARGEST)
        for side, value in zip(("width", "height"), match.groups(), strict=True)
    )
    return width, height


def _check_even(video: Path | None, size: tuple[int, int] | None) -> None:
    """Raise ValueError for an .mp4 of an odd size, whose colours would be coded as browsers do not show them."""
    if video is not None and video.suffix == ".mp4" and size is not None:
        for side, value in zip(("width", "height"), size, strict=True):
            if value % 2:
                raise ValueError(f"the {side} of --size must be even for an .mp4, but got {value}")


def _check_options(what: str, options: dict, fitting: tuple[str, ...]) -> None:
    """Raise ValueError for an option that does not apply to what is played."""
    for name, value in options.items():
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
) -> tuple:
    from tuning.policies.algorithms import check_installed

    check_installed()
    with progress_console.status("loading torch ..."):
        from tuning.policies.saved import find_saved, play, read_configuration
    folder = find_saved(model)
    seed = held_out_seeds(read_configuration(folder).seed, 2)[0] if seed is None else seed
    video = None if window else out or model / f"episode-seed{seed}.mp4"
    check_drawing(video)
    _check_even(video, size)
    check_targets((video,), None)
    played = _drawn(lambda on_step: play(folder, video, seed, on_step, size))
    sentence = f"Episode {seed}: return {played.total_reward:.3f} in {played.steps} steps, {played.seconds:.1f} s."
    return played, [sentence], video


def _without_policy(
    what, argument, video, seed, preset, steps, sensor, column, options
) -> tuple[Played, list[str]]:
    from tuning.logs.read import read_named

    if what == "--log":
        log, offer = read_named(argument, preset, None, sensor, column)
        played = _drawn(lambda on_step: play_log(video, log, offer, on_step, seed=seed, **options))
        return played, [f"{log.name}: {played.steps} steps, {played.seconds:.1f} s."]
    options |= {"preset": preset or "tunnel", "steps": STEPS if steps is None else steps}
    if what == "--policy":
        one_of("policy", argument, POLICIES)
        played = _drawn(lambda on_step: play_pi(video, seed, on_step, **options))
        reward = f"return {played.total_reward:.3f} in "
    else:
        played, reward = _drawn(lambda on_step: play_voltages(video, seed, on_step, argument, **options)), ""
    return played, [f"Episode {seed}: {reward}{played.steps} steps, {played.seconds:.1f} s."]


def _drawn(play) -> Played:
    with bar("drawing", progress_console) as update:
        return play(lambda steps, count: update(completed=steps, total=count))


POLICIES = ("pi",)
SEQUENCES = tuple(name for name in EXCITATIONS.effects if name not in POLICIES)
ENV = "BowThrusterTracking-v0"
MOST_STEPS = 100_000


def play_pi(video: Path | None, seed: int, on_step: OnStep, **arguments) -> Played:
    """One episode of the env that follows a reference, by the PI controller on its measured thrust.

    Args:
        video: an .mp4 or .gif file; None for a window.
        seed: of the episode.
        on_step: called after each step.
        **arguments: of `estimated_env`.
    """
    with estimated_env(video, **arguments) as env:
        controller, state, ended = PIController.for_env(env), None, True

        def act(observation, step: int) -> np.ndarray:
            nonlocal state, ended
            action, state = controller.predict(observation, state, np.array(ended))
            ended = False
            return action

        return _played(env, act, video, seed, on_step)


def play_voltages(
    video: Path | None, seed: int, on_step: OnStep, voltage: float | str, steps: int, **arguments
) -> Played:
    """A thruster under a constant voltage [V], or a sequence by the name of an excitation."""
    if not isinstance(voltage, str):
        warn_beyond(arguments.get("preset", "tunnel"), voltage)
    with estimated_env(video, steps=steps, **arguments) as env:
        thruster: Any = env.unwrapped
        plant = thruster.plant
        if isinstance(voltage, str):
            excitation = excitation_of({"name": one_of("excitation", voltage, SEQUENCES)})
            voltages = voltages_of(excitation, plant, episode_keys([seed]), steps)[0]
        else:
            voltages = np.full(steps, within("voltage", voltage, plant.max_voltage))
        moment = thruster.moment_of  # there is a reference, but nobody follows it
        thruster.moment_of = lambda report: moment(report)._replace(reference=None)
        return _played(env, lambda observation, step: voltages[[step]], video, seed, on_step)


@contextmanager
def estimated_env(
    video: Path | None,
    preset: str = "tunnel",
    steps: int = 500,
    filter: str | None = None,
    tuned: Path | None = None,
    size: tuple[int, int] | None = None,
) -> Iterator[gym.Env]:
    """A thruster drawn with a filter's estimate.

    Args:
        video: None for a window.
        preset: of the thruster.
        steps: of an episode.
        filter: by name; "ekf" if None and no tuned file.
        tuned: path of a tuned file.
        size: of pictures, (width, height) [px]; None for the env's own.
    """
    at_least("steps", steps, 1, MOST_STEPS)
    mode = "human" if video is None else "rgb_array"
    env = gym.make(ENV, preset=preset, render_mode=mode, render_size=size, max_episode_steps=steps)
    try:
        source = {"filter": filter} if tuned is None else {"tuned": str(tuned)}
        yield EstimateState(env, observation="measurement+estimate", **source)
    finally:
        env.close()


def _played(env, act, video: Path | None, seed: int, on_step: OnStep) -> Played:
    every, dt = steps_a_frame(video, env.unwrapped.plant.dt), env.unwrapped.plant.dt
    count = env.spec.max_episode_steps
    observation, _ = env.reset(seed=seed)
    frames = [env.render()] if every else []
    steps, total, over = 0, 0.0, False
    while not over:
        observation, reward, terminated, truncated, _ = env.step(act(observation, steps))
        steps, total, over = steps + 1, total + float(reward), terminated or truncated
        if every and steps % every == 0:
            frames.append(env.render())
        on_step(steps, count)
    if video is not None:
        write_video(video, frames, 1 / (dt * every))
    return Played(steps, total, steps * dt)


def play_log(
    video: Path | None,
    log: Log,
    offer,
    on_step: OnStep,
    *,
    filter: str | None = None,
    tuned: Path | None = None,
    size: tuple[int, int] | None = None,
    seed: int = 0,
) -> Played:
    """A recorded run of a thruster: its voltage and measurements, what else was recorded, and a filter's estimate.

    Args:
        video: an .mp4 or .gif file; None for a window.
        log: of the thruster.
        offer: what offers its model and has its `plant`.
        on_step: called after each row.
        filter: by name; "ekf" if None and no tuned file.
        tuned: path of a tuned file.
        size: of pictures, (width, height) [px]; None for the env's own.
        seed: of the filter's random numbers.
    """
    estimates = estimate_log(log, filter, offer, tuned=tuned, seed=seed)
    every = steps_a_frame(video, log.dt)
    largest = float(np.abs(log.inputs).max())
    plant = offer.plant._replace(max_voltage=max(offer.plant.max_voltage, largest), dt=log.dt)
    mode = "human" if video is None else "rgb_array"
    renderer = renderer_of(plant, mode, max(1, round(1 / log.dt)), size)
    frames: list[np.ndarray] = []
    try:
        for row, (moment, overlay) in enumerate(zip(moments(log), overlays(estimates), strict=True)):
            renderer.add(moment, overlay)
            if video is None or row % every == 0:
                frame = renderer.draw()
                if frame is not None:  # in no window
                    frames.append(frame)
            on_step(row, log.steps)
        if video is not None:
            write_video(video, frames, 1 / (log.dt * every))
    finally:
        renderer.close()
    return Played(log.steps, 0.0, log.steps * log.dt)


def moments(log: Log) -> Iterator[ChartEntry]:
    """The recorded values, row by row; NaN where there are none."""
    columns: Mapping[str, np.ndarray] = {
        **{quantity.symbol: log.measurements[:, i] for i, quantity in enumerate(log.measured)},
        **{channel.rpartition(":")[2]: values for channel, values in log.references.items()},
    }
    nowhere = np.full(log.steps + 1, np.nan)
    omega, flow, thrust = (columns.get(name, nowhere) for name in ("omega_m", "U_a", "T"))
    measured = columns.get("thrust", nowhere)
    voltages = np.append(log.inputs[:, 0], log.inputs[-1, 0])
    for k in range(log.steps + 1):
        yield ChartEntry(k * log.dt, omega[k], flow[k], thrust[k], measured[k], None, voltages[k])


def overlays(estimates: LogEstimate) -> Iterator[Overlay]:
    """The filter's estimates, row by row."""
    thrusts, stds = estimates.output("T")
    for mean, std, thrust, thrust_std in zip(estimates.means, estimates.stds, thrusts, stds, strict=True):
        pairs = [number for pair in zip(mean[:2], std[:2], strict=True) for number in pair]
        yield Overlay(estimates.filter.name, thrust, thrust_std, *pairs)
