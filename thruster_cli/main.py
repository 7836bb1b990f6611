"""The `thruster` command."""

from __future__ import annotations

import signal
import sys

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


def main() -> None:
    """Run the command line; a user's mistake is one line and exit code 2, never a traceback."""
    caught, before = [], signal.getsignal(signal.SIGINT)

    def interrupt(number, frame):
        caught.append(number)
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, interrupt)
    try:
        code, message = app(standalone_mode=False) or 0, ""
    except (KeyboardInterrupt, typer.Abort):
        code, message = 130, "interrupted"
    except typer.TyperException as error:  # without a command its message is empty: the help has been shown
        code, message = 2, " ".join(error.format_message().split())
    except Exception as error:
        if caught:  # a package that was interrupted while it loaded says so in ways of its own
            code, message = 130, "interrupted"
        elif isinstance(error, ValueError):
            code, message = 2, str(error)
        else:
            raise
    finally:
        signal.signal(signal.SIGINT, before)
    if message:
        print(f"thruster: {message}", file=sys.stderr)
    sys.exit(code)


if __name__ == "__main__":
    main()
