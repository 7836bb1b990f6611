"""Make the table of docs/tuning.md on problems of users.

    python -m pages.users_tables [FOLDER]

If there is a tuning.md in FOLDER, docs/ by default, its table and what it says are written anew. That takes about
an hour on one core; what `thruster study users` has left in out/users is not done again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

from pages.page import make_page
from tuning.experiments.users.runs import Case, Panel, run_panel
from tuning.experiments.users.tables import markdown, sentences

RESULTS = Path("out") / "users"


@cache
def cases() -> tuple[Case, ...]:
    """All cases of the panel."""
    return tuple(run_panel(Panel(), RESULTS))


def users() -> str:
    """Scores of tuned filters over those of each baseline, a row per problem and filter."""
    return markdown(cases())


def losses() -> str:
    """How often tuning lost, and where."""
    return "\n".join(f"- {sentence}" for sentence in sentences(cases()))


TABLES: dict[str, Callable[[], str]] = {"users": users, "users_losses": losses}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    make_page("tuning", "pages.users_tables", {}, TABLES, __doc__.splitlines()[0], arguments)


if __name__ == "__main__":
    main()
