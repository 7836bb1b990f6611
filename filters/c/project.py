"""A folder with a filter in C: sources, headers, a program that filters a log, sizes, and an emulated board.

The board is ARM's MPS2 with the image AN386. Semihosting connects the program's standard input and output to the
emulator's.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Iterable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from filters.c.log_program import log_program
from filters.c.monitor import TestsWriter
from filters.c.programs import FilterPrograms, is_macro, is_name, programs_of
from filters.c.writer import EnsembleWriter, Writer
from filters.filter import Filter
from filters.monitoring import Monitor, monitor_of
from thruster_env.core.files import check_target, write_whole
from thruster_env.model.turns import refuse_rotations

CLASS = """\
/* The filter {name} as a class of C++11; link with {name}.c, which a compiler of C makes. */
#ifndef {guard}_HPP
#define {guard}_HPP

#include "{name}.h"

class {type} {{
public:
    using Real = {real};

    enum {{ states = {guard}_STATES, inputs = {guard}_INPUTS, measurements = {guard}_MEASUREMENTS }};

    /* Begins with the prior{with_key}. */
    {explicit}{type}({of_key}) noexcept {{ reset({by_key}); }}

    void reset({of_key}) noexcept {{ {name}_init(&filter_{and_key}); }}

    /* Predict a step{under}. */
    void predict({u}) noexcept {{ {name}_predict(&filter_{given}); }}

    /* Correct by a measurement; a channel that is NaN is missing. */
    void update(const Real (&z)[measurements]) noexcept {{ {name}_update(&filter_, z); }}

    Real estimate(int state) const noexcept {{ return filter_.x[state]; }}

    Real covariance(int row, int column) const noexcept {{ return filter_.P[row * states + column]; }}

    /* The innovation, its covariance, NIS, and whatever else {name}.h names. */
    const {name} &values() const noexcept {{ return filter_; }}

{tests}private:
    {name} filter_;
}};

#endif
"""


TESTS = """\
    /* Whether no test has raised an alarm of late; tests that raise one now, a sum of {guard}_STUCK, ... */
    bool healthy() const noexcept {{ return filter_.healthy != 0; }}

    unsigned alarms(int channel) const noexcept {{ return filter_.channel[channel].alarms; }}

    /* Begin the tests anew. */
    void test_anew() noexcept {{ {name}_test_anew(&filter_); }}

"""
STAND_IN = "another_name"  # of a filter whose own words are asked for

# Of builds.
CORTEX_M4 = "-mcpu=cortex-m4 -mthumb -mfloat-abi=hard -mfpu=fpv4-sp-d16"
COMPILERS = {"gcc": "", "arm-none-eabi-gcc": CORTEX_M4}  # with arguments
ONE = '#include "{name}.h"\n\nextern {name} a_filter;\n{name} a_filter;\n'  # a global, which is its size
BUILD = (
    "arm-none-eabi-gcc {flags} "
    f"{CORTEX_M4} --specs=rdimon.specs -T board.ld "
    "{name}.c main.c board.c -lm -o {name}.elf"
)
EMULATE = (
    "qemu-system-arm -M mps2-an386 -nographic -monitor none -serial none "
    "-semihosting-config enable=on,target=native -kernel {name}.elf"
)
BOARD_README = """
## On an emulated controller

On a Cortex-M4 that QEMU emulates (gcc-arm-none-eabi and qemu-system-arm of Debian):

    {build}
    {emulate} < log.csv > estimates.csv
