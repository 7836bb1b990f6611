"""Progress of long work, in a terminal and in a notebook, on standard error."""

from __future__ import annotations

import importlib.util
import io
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from filters.estimators.foreign import label_of
from thruster_env.core.checks import listening, short_repr

if TYPE_CHECKING:
    from optuna.trial import FrozenTrial

    from tuning.problems.problem import Problem
    from tuning.search.plan import Plan
    from tuning.search.study import OnTrial

CONTROLS = re.compile(r"\x1b\[[^@-~]*[@-~]")  # cursor, colours and the like
ERASED = "\x1b[2K"


class NotebookLine(io.StringIO):
    """A file for a console of rich: the terminal's last line becomes a notebook's output."""

    def __init__(self) -> None:
        """Begin without an output; the first text makes one."""
        super().__init__()
        self._handle: Any = None
        self._line = ""

    def write(self, text: str) -> int:
        """Show the last line of a text, or nothing where lines were erased."""
        lines = [line.rstrip() for line in re.split(r"[\r\n]+", CONTROLS.sub("", text)) if line.strip()]
        if lines or ERASED in text:
            self._show(lines[-1] if lines else "")
        return len(text)

    def isatty(self) -> bool:
        """True: lines are redrawn."""
        return True

    def _show(self, line: str) -> None:
        from IPython.display import display

        if line == self._line:
            return
        self._line, content = line, {"text/plain": line}
        if self._handle is None:
            self._handle = display(content, raw=True, display_id=True)
        else:
            self._handle.update(content, raw=True)


WIDTH = 100  # of a line in a notebook
ShowKinds = Callable[[Sequence[str]], None]


def console_for(progress: bool | None) -> Console:
    """Where progress is shown.

    Args:
        progress: False for none, True for standard error in any case, None for terminals and notebooks.

    Raises:
        ValueError: for anything else.
    """
    if progress not in (True, False, None):
        raise ValueError(f"progress must be True, False or None, but got {short_repr(progress)}")
    console = Console(stderr=True, markup=False, highlight=False)
    shown_live = console.is_terminal or console.is_jupyter
    if console.is_jupyter and importlib.util.find_spec("ipywidgets") is None:  # by which rich draws in notebooks
        options: dict[str, Any] = {"force_jupyter": False, "force_terminal": True, "color_system": None}
        console = Console(file=NotebookLine(), width=WIDTH, markup=False, highlight=False, **options)
    console.quiet = progress is False or (progress is None and not shown_live)
    return console


@contextmanager
def working(text: str, console: Console) -> Iterator[None]:
    """Say what is running, with its progress if known."""
    with console.status(Text(f"{text} ...")) as status:  # names are a user's, and no markup
        with listening(lambda far: status.update(Text(f"{text}: {far}"))):
            yield


@contextmanager
def bar(
    title: str, console: Console, *columns: ProgressColumn, total: float | None = None, **fields: Any
) -> Iterator[Callable[..., None]]:
    """A bar of long work, with further columns before the time that remains; the callback changes its fields."""
    described = TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn()
    with Progress(*described, *columns, TimeRemainingColumn(), console=console) as progress:
        yield partial(progress.update, progress.add_task(title, total=total, **fields))


@contextmanager
def trial_bar(
    plan: Plan, names: str, total: int, before: Sequence[FrozenTrial], console: Console
) -> Iterator[tuple[OnTrial, ShowKinds]]:
    """The callback after each trial of a study, and with the filter types being tried.

    Args:
        plan: of the study.
        names: of its scenarios.
        total: total number of trials.
        before: number of trials already finished.
        console: where it is shown.
    """
    from tuning.search.among_types import filter_types_running

    title, named = f"tuning {{}} on {names}", label_of(plan.filter)
    best_column = TextColumn("best {task.fields[best]}", markup=False)
    done, first_title = min(len(before), total), title.format(named)
    with bar(first_title, console, best_column, total=total, completed=done, best=_best(before, plan)) as update:
        update(completed=done)  # so that no time remains where all trials are done
        finished_trials = done

        def show_kinds(kinds: Sequence[str]) -> None:
            if len(plan.filter_types) > 1:
                update(description=title.format(f"{named} ({', '.join(kinds)})"))

        def advance(study, finished: int) -> None:
            nonlocal finished_trials
            trials, finished_trials = study.get_trials(deepcopy=False), finished
            update(completed=finished, best=_best(trials, plan))
            if running := filter_types_running(trials):
                show_kinds(running)

        from tuning.search.study import STOPPING  # which imports Optuna; `tuning.fit` has a console alone

        def show_rest(far: str) -> None:
            if far == STOPPING:
                update(description=far, refresh=True)
            elif finished_trials >= total:  # what comes after the last trial
                update(description=f"ensemble sizes, {far}" if far.startswith("N: ") else far)

        with listening(show_rest):
            yield advance, show_kinds


def _best(trials: Sequence[FrozenTrial], plan: Plan) -> str:
    """The first objective of the best trial, of a likelihood log L itself; a dash before there is one."""
    from tuning.search.plan import PROPER, reported, reported_name
    from tuning.search.trials import best_trial

    best = best_trial(trials)
    if best is None:
        return "-"
    objective = plan.objectives[0]
    name = f"{reported_name(objective)} " if objective in PROPER else ""
    return f"{name}{reported(objective, best.values[0]):.4g}"


@contextmanager
def row_bar(total: int, console: Console) -> Iterator[Callable[[Problem, str], None]]:
    """The callback before each filter of a comparison runs, with the problem and the filter's label."""
    with bar("comparing ...", console, TimeElapsedColumn(), total=total) as update:
        begun: list[str] = []

        def on_row(problem: Problem, label: str) -> None:
            update(description=f"{label} on {problem.name}", completed=len(begun))
            begun.append(label)

        from tuning.evaluation.compare import TUNING
        from tuning.search.study import STOPPING

        def show(far: str) -> None:
            if far == STOPPING or far.startswith(TUNING):
                update(description=far, refresh=True)

        with listening(show):
            yield on_row
        update(completed=len(begun))
