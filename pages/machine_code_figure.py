"""Draw the picture of docs/machine_code.md and take its pieces of code from the program.

    python -m pages.machine_code_figure [FOLDER]

What the page shows as written out for two states is what the thruster's extended Kalman filter is made of: the
script walks down from the filter's kernels through what each function has in its closure.
"""

from __future__ import annotations

import ast
import inspect
import linecache
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path

from filters import ExtendedKalmanFilter
from filters.engine import compile as compiling
from filters.gaussian import extended
from numerics.plots import BLUE, DARK, RUST, new_figure, save_figure
from pages.page import make_page
from thruster_env.model import thruster_model

PREDICTION = "advance", "times", "times_transposed"
SIZE = (9.6, 6.0)  # inches of the picture, and the units in which it is laid out


def inside(function: Callable, *path: str) -> Callable:
    """What a function has in its closure under a name, what that has under the next, and so on."""
    for name in path:
        cells = dict(zip(function.__code__.co_freevars, function.__closure__ or (), strict=True))
        function = cells[name].cell_contents
    return function


def written(function: Callable) -> str:
    """The text that a function was made of, laid out by rows, under who made it."""
    file = function.__code__.co_filename
    maker = file.strip("<>").partition("written out by ")[2].rpartition(", ")[0]  # without the digest of its text
    text = ast.unparse(ast.parse("".join(linecache.getlines(file))))
    body, _, result = text.rpartition("    return ")
    rows = [ast.unparse(row) for row in ast.parse(result).body[0].value.elts] if result.startswith("((") else []
    if len(rows) > 1:  # of a matrix, each on its own line
        result = "(\n" + "".join(f"        {row},\n" for row in rows) + "    )"
    return f"# {maker}\n{body}    return {result}"


def python(text: str) -> str:
    """A block of code in Markdown."""
    return f"```python\n{text}\n```"


def equations() -> str:
    """What the class of the filter says that it does."""
    text = inspect.getdoc(ExtendedKalmanFilter).partition("Source:")[0]
    return f"```text\n{textwrap.dedent(text.partition(chr(10))[2]).strip()}\n```"


def maker() -> str:
    """The function that makes the prediction of mean and covariance."""
    text = inspect.getsource(extended.extended_motion.__wrapped__)
    return python(text.partition("\n")[2].strip())


def prediction() -> str:
    """What the maker found for two states: F P, (F P) F', and P + Q."""
    kernels = ExtendedKalmanFilter(model=thruster_model()).kernels()
    advance = inside(kernels.predict, "advance", "advance")
    parts = [inside(advance, name) for name in PREDICTION[1:]]
    parts.append(inside(kernels.predict, "finish", "settle", "add"))
    return python("\n\n\n".join(written(part) for part in parts))


def correction() -> str:
    """The update for two states and one measurement: S, its root, the gain, the mean, Joseph's form."""
    update = ExtendedKalmanFilter(model=thruster_model()).kernels().update
    condition = inside(update, "correct", "condition")
    paths = (
        ("compare", "silent"),
        ("compare", "p_ht"),
        ("compare", "s_part"),
        ("compare", "present"),
        ("compare", "factor"),
        ("solve",),
        ("apply",),
        ("add",),
        ("reduce", "k_h"),
        ("reduce", "less"),
        ("likelihood",),
    )
    return python("\n\n\n".join(written(inside(condition, *path)) for path in paths))


def operation() -> str:
    """The function around the kernels that is compiled."""
    source = textwrap.dedent(inspect.getsource(compiling.build_operation))
    return python(source.strip())


