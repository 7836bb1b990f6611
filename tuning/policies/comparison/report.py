"""The page of a comparison: tables in Markdown, answers, two pictures."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from thruster_env.core.files import check_target, write_whole
from thruster_env.core.text_tables import markdown_table, with_tables
from tuning.policies.comparison.figures import cost_against_error, learning_curves
from tuning.policies.comparison.plan import Comparison
from tuning.policies.comparison.runs import Result
from tuning.policies.comparison.tables import HEADER, answers, rows_of, summary_rows

PAGE = "policies.md"
CURVES, ERRORS = "policies_curves.png", "policies_errors.png"


def check_page(page: Path) -> None:
    """Raise ValueError unless the tables can be written there: into a new page, or one with a place for them."""
    if page.suffix != ".md":
        raise ValueError(f"a page must be a file that ends in .md, but got {str(page)!r}")
    check_target(page)
    if page.is_file() and not re.search(
        r"<!-- table (summary|answers|policies_\w+) -->", page.read_text(encoding="utf-8")
    ):
        rule = "a page that is there must have a place for a table, such as <!-- table summary --> <!-- end -->"
        raise ValueError(f"{rule}, but {page} has none")


ROUGH = "**Rough**, by `--quick`: it shows that everything runs, not which policy is better."


def write_report(results: Sequence[Result], comparison: Comparison, page: Path, rough: bool = False) -> list[Path]:
    """Write the tables of a page again, and the pictures beside it; return the files.

    A missing page is created. Tables stand between `<!-- table NAME -->` and `<!-- end -->`; rough ones say so.
    """
    tables: dict[str, Callable[[], str]] = {
        f"policies_{noise}": partial(_noise_table, results, noise, rough) for noise in comparison.noises
    }
    tables["summary"] = lambda: markdown_table(["", *comparison.noises], summary_rows(results))
    tables["answers"] = lambda: "\n".join(f"- {sentence}" for sentence in answers(results))
    text = page.read_text(encoding="utf-8") if page.is_file() else _new_page(comparison, list(tables))
    curves = learning_curves(results, page.with_name(CURVES))
    errors = cost_against_error(results, page.with_name(ERRORS))
    write_whole(page, with_tables(text, tables))
    return [page, curves, errors]


def _noise_table(results: Sequence[Result], noise: str, rough: bool) -> str:
    return markdown_table(HEADER, rows_of(results, noise)) + (f"\n\n{ROUGH}" if rough else "")


def _new_page(comparison: Comparison, names: Sequence[str]) -> str:
    counts = f"{comparison.seeds} training seeds; {comparison.episodes} held-out episodes."
    parts = [f"# Policies on raw, filtered and true state\n\n{counts} Thrust errors are in N."]
    parts += [f"<!-- table {name} -->\n<!-- end -->" for name in names]
    parts += [f"![Learning curves]({CURVES})", f"![Cost against the error of what is observed]({ERRORS})"]
    return "\n\n".join(parts) + "\n"
