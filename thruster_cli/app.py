"""The sub-commands of `thruster`, put together."""

from __future__ import annotations

import typer

from thruster_cli import (
    compare,
    demo,
    evaluate,
    filters,
    inspect,
    play,
    report,
    reproduce,
    score,
    simulate,
    study,
    train,
    tune,
    verify,
)

app = typer.Typer(
    help="A ship's bow thruster, the filters that estimate its hidden state, and the tuning that makes them good.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
)
app.command("demo")(demo.command)
app.command("inspect")(inspect.command)
app.command("simulate")(simulate.command)
app.command("tune")(tune.command)
app.command("evaluate")(evaluate.command)
app.command("report")(report.command)
app.command("verify")(verify.command)
app.command("compare")(compare.command)
app.command("filters")(filters.command)
app.command("reproduce")(reproduce.command)
app.command("train")(train.command)
app.command("play")(play.command)
app.command("score")(score.command)
app.add_typer(study.app, name="study")


@app.callback()
def _callback() -> None:
    pass
