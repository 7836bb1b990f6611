"""A page's stages as programs in C: names, constants, and the error of single precision."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from inspect import cleandoc
from math import prod
from typing import NamedTuple

import numpy as np

from filters.algebra.matrices import Matrix, evaluate
from filters.algebra.operations import factor, quotient
from filters.algebra.points import dot
from filters.engine.batch import run
from filters.engine.belief import memory_offsets
from filters.ensembles.ensemble import EnsembleFilter, check_page_is_all
from filters.filter import Filter, FilterWithPage, PageFilter, with_page
from filters.pages.kernels import MembersMemory, numbers_of, stages_of
from filters.pages.kernels import member_stages_of as stages_of_members
from filters.pages.page import Equations, RowMemory
from thruster_env.core.angles import difference, wrapped_where
from thruster_env.core.streams import (
    FILTER_MEASUREMENT,
    FILTER_PRIOR,
    FILTER_PROCESS,
    GROUP,
    fill_normals,
    filter_keys,
)
from thruster_env.graphs.folding import as_single
from thruster_env.graphs.graphs import Graph, TooLarge
from thruster_env.graphs.programs import BY_MEMBERS, Place, Program, program_of, work_names
from thruster_env.model.shape import LANES, Shape, padded
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.traced import Traced, most_operations

KEYWORDS = frozenset(  # of C99 to C23 and C++20, and tokens that C++ writes as words
    "alignas alignof and and_eq asm auto bitand bitor bool break case catch char char8_t char16_t char32_t class "
    "co_await co_return co_yield compl concept const const_cast consteval constexpr constinit continue decltype "
    "default delete do double dynamic_cast else enum explicit export extern false float for friend goto if inline "
    "int long main mutable namespace new noexcept not not_eq nullptr operator or or_eq private protected public "
    "register reinterpret_cast requires restrict return short signed sizeof static static_assert static_cast std "
    "struct switch template this thread_local throw true try typedef typeid typename typeof typeof_unqual union "
    "unsigned using virtual void volatile wchar_t while xor xor_eq".split()
)
MACROS = re.compile(
    "NAN|INFINITY|NULL|EOF|BUFSIZ|FILENAME_MAX|FOPEN_MAX|MB_CUR_MAX|MAXFLOAT|I|DOMAIN|SING|OVERFLOW|UNDERFLOW|PLOSS|"
    "TLOSS|linux|unix|i386|errno|stdin|stdout|stderr|signgam|assert|"
    "P_tmpdir|L_(tmpnam|ctermid|cuserid)|(HUGE_VAL|SNAN)[A-Z0-9]*|"
    "(FP|M|MATH|SEEK|EXIT|RAND|TMP|SIZE|PTRDIFF|SIG|WCHAR|WINT|FLT|DBL|LDBL)_[A-Z0-9_]*|"
    "(U?INT(PTR|MAX|(_LEAST|_FAST)?(8|16|32|64))|U?CHAR|U?SHRT|U?INT|U?L?LONG)_[A-Z]+"
)


def is_name(text: str) -> bool:
    """Whether text is letters, digits and _, begins with a letter, and is no keyword of C or C++."""
    return bool(re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", text, flags=re.ASCII)) and text not in KEYWORDS


def is_macro(text: str) -> bool:
    """Whether headers of C replace a name by something else."""
    return bool(MACROS.fullmatch(text))


NIS = -1  # its place in a row, where machine code has none
RESERVED = frozenset(  # names in the struct of every filter in C, and of its tests
    "x P innovation S nis log_likelihood channels restarts channel healthy tested alarmed".split()
)


class Scalar(Place):
    """Where a number lies that is no array's."""

    __slots__ = ()

    def __str__(self) -> str:
        return self.array


