"""The `thruster` command."""

from __future__ import annotations

import sys

import typer

from thruster_cli import demo, evaluate, inspect, reproduce, simulate, tune

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
app.command("reproduce")(reproduce.command)


@app.callback()
def _callback() -> None:
    pass


def main() -> None:
    """Run the command line; a user's mistake is one line and exit code 2, never a traceback."""
    try:
        sys.exit(app(standalone_mode=False) or 0)
    except typer.TyperException as error:
        message = " ".join(error.format_message().split())
        if message:  # without a command the help has been shown, and there is nothing to add
            print(f"thruster: {message}", file=sys.stderr)
        sys.exit(2)
    except ValueError as error:
        print(f"thruster: {error}", file=sys.stderr)
        sys.exit(2)
    except (KeyboardInterrupt, typer.Abort):
        print("thruster: interrupted", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
