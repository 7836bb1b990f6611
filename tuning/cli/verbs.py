"""Make the commands of the verbs: `thruster evaluate` from the function `tuning.evaluate`, and so on.

Types and defaults of options are those of the signature, their help is that of the docstring, and the rest stands
in the markers of `tuning.api.markers`. What a command prints and writes is the `Result` of the function; a page
that is served has `serve()` instead.
"""

from __future__ import annotations

import builtins
import inspect
import re
import sys
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from inspect import Parameter
from os import fspath
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Union, get_args, get_origin, get_type_hints

import typer

from thruster_env.core.checks import any_case, short_repr
from tuning.api.markers import (
    OUTPUT,
    READ,
    UNSET,
    WRITTEN,
    Argument,
    Group,
    LogsArgument,
    Option,
    ProblemOption,
    PythonOnly,
)
from tuning.api.result import Result, check_page
from tuning.cli.output import check_targets, emit

SHARED = {"preset", "model"}  # of recorded runs, and of tuned files
CHANGES = {"preset", "augment"}  # of a problem that is named
READING = "reading"
SAME, AGAIN = "The same as the argument.", "_again"
SIMPLE = (bool, int, float, str, Path)


def spelt(choices: Iterable[str]) -> Callable:
    """A callback for an option or argument that accepts names of choices in upper or lower case."""
    known = tuple(choices)

    def callback(value):
        return [any_case(choice, known) for choice in value] if isinstance(value, list) else any_case(value, known)

    return callback


def names_in(choices: str) -> tuple[Sequence[str], str]:
    """The names in a list, and what follows the description of a parameter whose value is such a name."""
    if choices == "filters":
        from filters.registry import FILTERS

        return [*FILTERS, "auto"], ""
    if choices == "presets":
        from thruster_env.thruster.parameters import PRESETS

        return [*PRESETS], f"{', '.join(PRESETS)}, or a FILE.toml of `thruster new preset` or `thruster identify`."
    if choices == "sensors":
        from thruster_env.thruster.parameters import CHANNELS

        return [*CHANNELS], f"{', '.join(CHANNELS)}."
    if choices == "objectives":
        from tuning.search.plan import OBJECTIVES  # which imports optuna

        return [*OBJECTIVES], f"{', '.join(OBJECTIVES)}, output:SYMBOL."
    from tuning.problems.find import built_in

    code = "module:object: a tuning.problems.problem.Problem, or a function that returns one."
    return [*built_in()], f"{', '.join(built_in())}, a .toml file, or {code}"


class Part(NamedTuple):
    """An option or argument of a command."""

    parameter: Parameter  # with Typer's annotation
    marker: Option
    default: Any  # of the function
    option: str  # how one sets it: --filter, or the word of an argument
    group: str = ""  # READING if it is one of `read_logs`, or the parameter whose value is made of several options

    def is_set(self, value: Any) -> bool:
        """Whether a value differs from the default."""
        return value is not None and value != [] and value != self.default


def command_of(verb: Callable, **chosen: Any) -> Callable:
    """The function that Typer calls for a verb, with the verb's options as its signature, and arguments chosen."""
    parts, fixed = parts_of(verb)
    fixed |= chosen
    help_text = "Also write the result as JSON; - for standard output."
    json = typer.Option("--json", metavar="FILE", help=help_text, rich_help_panel=OUTPUT)
    of_result, returned = [], hints_of(verb)["return"][0]
    if has_figures(returned):
        help_text = "Also write a page with all tables and figures, and the tables as Markdown beside it."
        report = typer.Option("--report", metavar="FILE.html", help=help_text, rich_help_panel=OUTPUT)
        of_result.append(parameter_of("report", Path | None, report, None))
    is_served = hasattr(returned, "serve")  # until one ends it, so that it has no JSON
    of_result += [] if is_served else [parameter_of("json", str | None, json, None)]

    def command(**values: Any) -> None:
        target, page = values.pop("json", None), values.pop("report", None)
        arguments = arguments_of(verb, parts, values)
        written = [*files_of(parts, values, WRITTEN), *([] if page is None else [check_page(page)])]
        check_targets(written, target, read=files_of(parts, values, READ))
        result = verb(**fixed, **arguments)
        if is_served:
            result.serve()
        else:
            pages = [] if page is None else [f"Page: {fspath(result.report(page))}"]
            emit([*result.tables(), *pages], result.document() if target else {}, target)
        if code := getattr(result, "exit_code", 0):
            sys.exit(code)

    taking: Any = command
    taking.__signature__ = inspect.Signature([*(part.parameter for part in parts), *of_result])
    taking.__annotations__ = {name: part.annotation for name, part in taking.__signature__.parameters.items()}
    taking.__doc__ = shell_text(described(verb)[0], parts)
    return taking


