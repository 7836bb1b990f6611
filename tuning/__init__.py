"""Tune state estimators and evaluate the gain: problems, studies, held-out evaluation, identification.

    fit         the model, Q and R of one column of numbers
    tune        find a filter's Q, R and other parameters, and evaluate them on held-out seeds
    verify      whether the metrics in a tuned file hold
    evaluate    a filter, tuned or not, and its baselines, on seeds that no study saw
    compare     several filters on the same seeds, with paired intervals
    estimate    a filter or a smoother over a recorded log
    identify    a model's parameters from recorded runs, and which of them the runs determine
    explore     a page on which one tunes by hand, and sees at once what comes of it
    find_problem   a problem by name, of another thruster, or with constants to estimate
    read_logs   recorded runs, with all that one has to know to read them
    report      a page on a tuned filter that any browser shows
    export      a tuned filter as C code
    train_estimator   an estimator with a network, trained on a problem's runs

Each does what the command of its name does, in one call. A problem is a name, such as "mismatch" or "auv:motion",
a `Problem`, "module:object", or a pair (model, data) of a model and recorded runs.
"""

from __future__ import annotations

import warnings
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tuning.api.compare import compare
    from tuning.api.estimate import estimate
    from tuning.api.evaluate import evaluate
    from tuning.api.explore import explore
    from tuning.api.export import export
    from tuning.api.fit import fit
    from tuning.api.identify import identify
    from tuning.api.problems import find_problem
    from tuning.api.read_logs import read_logs
    from tuning.api.report import report
    from tuning.api.train_estimator import train_estimator
    from tuning.api.tune import SearchSpace, tune
    from tuning.api.verify import verify

warnings.filterwarnings("ignore", message="IProgress not found")  # tqdm's in notebooks: Optuna imports it, unused

__all__ = [
    "SearchSpace",
    "compare",
    "estimate",
    "evaluate",
    "explore",
    "export",
    "find_problem",
    "fit",
    "identify",
    "read_logs",
    "report",
    "train_estimator",
    "tune",
    "verify",
]
OTHER_HOMES = {"SearchSpace": "api.tune", "find_problem": "api.problems"}


def home_of(name: str) -> str:
    """The module of a function."""
    return f"tuning.{OTHER_HOMES.get(name, f'api.{name}')}"


def __getattr__(name: str) -> Any:
    """A function, whose module is imported when it is asked for: `import tuning` alone is light."""
    if name in __all__:
        return getattr(import_module(home_of(name)), name)
    raise AttributeError(f"module 'tuning' has no attribute {name!r}")


def __dir__() -> list[str]:
    """Names of the functions."""
    return sorted([*__all__, *(name for name in globals() if name.startswith("__"))])
