"""`Way`: a published method of tuning, as a value."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from typing import NamedTuple

from filters.registry import filter_type
from thruster_env.core.modules import to_install
from tuning.likelihood.family import check_gradient
from tuning.search.parameters import Q, R
from tuning.search.space import has_search_space
from tuning.ways.correlations import stationary
from tuning.ways.task import Spent, Task, way_out

TRUTH = "truth"  # true states
GRADIENT = "gradient"  # a Kalman filter with derivatives
COVARIANCE = "covariance"  # a filter with a covariance
LINEAR = "linear"  # a linear model with a stationary filter
INFLATION = "inflation"  # an ensemble
NUTPIE = "nutpie"  # the package
NOISE = "noise"  # that Q and R are tuned, and not a model's own parameters
MODEL = "model"  # that some number of the model is tuned


class Way(NamedTuple):
    """A method that finds a filter's numbers."""

    about: str  # what it does, in one sentence
    when: str  # when to use it
    follow: Callable[[Task], None]  # keeps choices of a task until it is done, or the task raises Spent
    source: str
    needs: tuple[str, ...] = ()  # of the above
    # Options of the model's numbers with which it can work.
    options: tuple[str, ...] = ("hold_r", "full_q", "full_r", "prior", "where")
    by_trials: bool = False  # whether it goes on for as many trials as it is given; others end of themselves

    def check(self, name: str, task: Task) -> None:
        """Raise ValueError if a task lacks what the way needs."""
        if not has_search_space(task.filter):
            raise ValueError(f"filter must be one that has something to tune, but got {task.filter!r}")
        if GRADIENT in self.needs:
            check_gradient(task.filter, f"a filter for way {name!r}")
        if COVARIANCE in self.needs and not filter_type(task.filter).has_covariance:
            raise ValueError(f"way {name!r} needs a filter with a covariance, but got {task.filter!r}")
        if INFLATION in self.needs and INFLATION not in filter_type(task.filter).numbers:
            raise ValueError(f"way {name!r} tunes the inflation of an ensemble, but {task.filter!r} has none")
        if TRUTH in self.needs and not task.has_truth:
            pairs = zip(task.problems, task.data, strict=True)
            lacking = next(problem.name for problem, data in pairs if problem.scale is None or data.states is None)
            raise ValueError(f"way {name!r} needs true states, but {lacking} has none")
        if NOISE in self.needs and not {Q, R} <= set(task.start.model):
            raise ValueError(f"way {name!r} tunes Q and R, but {task.problems[0].name} has parameters of its own")
        if MODEL in self.needs and not task.free:
            raise ValueError(
                f"way {name!r} tunes the model, but {task.problems[0].name} has no free parameter of it"
            )
        if LINEAR in self.needs:
            stationary(task.model(task.start), task.problems[0].name, name)
        if NUTPIE in self.needs and importlib.util.find_spec(NUTPIE) is None:
            raise ValueError(f"way {name!r} needs {NUTPIE}, which is not installed: {to_install('nuts')}")
        unable = [option for option, wanted in task.options.items() if wanted and option not in self.options]
        if unable:
            rest = f": P0 is tuned{way_out('P0')}" if "prior" in unable else ""
            raise ValueError(f"way {name!r} must come without {', '.join(unable)}{rest}")

    def run(self, name: str, task: Task, guarded: bool = True) -> None:
        """Follow the way until it is done or the budget spent; ValueError if the task lacks what it needs.

        What it found is `task.best`, and what it would have found for less is `task.kept`. What is worse than the
        start or the model's own numbers is not the answer: these are (`task.refused`).
        """
        self.check(name, task)
        try:
            self.follow(task)
        except Spent:
            pass
        if guarded and not task.stop():  # whoever asks for an end waits for no more
            task.refuse_worse()
