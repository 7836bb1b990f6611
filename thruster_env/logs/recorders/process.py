"""Files that are read in another process, because their libraries, in C, crash on some damaged files."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from thruster_env.logs.recorders import topics
from thruster_env.logs.recorders.topics import Refused

SCRIPT = Path(__file__).with_name("process_script.py")
KINDS = "biufmM"  # NumPy's, of what comes as bytes


class Opened:
    """A file that another process has opened.

    Attributes:
        contents: of the file, as the other process describes them.
    """

    def __init__(self, child: subprocess.Popen, form: str, path: Path):
        self._child, self._path = child, path
        files = sorted(path.rglob("*.parquet")) if path.is_dir() else [path]
        request = {"format": form, "path": str(path.absolute()), "files": [str(file.absolute()) for file in files]}
        limits = {"memory": topics.MOST_MEMORY, "bytes": topics.MOST_BYTES}
        self.contents = self._ask(json.dumps({**request, **limits}))

    def read(self, number: int) -> np.ndarray:
        """An array of the file: numbers and dates as they are stored, others as texts."""
        answer = self._ask(str(number))
        shape = tuple(int(side) for side in answer["shape"])
        if "texts" in answer:
            return np.array(answer["texts"], object).reshape(shape)
        kind = np.dtype(str(answer["dtype"]))
        if kind.kind not in KINDS:
            raise ValueError(f"numbers of {kind}")
        values = np.empty(shape, kind)
        left = values.reshape(-1).view(np.uint8).data
        while len(left):
            count = self._child.stdout.readinto(left)  # type: ignore[union-attr]
            if not count:
                raise ValueError(self._end())
            left = left[count:]
        return values

    def _ask(self, line: str) -> dict[str, Any]:
        try:
            self._child.stdin.write(line.encode() + b"\n")  # type: ignore[union-attr]
            self._child.stdin.flush()  # type: ignore[union-attr]
        except BrokenPipeError:
            raise ValueError(self._end()) from None
        answer = self._child.stdout.readline()  # type: ignore[union-attr]
        if not answer.endswith(b"\n"):
            raise ValueError(self._end())
        content = json.loads(answer)
        if content.get("is_memory"):
            most = f"{topics.MOST_MEMORY:.3g} bytes of memory"
            raise Refused(f"a file must take at most {most}, but {self._path} takes more")
        if "error" in content:
            raise ValueError(content["error"])
        return content

    def _end(self) -> str:
        """Why the other process has ended, in words."""
        code = self._child.wait()
        why = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        return f"the library that reads it breaks off ({why})"


@contextmanager
def opened(form: str, path: Path) -> Iterator[Opened]:
    """A file that a process has opened, which ends with the context.

    Args:
        form: "hdf5" or "parquet".
        path: of the file.

    Raises:
        ValueError: if the library cannot read it, or breaks off.
    """
    command = [sys.executable, "-P", str(SCRIPT)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as child:
        try:
            yield Opened(child, form, path)
        finally:
            child.kill()
            with suppress(BrokenPipeError):  # of a request that was never read
                child.stdin.close()  # type: ignore[union-attr]
