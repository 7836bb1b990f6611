"""The `thruster` command: how it starts, and how it ends in every case.

Exit codes: 0 done; 1 a file whose metrics do not hold (`verify`); 2 the request cannot be carried out, one line
says why; 130 Ctrl-C, which does not cut what is being printed; 141 nobody reads the output any more, as a shell
reports of other programs.

No package is imported before Ctrl-C has its one line.
"""

from __future__ import annotations

import os
import sys
import warnings
from _signal import SIG_IGN, SIGINT, getsignal, signal  # `signal` itself takes milliseconds: Ctrl-C may come

from tuning.cli.interrupts import INTERRUPTED, leave

BROKEN_PIPE = 141


def loads_a_package(frame) -> bool:
    """Whether an import is under way, in which an exception may get lost or leave a package in pieces."""
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            return True
        frame = frame.f_back
    return False


def run() -> None:
    """Run the command line as its own process."""
    signal(SIGINT, leave)
    try:
        _open_standard_streams()
        warnings.formatwarning = _as_one_line
        _leave_full_disks_to_the_main_thread()
        main()
    except KeyboardInterrupt:  # between two lines of `main`
        leave()
    finally:
        _shut_down()


def main() -> None:
    """Run the command line; a user's mistake is one line and exit code 2, never a traceback.

    The first Ctrl-C is a KeyboardInterrupt, so that finished work can be kept; the next one ends the process.
    """
    caught: list[int] = []
    before, unraisable = getsignal(SIGINT), sys.unraisablehook

    def interrupt(number, frame):
        if caught or loads_a_package(frame):
            leave()
        caught.append(number)
        raise KeyboardInterrupt

    def lost(error):  # in a callback, where Python cannot raise it
        if not issubclass(error.exc_type, KeyboardInterrupt):
            return unraisable(error)
        from signal import pthread_kill
        from threading import Timer, main_thread

        caught.clear()
        Timer(0.05, pthread_kill, (main_thread().ident, SIGINT)).start()  # which also wakes it up

    try:
        from thruster_env.core.text_tables import HANDLER

        for stream in (sys.stdout, sys.stderr):  # replace the characters that their encoding lacks
            if hasattr(stream, "reconfigure"):
                stream.reconfigure(errors=HANDLER)
        plain = sys.argv[1:2] == ["new"] and len(sys.argv) == 4 and not any(word[:1] == "-" for word in sys.argv)
        if not plain:
            from tuning.cli.app import app
        sys.unraisablehook = lost
        signal(SIGINT, interrupt)
        code, message = _new(*sys.argv[2:]) if plain else _outcome(app, caught)
        _say(message)
    finally:
        signal(SIGINT, before)
        sys.unraisablehook = unraisable
    sys.exit(code)


def _new(kind: str, name: str) -> tuple[int, str]:
    """Run `thruster new KIND NAME` without Typer, whose imports take longer than all else."""
    from pathlib import Path

    from thruster_env.core.checks import any_case
    from tuning.cli.new import FILES, command
    from tuning.cli.output import emit

    try:
        emit(command(any_case(kind, tuple(FILES)), Path(name)).tables(), {}, None)
        sys.stdout.flush()
        return 0, ""
    except KeyboardInterrupt:
        return INTERRUPTED, "interrupted"
    except ValueError as error:
        return 2, str(error)
    except OSError as error:
        return _system_says(error)


def _outcome(app, caught: list) -> tuple[int, str]:
    import typer

    try:
        try:
            code = app(standalone_mode=False) or 0
            message = "interrupted" if code == INTERRUPTED else ""  # typer keeps the KeyboardInterrupt
        except SystemExit as end:
            if isinstance(end.__context__, BrokenPipeError):  # rich has noticed, and has put the output nowhere
                return BROKEN_PIPE, ""
            code, message = (end.code, "") if isinstance(end.code, int) else (2 if end.code else 0, end.code or "")
        sys.stdout.flush()
        return code, message
    except (KeyboardInterrupt, typer.Abort):
        return INTERRUPTED, "interrupted"
    except typer.TyperException as error:
        return 2, " ".join(error.format_message().split()) or _no_command(error)
    except Exception as error:
        if caught:  # a package that was interrupted says so in ways of its own
            return INTERRUPTED, "interrupted"
        if isinstance(error, ValueError):
            return 2, str(error)
        if isinstance(error, OSError):
            return _system_says(error)
        raise


def _no_command(error) -> str:
    """The message if the help was shown in place of a command."""
    context = getattr(error, "ctx", None)
    path = "thruster" + ("" if context is None else context.command_path.rpartition("thruster")[2])
    return f"a command must follow {path}, but got none ({path} --help lists them)"


def _system_says(error: OSError) -> tuple[int, str]:
    """Exit code and message for what the system refuses, such as disk space."""
    if isinstance(error, BrokenPipeError):
        return BROKEN_PIPE, ""
    reason = error.strerror or str(error)
    if error.filename is None:  # it was open already
        return 2, f"files and standard output must take what is written, but the system says: {reason}"
    return 2, f"a file must be one that can be read and written, but got {error.filename}: {reason}"


def _say(message: str) -> None:
    """Say on standard error why the command ends, and forget what cannot be written.

    Python would try to write it once more at its end, and say that it cannot.
    """
    for stream, text in ((sys.stdout, ""), (sys.stderr, f"thruster: {message}\n" if message else "")):
        try:
            stream.write(text)
            stream.flush()
        except OSError:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, stream.fileno())
            os.close(nowhere)


def _open_standard_streams() -> None:
    """Open those that are closed, or the next file that is opened would stand in for one of them.

    What is written to standard output is then refused, as other programs do; what goes to standard error is lost.
    """
    for number, flags in enumerate((os.O_WRONLY, os.O_RDONLY, os.O_WRONLY)):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, flags)  # takes the lowest number that is free
    sys.stdout = sys.stdout or open(1, "w", encoding="utf-8", closefd=False)
    sys.stderr = sys.stderr or open(2, "w", encoding="utf-8", closefd=False)


def _leave_full_disks_to_the_main_thread() -> None:
    """Ignore an OSError in a thread that writes a log: the thread that fills the log reports it."""
    import threading

    before = threading.excepthook

    def say(arguments):
        if not issubclass(arguments.exc_type, OSError):
            before(arguments)

    threading.excepthook = say


def _shut_down() -> None:
    """Do the first steps of Python's end, in its order, and ignore Ctrl-C in those that follow.

    Python gives up its handlers before it clears its modules; Ctrl-C would then end the process by the signal,
    after all is printed. A signal that is ignored stays so.
    """
    import atexit
    import threading

    threading._shutdown()  # type: ignore[attr-defined]  # waits for threads
    atexit._run_exitfuncs()
    signal(SIGINT, SIG_IGN)


def _as_one_line(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None
) -> str:
    """A warning, without the line of code that raised it."""
    return f"thruster: {message}\n" if category is UserWarning else f"thruster: {category.__name__}: {message}\n"


if __name__ == "__main__":
    run()