def has_figures(returned: Any) -> bool:
    """Whether results of a class have figures of their own."""
    return isinstance(returned, type) and issubclass(returned, Result) and returned.figures is not Result.figures


def parts_of(verb: Callable, last: str = "") -> tuple[list[Part], dict[str, Any]]:
    """The options of a function's parameters, up to the `last` one, and the values of those without an option."""
    parts: list[Part] = []
    fixed: dict[str, Any] = {}
    texts, hints, parameters = described(verb)[1], hints_of(verb), inspect.signature(verb).parameters
    for name, parameter in parameters.items():
        kind, marker = hints[name]
        if isinstance(marker, PythonOnly) or parameter.kind is Parameter.VAR_KEYWORD:
            fixed |= {} if getattr(marker, "value", UNSET) is UNSET else {name: marker.value}
            continue
        if isinstance(marker, Group):
            parts += [part._replace(group=name) for part in parts_of(marker.of)[0]]
            continue
        text = texts.get(name, "")
        if isinstance(marker, LogsArgument):
            from tuning.api.read_logs import read_logs

            text = f"{text} {described(read_logs)[1]['files']}"
        parts += parts_of_parameter(parameter, kind, marker, text)
        if isinstance(marker, LogsArgument | ProblemOption):
            from tuning.api.read_logs import read_logs

            files, *of_logs = parts_of(read_logs, marker.last)[0]
            if isinstance(marker, ProblemOption):
                kind, info = get_args(files.parameter.annotation)
                info.help = f"Instead of a problem: {info.help[:1].lower()}{info.help[1:]}"
                of_logs.insert(0, files._replace(parameter=parameter_of("log", kind | None, info, None)))
            parts += [part._replace(group=READING) for part in of_logs if part.parameter.name not in parameters]
        if name == last:
            break
    for part in parts:
        info = get_args(part.parameter.annotation)[1]
        info.help = shell_text(info.help, parts)
    return parts, fixed


def parts_of_parameter(parameter: Parameter, kind: Any, marker: Option, text: str) -> list[Part]:
    """A parameter as Typer declares it: an option or an argument, or an argument that an option may name."""
    kind = simplified(kind) if marker.type is None else marker.type
    default = parameter.default if marker.default is UNSET else marker.default
    default = None if isinstance(marker, ProblemOption) else default
    if default == () or (get_origin(kind) is list and default is not Parameter.empty):
        default = None  # the docstring says what is taken then
    kind = kind | None if default is None else kind
    choices, listed = marker.choices, marker.listed
    if isinstance(choices, str):
        choices, listed = names_in(choices)
    elif choices is not None and text.endswith(":") and not listed:
        listed = f"{', '.join(choices)}."
    options: dict[str, Any] = {"metavar": marker.metavar, "min": marker.least, "max": marker.most}
    options |= {
        "callback": None if choices is None else spelt(choices),
        "help": f"{text.rstrip('.:')}: {listed}" if listed else text,
    }
    names = marker.names or (f"--{parameter.name.replace('_', '-')}",)
    option = names[-1].rpartition("/")[2]
    info = typer.Option(*names, rich_help_panel=marker.panel, **options)
    if isinstance(marker, Argument):
        option, info = marker.metavar or parameter.name.upper(), typer.Argument(**options)
    parts = [Part(parameter_of(parameter.name, kind, info, default), marker, parameter.default, option)]
    if isinstance(marker, Argument) and marker.names:
        options |= {"help": SAME, "rich_help_panel": marker.panel}
        again = typer.Option(*names, **options)
        parts.append(parts[0]._replace(parameter=parameter_of(parameter.name + AGAIN, kind, again, None)))
    return parts


def parameter_of(name: str, kind: Any, info: Any, default: Any) -> Parameter:
    """A parameter of a command in Typer's form."""
    return Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, info])