class FilterPrograms(NamedTuple):
    """The functions of a filter as programs whose places are expressions of C.

    Attributes:
        start: the filter's extras at the prior; of an ensemble the members.
        represent: X, which is predicted in place of mean and covariance: points in a row, or a mean and a root.
        propagate: a substep under u of the belief or of X; of one point, x; of all members of an ensemble.
        add_process_noise: the belief at the end of a step.
        update: the belief after z, the innovation, its covariance and its log-likelihood.
        summarise: mean and covariance of an ensemble.
        extras: shapes of the extras that the filter keeps, by name.
        predicted_size: how many numbers X has.
        points: how many points X has, if they are propagated one by one; else 0.
        members: how many members an ensemble has; else 0.
        model: the filter's model.
        about: the filter's equations and their source, for the header's comment.
    """

    start: Program
    represent: Program
    propagate: Program
    add_process_noise: Program
    update: Program
    summarise: Program
    extras: Mapping[str, tuple[int, ...]]
    predicted_size: int
    points: int
    members: int
    model: StateSpaceModel
    about: str

    @property
    def all(self) -> tuple[Program, ...]:
        """The programs."""
        return self[:6]

    @property
    def operations(self) -> tuple[int, int]:
        """Numbers of operations of a prediction and of an update, without those of random numbers."""
        represent, propagate, add_process_noise, update, summarise = (
            sum(self.members if number.member else 1 for number in program.works) for program in self[1:6]
        )
        substeps = self.model.substeps * max(self.points, 1)
        return represent + substeps * propagate + add_process_noise + summarise, update


def about(kind: type) -> str:
    """A filter's equations and sources: the paragraphs of its docstring before "Attributes:", and on sources."""
    equations, _, rest = cleandoc(kind.__doc__ or "").partition("\n\nAttributes:")
    sources = [text for text in rest.split("\n\n") if text.startswith("Source")]
    return "\n\n".join([equations, *sources])


def programs_of(filter_: Filter) -> FilterPrograms:
    """The programs of a filter.

    Raises:
        ValueError: for a filter without a page, random rotations, a model whose functions cannot be traced or are
            too large, or a page that keeps something under a name that C does not take.
    """
    paged = with_page(filter_, "a filter in C")
    model = paged.kernel_model
    shape = model.any_shape if isinstance(paged, PageFilter) and paged.takes_rotations else model.shape
    f, by_f, h, by_h = model.functions
    try:
        _check_traced("transition", f, by_f, "motion", shape)
        _check_traced("observe", h, by_h, "sight", shape)
        return _member_programs(paged) if isinstance(paged, EnsembleFilter) else _row_programs(paged)
    except TooLarge as error:
        raise ValueError(f"a filter in C must have few operations, but got a model for which {error}") from error


def _row_programs(paged: FilterWithPage) -> FilterPrograms:
    model, page, numbers = paged.kernel_model, paged.written_page, paged.numbers
    shape = model.any_shape
    layout, memory = memory_offsets(shape.n, shape.m, shape.t), RowMemory(shape, page)
    equations = Equations(model.functions, memory, constants_move=False, trace=True)
    stages = [stage.of_rows for stage in stages_of(page, memory, equations)]
    extras = {name: matrix.shape for name, matrix in memory.extras.items()}
    if wrong := [name for name in extras if name in RESERVED or not is_name(name) or is_macro(name)]:
        raise ValueError(f"a quantity of a filter in C must have an unused name, but got {wrong[0]!r}")
    predicted_size = memory.end - layout.extras - sum(prod(size) for size in extras.values())
    points = _points_of(stages[2], equations, memory, predicted_size)
    if points:
        stages[2] = {layout.mean: equations.f(memory.x, memory.u)}
    stages[4][NIS] = _nis(stages[4][layout.innovation], stages[4][layout.innovation_cov])
    extra_parts = [
        *((matrix.operation.at, matrix.shape, f"filter->{name}") for name, matrix in memory.extras.items()),
        (memory.end - predicted_size, (predicted_size,), "X"),
    ]
    means = ["filter->x"] * 2 + ["x" if points else "filter->x"] + ["filter->x"] * 2
    start, represent, propagate, add_process_noise, update = (
        _program(
            {Place("rows", at): matrix for at, matrix in stage.items()},
            lies,
            numbers,
            Graph(most_operations(shape)),
        )
        for stage, mean, argument in zip(stages, means, "uuuuz", strict=True)
        for lies in [_where(shape, mean, argument, extra_parts, points)]
    )
    programs = start, represent, propagate, add_process_noise, update, Program([], [], [])
    return FilterPrograms(*programs, extras, predicted_size, points, 0, model, about(type(paged)))