"""
LABELS = {"gcc": "this computer's gcc", "arm-none-eabi-gcc": "Cortex-M4"}
DRAWS = """
`{name}_init` takes a key, two words of 32 bits, from which all random numbers of the {members} members follow by
Philox4x32-10. The same key gives the estimates of `filter_.init(key)` in Python; drawing is not counted above.
Members, their random numbers and scratch lie in the struct. `-O3 -fno-math-errno` makes vector instructions of the
loops over members, and leaves the numbers as they are.
"""


def class_of(name: str, programs: FilterPrograms, *, single: bool = False, tested: bool = False) -> str:
    """The header of a class, NameFilter, around the filter in C of this name, which may test its innovations."""
    words = "".join(word.capitalize() for word in name.split("_"))
    inputs, drawn = programs.model.inputs > 0, programs.members > 0
    return CLASS.format(
        name=name,
        guard=name.upper(),
        type=f"{words}Filter",
        real="float" if single else "double",
        under=" under u" * inputs,
        u="const Real (&u)[inputs]" * inputs,
        given=", u" * inputs,
        tests=TESTS.format(name=name, guard=name.upper()) * tested,
        with_key=" and a key: the same one gives the same random numbers" * drawn,
        explicit="explicit " * drawn,
        of_key="uint32_t key_0 = 0, uint32_t key_1 = 0" * drawn,
        by_key="key_0, key_1" * drawn,
        and_key=", key_0, key_1" * drawn,
    )


class CFilter(NamedTuple):
    """A filter in C.

    Attributes:
        name: of its type and its files.
        header: NAME.h.
        source: NAME.c.
    """

    name: str
    header: str
    source: str


HEADERS = frozenset(  # NAME.h would hide them
    "assert complex ctype errno fenv float inttypes iso646 limits locale math setjmp signal stdalign stdarg "
    "stdatomic stdbit stdbool stdckdint stddef stdint stdio stdlib stdnoreturn string tgmath threads time uchar "
    "unistd wchar wctype".split()
)
OF_MATH = (  # and with an f or l behind them
    "acos acosh asin asinh atan atan2 atanh cbrt ceil copysign cos cosh drem erf erfc exp exp10 exp2 expm1 "
    "fabs fdim finite floor fma fmax fmin fmod frexp gamma gamma_r hypot ilogb isinf isnan j0 j1 jn ldexp "
    "lgamma lgamma_r llrint llround log log10 log1p log2 logb lrint lround modf nan nearbyint nextafter "
    "nexttoward pow pow10 remainder remquo rint round roundeven scalb scalbln scalbn significand sin sincos "
    "sinh sqrt tan tanh tgamma trunc y0 y1 yn"
).split()
OF_OTHERS = (
    "fpclassify isfinite isnormal signbit isgreater isgreaterequal isless islessequal islessgreater "
    "isunordered math_errhandling offsetof abort abs alloca atexit atof atoi atol atoll bcmp bcopy bsearch "
    "bzero calloc clearerr ctermid div dprintf drand48 ecvt erand48 exit fclose fcvt fdopen feof ferror "
    "fflush ffs fgetc fgetpos fgets fileno fopen fprintf fputc fputs fread free freopen fscanf fseek fsetpos "
    "ftell fwrite gcvt getc getchar getdelim getenv getline gets getw index initstate jrand48 labs ldiv llabs "
    "lldiv lrand48 malloc mblen mbstowcs mbtowc memccpy memchr memcmp memcpy memmove memset mktemp mrand48 "
    "nrand48 pclose perror popen printf putc putchar putenv puts putw qsort rand random realloc realpath "
    "remove rename rewind rindex scanf select setbuf setenv setstate setvbuf snprintf sprintf srand srandom "
    "sscanf stpcpy strcat strchr strcmp strcoll strcpy strcspn strdup strerror strlen strncat strncmp strncpy "
    "strnlen strpbrk strrchr strsep strsignal strspn strstr strtod strtof strtok strtol strtold strtoll "
    "strtoul strtoull strxfrm system tempnam tmpfile tmpnam ungetc unsetenv valloc vfprintf vfscanf vprintf "
    "vscanf vsnprintf vsprintf vsscanf wcstombs wctomb write read"
).split()
OF_LIBRARIES = frozenset([*OF_OTHERS, *(name + kind for name in OF_MATH for kind in ("", "f", "l"))])
FUNCTIONS = "{0}_init", "{0}_predict", "{0}_update", "{0}_test_anew", "{0}_channel"  # of a filter of this name


def is_taken(name: str, texts: Iterable[str]) -> bool:
    """Whether a name is taken: declared by C libraries or the filter's own files, or ending in _t as types do.

    Args:
        name: of letters, digits and _.
        texts: the files of the same filter under another name.
    """
    if name in OF_LIBRARIES or name in HEADERS or name == "board" or name.endswith("_t") or is_macro(name):
        return True
    used = {word for text in texts for word in re.findall(r"[A-Za-z_]\w*", _strip_comments(text))}
    return not used.isdisjoint([name, *(pattern.format(name) for pattern in FUNCTIONS)])


def _strip_comments(text: str) -> str:
    """C code without its comments, strings and character constants, one of which may be a quote."""
    return re.sub(r"""/\*.*?\*/|"(?:\\.|[^"\\])*"|'(?:\\.|[^'\\])+'""", " ", text, flags=re.S)