def arguments_of(verb: Callable, parts: Sequence[Part], values: Mapping[str, Any]) -> dict[str, Any]:
    """The function's arguments: those that are set, and recorded runs in place of the options on them."""
    chosen = {part.parameter.name: part for part in parts if part.is_set(values[part.parameter.name])}
    arguments = {name: values[name] for name, part in chosen.items() if not part.group}
    reading = {name: values[name] for name, part in chosen.items() if part.group == READING}
    for name in [name for name in arguments if name.endswith(AGAIN)]:
        first, again = arguments.get(name.removesuffix(AGAIN)), arguments.pop(name)
        if isinstance(again, list):
            again = [*(first or []), *again]
        elif first is not None:
            option = chosen[name].marker.names[0]
            raise ValueError(f"a tuned file must be one, but got {first} and {option} {again}")
        arguments[name.removesuffix(AGAIN)] = again
    for name, parameter in inspect.signature(verb).parameters.items():
        marker = hints_of(verb)[name][1]
        if isinstance(marker, LogsArgument) and name in arguments:
            from tuning.api.read_logs import read_logs

            arguments[name] = read_logs(arguments[name], **reading)
        elif isinstance(marker, ProblemOption):
            problem_in(arguments, name, marker, reading, chosen)
        elif isinstance(marker, Group):
            fields = {key: values[key] for key, part in chosen.items() if part.group == name}
            arguments |= {name: marker.of(**fields)} if fields else {}
        elif getattr(marker, "unset", UNSET) is not UNSET and parameter.name not in arguments:
            arguments[name] = marker.unset
    return arguments


def problem_in(
    arguments: dict[str, Any], name: str, marker: Option, reading: dict[str, Any], chosen: Mapping[str, Part]
) -> None:
    """Put the problem that is named, or that of recorded runs, in its place among the arguments."""
    if files := reading.pop("log", None):
        if name in arguments:
            got = f"both, {files[0]} and {arguments[name]}"
            raise ValueError(f"a problem must be of --log or of --problem, but got {got}")
        from tuning.api.read_logs import read_logs

        shared = {key: arguments.pop(key) for key in SHARED & arguments.keys()}
        arguments[name] = read_logs(files, **reading, **shared)
        return
    changes = {key: reading.pop(key) for key in CHANGES & reading.keys()}
    if reading:
        first, value = next(iter(reading.items()))
        option = chosen[first].option
        got = option if isinstance(value, bool) else f"{option} {short_repr(value)}"
        raise ValueError(f"{option} must come with --log, but got {got} without one")
    if name not in arguments and marker.default is not UNSET:
        arguments[name] = marker.default
    if changes:
        from tuning.api.problems import find_problem  # which imports optuna

        names = arguments[name] if isinstance(arguments[name], list) else [arguments[name]]
        arguments[name] = [find_problem(each, **changes) for each in names]


def files_of(parts: Sequence[Part], values: Mapping[str, Any], role: str) -> list:
    """Paths that a command reads or writes."""
    groups = [values[part.parameter.name] for part in parts if part.marker.file == role]
    return [path for group in groups for path in (group if isinstance(group, list) else [group])]


def described(function: Callable) -> tuple[str, dict[str, str]]:
    """The text of a Google docstring without programs, and the descriptions of the arguments by name."""
    text, rest, *_ = [*re.split(r"\n\n(?:Args|Attributes):\n", inspect.getdoc(function) or ""), ""]
    body = [part for part in text.split("\n\n") if not part.startswith("    ")]
    descriptions: dict[str, str] = {}
    for line in rest.partition("\n\n")[0].splitlines():
        if match := re.match(r"    \**(\w+): (.*)", line):
            name, descriptions[match[1]] = match[1], match[2]
        else:
            descriptions[name] += f" {line.strip()}"
    return "\n\n".join(body), {key: shell_text(value) for key, value in descriptions.items()}


def shell_text(text: str, parts: Sequence[Part] = ()) -> str:
    """A text of a docstring for the command line: options in place of parameters, nothing on Python alone."""
    text = re.sub(r" ?\bIn Python.*?[.](?= [A-Z]|\s*$)", "", text)
    for part in parts:
        text = text.replace(f"`{part.parameter.name}`", f"`{part.option}`")
    return text[:1].upper() + text[1:]


def hints_of(function: Callable) -> dict[str, tuple[Any, Any]]:
    """The type of each parameter and its marker; names that only a type checker imports count as any type."""
    hints = get_type_hints(function, {}, Names(vars(sys.modules[function.__module__])), include_extras=True)
    pairs = {
        name: (get_args(hint) if get_origin(hint) is Annotated else (hint, Option()))
        for name, hint in hints.items()
    }
    return {name: (pair[0], pair[1]) for name, pair in pairs.items()}


class Names(dict):
    """Names of a module, and any type for names that it lacks."""

    def __missing__(self, name: str) -> Any:
        return getattr(builtins, name, Any)


def simplified(hint: Any) -> Any:
    """The type of an option: of a union the first that a command line can express, a list for a sequence."""
    if hint in SIMPLE or get_origin(hint) is tuple:
        return hint
    if get_origin(hint) in (Union, types.UnionType):
        return next((kind for kind in map(simplified, get_args(hint)) if kind is not None), None)
    if get_origin(hint) in (list, Sequence):
        return types.GenericAlias(list, simplified(get_args(hint)[0]))
    return None
