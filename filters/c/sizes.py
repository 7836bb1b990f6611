"""How many bytes a filter in C takes: its struct, its stack, and its code, as gcc tells."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from filters.c.source import CFilter

CORTEX_M4 = "-mcpu=cortex-m4 -mthumb -mfloat-abi=hard -mfpu=fpv4-sp-d16"
COMPILERS = {"gcc": "", "arm-none-eabi-gcc": CORTEX_M4}  # with arguments
ONE = '#include "{name}.h"\n\nextern {name} a_filter;\n{name} a_filter;\n'  # a global, which is its size


class Sizes(NamedTuple):
    """Bytes of a filter."""

    struct: int
    stack: int  # of the deepest call, without those of math.h
    code: int  # and constants


def sizes_of(made: CFilter, compiler: str = "gcc") -> Sizes | None:
    """The sizes with -Os; None where that compiler of `COMPILERS`, or its `size`, is not installed."""
    size = compiler.removesuffix("gcc") + "size"
    if shutil.which(compiler) is None or shutil.which(size) is None:
        return None
    with TemporaryDirectory() as folder:
        texts = {f"{made.name}.h": made.header, "filter.c": made.source, "one.c": ONE.format(name=made.name)}
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
    own = [stacks.pop(f"{made.name}_{one}", 0) for one in ("init", "predict", "update")]
    tested = stacks.pop("test_update", 0) + stacks.pop("test_channel", 0) + stacks.pop("sound", 0)
    drawn = stacks.pop("draw", 0) + stacks.pop("philox", 0)
    of_prior = max(drawn, stacks.pop("start", 0), stacks.pop("summarise", 0))
    of_update = max((stacks.pop(one) for one in [*stacks] if one.startswith("geometric_mean")), default=0)
    within = (
        stacks.pop("become_prior", 0) + of_prior,
        stacks.pop("correct", 0) + of_update,
        tested,
        *stacks.values(),
    )
    return Sizes(struct, max(own) + max(within), code + data + bss)