def c_filter(
    filter_: Filter, name: str | None = None, *, single: bool = False, monitor: Monitor | None = None
) -> CFilter:
    """A filter as C99, from its page and its model's functions, with the model's numbers in it.

    NAME_init sets the prior, NAME_predict(filter, u) is a step, NAME_update(filter, z) corrects by a measurement
    whose channels may be NaN. The estimates are those of `filters.run` to rounding, restarts included; an ensemble
    draws the same numbers from the same key, which NAME_init takes. The code has fixed sizes, no heap and no
    recursion, and needs math.h alone.

    Args:
        filter_: a filter with a page, so no "gsf", "imm", "mmae", "mhe" or "fuzzy".
        name: of the type, and prefix of all names; the filter's by default.
        single: floats in place of doubles.
        monitor: tests of the innovations, which run after each update.

    Raises:
        ValueError: for another filter, a name that C does not allow, or a model whose functions branch, look
            numbers up, or have too many operations.
    """
    name = filter_.name.replace("-", "_") if name is None else name
    if not is_name(name):
        raise ValueError(f"a name in C must be letters, digits and _, and no keyword, but got {name!r}")
    programs = programs_of(filter_)

    def called(name: str) -> CFilter:
        if monitor is not None and programs.model.measured_turns:
            raise ValueError("alarms in C must be of measurements without rotations, but got some with them")
        tests = None if monitor is None else TestsWriter(monitor, name, programs.model.m, single)
        writer = (EnsembleWriter if programs.members else Writer)(name, programs, single, tests)
        return CFilter(name, writer.header(filter_.name), writer.source())

    _, *texts = called(STAND_IN)
    texts.append(class_of(STAND_IN, programs, single=single, tested=monitor is not None))
    texts.append(log_program(STAND_IN, programs, single=single, tested=monitor is not None))
    if is_taken(name, texts):
        rule = "a name in C must be one that neither its libraries nor the filter's own files use"
        raise ValueError(f"{rule}, but got {name!r}: take another one, such as {name}_filter")
    return called(name)


def _written(texts: dict[str, str], folder: str | Path) -> list[Path]:
    """Write texts by their files' names, none of them unless all can be written; return the files."""
    files = [Path(folder) / name for name in texts]
    for file in files:
        check_target(file)
    for file, text in zip(files, texts.values(), strict=True):
        write_whole(file, text)
    return files


def write_filter(generated: CFilter, folder: str | Path) -> list[Path]:
    """Write a filter's header and source alone; return the files."""
    texts = {f"{generated.name}.h": generated.header, f"{generated.name}.c": generated.source}
    return _written(texts, folder)


class Sizes(NamedTuple):
    """Bytes of a filter."""

    struct: int
    stack: int  # of the deepest call, without those of math.h
    code: int  # and constants