def _member_programs(paged: EnsembleFilter) -> FilterPrograms:
    check_page_is_all(paged, "in C")
    model, page, numbers, size = paged.kernel_model, paged.written_page, paged.numbers, paged.size
    shape, memory = model.shape, MembersMemory(model.shape, page)
    stages = stages_of_members(page, memory, Equations(model.functions, memory, constants_move=False, trace=True))
    outputs = {target: matrix for name in stages for target, matrix in stages[name].stores[0]}
    layout = memory_offsets(shape.n, shape.m)
    v, s = (outputs[Place("rows", at)] for at in (layout.innovation, layout.innovation_cov))
    stages["update"].values[Place("rows", NIS)] = _nis(v, s)
    extras = {name: matrix.shape for name, matrix in memory.extras.items()}
    extra_parts = [(extra.operation.at, extra.shape, f"filter->{name}") for name, extra in memory.extras.items()]
    represent = Program([], [], [])
    start, propagate, add_process_noise, update, summarise = (
        _program(dict(stages[name].stores[0]), lies, numbers, Graph(most_operations(shape), size))
        for name, argument in (
            ("start", "u"),
            ("propagate", "u"),
            ("add_process_noise", "u"),
            ("update", "z"),
            ("summarise", "z"),
        )
        for lies in [_where(shape, "filter->x", argument, extra_parts)]
    )
    programs = start, represent, propagate, add_process_noise, update, summarise
    return FilterPrograms(*programs, extras, 0, 0, size, model, about(type(paged)))


def _nis(v: Matrix, s: Matrix) -> Matrix:
    return dot(v, quotient(v, factor(s)))


def _check_traced(name: str, function: Callable, jacobian: Callable | None, which: str, shape: Shape) -> None:
    """Raise ValueError that names the function if it cannot be traced."""
    try:
        Traced(function, jacobian, which, shape)
    except TooLarge:
        raise
    except Exception as error:  # whatever a user's function raises
        raise ValueError(
            f"{name} must consist of arithmetic and functions of math or numpy, with a few branches at most, but "
            f"{getattr(function, '__name__', 'it')} raised {type(error).__name__}: {str(error).splitlines()[0]}"
        ) from error


def _points_of(
    propagate: Mapping[int, Matrix], equations: Equations, memory: RowMemory, predicted_size: int
) -> int:
    """How many points a substep propagates by f alone; 0 if it has other operations."""
    (at, propagated), *rest = propagate.items()
    if predicted_size == 0 or rest or not propagated.of or propagated.of[0].operation != Place("rows", at):
        return 0
    return propagated.shape[1] if propagated is equations.f(propagated.of[0], memory.u) else 0


def _where(
    shape: Shape,
    mean: str,
    argument: str,
    extra_parts: Sequence[tuple[int, tuple[int, ...], str]],
    points: int = 0,
) -> Callable[[Place], Place]:
    """The function from a place to its expression in C: in the filter, in X, or in the argument u or z."""
    n, m, t = shape.n, shape.m, shape.t
    layout = memory_offsets(n, m, t)
    parts = [
        (NIS, (), "filter->nis"),
        (layout.mean, (n,), mean),
        (layout.cov, (t, t), "filter->P"),
        (layout.innovation, (m,), "filter->innovation"),
        (layout.innovation_cov, (m, m), "filter->S"),
        (layout.log_likelihood, (), "filter->log_likelihood"),
        *extra_parts,
    ]

    def lies(source: Place) -> Place:
        if source.array == "given":
            return Place(argument, source.at)
        if source.array in BY_MEMBERS:
            return source
        first, size, name = next(part for part in parts if 0 <= source.at - part[0] < prod(part[1]))
        at = source.at - first
        if name == "X" and points:  # one behind the other
            row, column = divmod(at, points)
            at = column * n + row
        return Place(name, at) if size else Scalar(name, at)

    return lies