def picture(path: Path) -> Path:
    """The way from an equation to the processor's cores, with the files that have each station."""
    figure = new_figure(SIZE)
    figure.set_layout_engine("none")
    axis = figure.add_axes((0, 0, 1, 1))
    axis.set(xlim=(0, SIZE[0]), ylim=(0, SIZE[1]))
    axis.axis("off")
    code = {"family": "monospace", "size": 8.5, "color": DARK}

    def station(x, y, width, height, title, where, text, color=BLUE):
        axis.add_patch(_box(x, y, width, height, color))
        axis.text(x + 0.14, y + height - 0.26, title, size=10, weight="bold", color=color)
        axis.text(x + width - 0.12, y + height - 0.26, where, size=7.5, color="#666666", ha="right")
        axis.text(x + 0.14, y + height - 0.42, text, va="top", linespacing=1.35, **code)

    def arrow(start, end, text="", dx=0.1):
        axis.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": "#666666", "lw": 1.2})
        middle = (start[0] + end[0]) / 2 + dx, (start[1] + end[1]) / 2
        axis.text(*middle, text, size=8, color="#444444", va="center")

    station(0.2, 4.95, 4.1, 0.9, "1  Equation", "filters/gaussian", "mean = f(mean, u)\nP    = F P F' + Q")
    station(
        5.3,
        4.95,
        4.1,
        0.9,
        "2  Shape, functions",
        "plants/shape.py",
        "n = 2, m = 1, inputs = 1\nf, df/dx, h, dh/dx",
    )
    station(
        1.6,
        3.45,
        6.4,
        1.08,
        "3  Written out for these sizes, on tuples",
        "numerics/matrices.py, sources.py",
        "a[0][0] * b[0][0] + a[0][1] * b[1][0],   # F P\na[0][0] * b[0][1] + a[0][1] * b[1][1], ...\n"
        "# larger ones: loops over arrays",
    )
    station(
        1.6,
        2.1,
        6.4,
        0.9,
        "4  Kernels: functions that hold functions",
        "filters/engine/belief.py",
        "start(memory, numbers, size)   predict(memory, u, numbers, size)\nupdate(memory, z, numbers, size)",
    )
    arrow((2.6, 4.95), (3.6, 4.53))
    arrow((7.0, 4.95), (6.0, 4.53))
    arrow((4.8, 3.45), (4.8, 3.0), "makers: multiplier(2, 2, 2), symmetric_sum(2), ...")
    axis.add_patch(_box(0.2, 0.15, 9.2, 1.5, RUST))
    axis.text(0.34, 1.39, "5  Compiled by numba, a whole step inlined", size=10, weight="bold", color=RUST)
    axis.text(9.28, 1.39, "filters/engine/compile.py, simd.py", size=7.5, color="#666666", ha="right")
    three = (
        ("operate", "one belief, one step a call:\ninit, predict, update,\nwrappers around an env"),
        ("lanes", "a batch: 32 beliefs side by\nside, eight numbers to a\nvector register; threads"),
        ("batch", "ensembles, particles, large\nmodels: one trajectory after\nthe other; threads"),
    )
    for place, (name, text) in enumerate(three):
        x = 0.36 + 3.06 * place
        axis.text(x, 1.03, name, size=9.5, weight="bold", color=DARK, family="monospace")
        axis.text(x, 0.92, text, size=8.5, color=DARK, va="top", linespacing=1.3)
    for x in (2.0, 4.8, 7.6):
        arrow((x, 2.1), (x, 1.65), "hash of all sources inlined: the cache's key" if x == 4.8 else "")
    return save_figure(figure, path)


def _box(x: float, y: float, width: float, height: float, color: str):
    from matplotlib.patches import FancyBboxPatch

    style = "round,pad=0,rounding_size=0.08"
    return FancyBboxPatch((x, y), width, height, boxstyle=style, facecolor="white", edgecolor=color, linewidth=1.4)


FIGURES = {"machine_code.png": picture}
TABLES = {
    "equations": equations,
    "maker": maker,
    "prediction": prediction,
    "correction": correction,
    "operation": operation,
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    about = "The picture and the code of docs/machine_code.md."
    make_page("machine_code", "pages.machine_code_figure", FIGURES, TABLES, about, arguments)


if __name__ == "__main__":
    main()