def sizes_of(generated: CFilter, compiler: str = "gcc") -> Sizes | None:
    """The sizes with -Os; None where that compiler of `COMPILERS`, or its `size`, is not installed."""
    size = compiler.removesuffix("gcc") + "size"
    if shutil.which(compiler) is None or shutil.which(size) is None:
        return None
    with TemporaryDirectory() as folder:
        texts = {
            f"{generated.name}.h": generated.header,
            "filter.c": generated.source,
            "one.c": ONE.format(name=generated.name),
        }
        for name, text in texts.items():
            Path(folder, name).write_text(text, encoding="utf-8")
        options = f"-std=c99 -Os -fstack-usage {COMPILERS[compiler]} -c filter.c one.c".split()
        for command in ([compiler, *options], [size, "filter.o", "one.o"]):
            done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
            if done.returncode != 0:
                return None
        (code, data, bss), (_, _, struct) = (
            [int(word) for word in line.split()[:3]] for line in done.stdout.splitlines()[1:]
        )
        lines = Path(folder, "filter.su").read_text(encoding="utf-8").splitlines()
    stacks = {line.split("\t")[0].rsplit(":", 1)[1]: int(line.split("\t")[1]) for line in lines}
    of_calls = [stacks.pop(f"{generated.name}_{function}", 0) for function in ("init", "predict", "update")]
    tested = stacks.pop("test_update", 0) + stacks.pop("test_channel", 0) + stacks.pop("sound", 0)
    drawn = stacks.pop("draw", 0) + stacks.pop("philox", 0)
    of_prior = max(drawn, stacks.pop("start", 0), stacks.pop("summarise", 0))
    of_update = max(
        (stacks.pop(function) for function in [*stacks] if function.startswith("geometric_mean")), default=0
    )
    within = (
        stacks.pop("become_prior", 0) + of_prior,
        stacks.pop("correct", 0) + of_update,
        tested,
        *stacks.values(),
    )
    return Sizes(struct, max(of_calls) + max(within), code + data + bss)


BOARD = """\
extern void _start(void);

static void reset(void)
{
    *(volatile unsigned *)0xE000ED88u |= 0xF00000u; /* the floating-point unit */
    _start();
}

__attribute__((section(".vectors"), used)) static void (*const vectors[])(void) = {
    (void (*)(void))0x20400000u, reset};
"""
MEMORY = """\
ENTRY(_start)
MEMORY
{
    CODE (rx) : ORIGIN = 0x00000000, LENGTH = 4M
    DATA (rwx) : ORIGIN = 0x20000000, LENGTH = 4M
}
SECTIONS
{
    .vectors : { KEEP(*(.vectors)) } > CODE
    .text : { *(.text*) *(.rodata*) KEEP(*(.init)) KEEP(*(.fini)) } > CODE
    .ARM.exidx : { *(.ARM.exidx*) } > CODE
    .data : {
        *(.data*) . = ALIGN(8);
        __preinit_array_start = .; KEEP(*(.preinit_array)) __preinit_array_end = .;
        __init_array_start = .; KEEP(*(.init_array*)) __init_array_end = .;
        __fini_array_start = .; KEEP(*(.fini_array*)) __fini_array_end = .;
    } > DATA
    .bss : { __bss_start__ = .; *(.bss*) *(COMMON) __bss_end__ = .; } > DATA
    end = ALIGN(8);
    __end__ = end;
}
"""