def _program(
    stage: Mapping[Place, Matrix], lies: Callable[[Place], Place], numbers: np.ndarray, graph: Graph
) -> Program:
    def number(source: Place, **of_member: bool):
        if source.array == "numbers":
            return graph.constant(numbers[source.at])
        return graph.given(lies(source), **of_member)

    wanted, stores = list(stage.values()), []
    for (array, first), value in zip(stage, evaluate(wanted, numbers_of(wanted, number)), strict=True):
        for k, entry in enumerate(np.ravel(np.array(value, dtype=object))):
            stores.append((lies(Place(array, first + k)), graph.number(entry)))
    return program_of(stores, {})


class _Single:
    """In place of `float` in a program's text."""

    @staticmethod
    def fromhex(text: str) -> np.float32:
        return np.float32(as_single(float.fromhex(text)))


def single_error(filter_: Filter, programs: FilterPrograms, inputs: np.ndarray, z: np.ndarray) -> float:
    """The largest difference between estimates in single and double precision, in standard deviations.

    Args:
        filter_: the filter.
        programs: its programs.
        inputs: u of a run, (K, p).
        z: its measurements, (K + 1, m).
    """
    key = filter_keys([0])
    exact = run(filter_, key, inputs[None], z[None])
    stds = np.sqrt(np.einsum("kii->ki", exact.covs[0]))
    with np.errstate(all="ignore"):
        means = _means(programs, key[0], inputs.astype(np.float32), z.astype(np.float32))
    off = abs(difference(means, exact.means[0], programs.model.shape.state_angles))
    return float(np.max(off / np.where(stds > 0, stds, 1.0)))


def _means(programs: FilterPrograms, key: np.ndarray, inputs: np.ndarray, z: np.ndarray) -> np.ndarray:
    model, n, m = programs.model, programs.model.n, programs.model.m
    start, represent, propagate, add_process_noise, update, _ = map(_compile_program, programs.all)
    names = {**work_names(), "float": _Single, "X": np.zeros(programs.predicted_size, np.float32)}
    names |= {"P": model.prior_cov.ravel().astype(np.float32), "S": np.zeros(m * m, np.float32)}
    names |= {name: np.zeros(prod(shape), np.float32) for name, shape in programs.extras.items()}
    x = names["x"] = wrapped_where(model.prior_mean, model.shape.state_angles).astype(np.float32)
    names["innovation"], means = np.zeros(m, np.float32), []
    size, width = programs.members, padded(programs.members, LANES)
    names |= {"size": size, "table": np.zeros((n, size), np.float32)}

    def draw(stream: int, step: int, rows: int) -> None:
        normals = np.empty(padded(rows * width, GROUP))
        fill_normals(normals, rows * width * (size > 0), step, stream, *key)
        names["draws"] = normals[: rows * width].reshape(rows, width)[:, :size].astype(np.float32)

    draw(FILTER_PRIOR, 0, n)
    exec(start, names)
    for k in range(len(z)):
        if k > 0:
            names["u"] = inputs[k - 1]
            exec(represent, names)
            for _ in range(model.substeps):
                for point in names["X"].reshape(-1, n) if programs.points else [x]:
                    exec(propagate, names | {"x": point})
            draw(FILTER_PROCESS, k, n)
            exec(add_process_noise, names)
        names["z"] = z[k]
        draw(FILTER_MEASUREMENT, k, m)
        exec(update, names)
        means.append(x.astype(np.float64))
    return np.array(means)


def _compile_program(program: Program):
    text = "\n".join(program.text).replace("filter->", "")
    return compile(text, "<a filter in single precision>", "exec")