CMAKE = """\
cmake_minimum_required(VERSION 3.10)
project({name} C)

set(CMAKE_C_STANDARD 99)
set(CMAKE_C_EXTENSIONS OFF)
add_library({name} STATIC {name}.c)
target_include_directories({name} PUBLIC ${{CMAKE_CURRENT_SOURCE_DIR}})
target_link_libraries({name} PUBLIC m)
add_executable({name}_log main.c)
target_link_libraries({name}_log PRIVATE {name})
"""
README = """\
# The filter {filter} in C99, {precision} precision

{states}

    cc -std=c99 -O2 {name}.c main.c -lm -o {name}_log
    ./{name}_log < log.csv > estimates.csv

or `cmake -B build && cmake --build build`. Do not compile with -ffast-math, which takes NaN for a number.
`{name}.h` says what each function does; there is no heap and no recursion, and of libraries math.h alone.
`{name}.hpp` is a class of C++11 around it. `main.c` lists the columns of a log; other headers are given,
inputs first: `./{name}_log HEADER ...`.

| bytes with -Os | {compilers} |
|---|{rules}|
| struct | {struct} |
| stack, without that of math.h | {stack} |
| code and constants | {code} |

A prediction is {predict} operations of floating point, an update {update}. With another compiler:
`cc -std=c99 -Os -fstack-usage -c {name}.c && size {name}.o && cat {name}.su`.
{draws}{alarms}{board}"""


def write_project(
    filter_: Filter,
    folder: str | Path,
    name: str | None = None,
    *,
    single: bool = False,
    monitor: Monitor | Mapping | float | None = None,
    board: bool = False,
    dt: float | None = None,
) -> list[Path]:
    """Write a filter in C, a program that filters a log with it, and build instructions; return the files.

    README.md has the bytes of the struct, of the stack and of the code for the compilers that are installed: gcc,
    and arm-none-eabi-gcc for a Cortex-M4.

    Args:
        filter_: as `c_filter` takes it, like the other arguments.
        folder: for the files; made if it is not there.
        name: of the filter; that of its type by default.
        single: floats in place of doubles.
        monitor: tests of the innovations, as wrappers take them.
        board: whether board.c and board.ld are written as well, for a Cortex-M4 that QEMU emulates.
        dt: sample time [s] of logs, whose missing rows the program then predicts; None for any without such rows.

    Raises:
        ValueError: as `c_filter`, for a wrong monitor, or if a file cannot be written.
    """
    refuse_rotations(filter_.model)  # the program's log has a standard deviation of each state
    watch = monitor_of(monitor)
    generated, programs = c_filter(filter_, name, single=single, monitor=watch), programs_of(filter_)
    model = programs.model
    predict, update = programs.operations
    build = BUILD.format(name=generated.name, flags="-std=c99 -O2")
    board_text = BOARD_README.format(build=build, emulate=EMULATE.format(name=generated.name))
    sizes = {
        compiler: measured for compiler in COMPILERS if (measured := sizes_of(generated, compiler)) is not None
    }
    labels = (
        ", ".join(quantity.short_label for quantity in quantities) or "none" for quantities in model.quantities
    )
    about = {
        "name": generated.name,
        "filter": filter_.name,
        "precision": "single" if single else "double",
        "states": "State: {}. Inputs: {}. Measurements: {}.".format(*labels),
        "compilers": " | ".join(LABELS[compiler] for compiler in sizes) or "any",
        "rules": "|".join("--:" for _ in sizes) or "--:",
        **{
            key: " | ".join(str(getattr(size, key)) for size in sizes.values()) or "not measured"
            for key in Sizes._fields
        },
        "predict": predict,
        "update": update,
        "draws": DRAWS.format(name=generated.name, members=programs.members) if programs.members else "",
        "alarms": "" if watch is None else TestsWriter(watch, generated.name, model.m, single).readme,
        "board": board_text if board else "",
    }
    texts = {
        f"{generated.name}.h": generated.header,
        f"{generated.name}.c": generated.source,
        f"{generated.name}.hpp": class_of(generated.name, programs, single=single, tested=watch is not None),
        "main.c": log_program(generated.name, programs, single=single, tested=watch is not None, dt=dt),
        "CMakeLists.txt": CMAKE.format(name=generated.name),
        "README.md": README.format(**about),
        **({"board.c": BOARD, "board.ld": MEMORY} if board else {}),
    }
    return _written(texts, folder)
