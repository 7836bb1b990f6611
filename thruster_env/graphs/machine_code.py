"""Modules of LLVM as machine code in memory.

A module is compiled for this processor once. Its object code is kept in a folder of the user's under a digest of
its text, of LLVM's version and of the processor, so if a source changes, only programs that changed with it are
compiled. The code is freed with the last object that holds its `Code`.
"""

from __future__ import annotations

import atexit
import ctypes
import hashlib
import itertools
import os
import shutil
import struct
import sys
import tempfile
import threading
from array import array
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any
from weakref import WeakValueDictionary

import llvmlite  # type: ignore[import-untyped]
import numpy as np
from llvmlite import binding as llvm
from llvmlite import ir

from thruster_env.core.files import is_private

FOLDER = "thruster-env-code"  # within the folder of numba's cache or of the user's
# Levels of LLVM's optimisation: of the module, and of its translation. A third level of passes takes longer and
# gives the same code; without LLVM's two schedulers (-disable-post-ra, -enable-misched=false) batches of 8 states
# take 7 % longer, and compilation hardly less.
PASSES, SELECTION = 1, 2
WIDE = '"prefer-vector-width"="512"'  # of a function: else LLVM takes 256 bits on Intel's processors
DIGEST = hashlib.sha256().digest_size
LONG, POINTER = ir.IntType(64), ir.IntType(8).as_pointer()
METH_O = 0x0008  # of Python's C interface: a function of one argument
OF_PYTHON = {  # functions of Python's C interface that code calls: the result and the arguments
    "PyLong_AsVoidPtr": (POINTER, POINTER),
    "PyLong_AsLongLong": (LONG, POINTER),
    "PyLong_FromLongLong": (POINTER, LONG),
    "PyEval_SaveThread": (POINTER,),
    "PyEval_RestoreThread": (ir.VoidType(), POINTER),
}

_compiling = threading.RLock()
if hasattr(os, "register_at_fork"):  # a fork waits, so that no child finds this lock or LLVM's own ones taken
    os.register_at_fork(
        before=_compiling.acquire, after_in_parent=_compiling.release, after_in_child=_compiling.release
    )
_number = itertools.count()
_loaded: WeakValueDictionary[tuple, Code] = WeakValueDictionary()


class NotLinked(RuntimeError):
    """This system's libraries lack a function that code calls."""


class Code:
    """Machine code in memory, for as long as this object lives."""

    def __init__(
        self, object_code: bytes, names: Iterable[str], libraries: Iterable[Code], symbols: Mapping[str, Any]
    ):
        """Link object code; `names` are those of the functions to be called, which may call those of libraries.

        `symbols` are the addresses of further functions, or objects that have one and live as long.
        """
        builder = llvm.JITLibraryBuilder().add_object_img(object_code).add_current_process()
        self.addresses: dict[str, int] = {}
        self._libraries = [*libraries]  # which live as long
        for library in self._libraries:
            for name, address in library.addresses.items():
                builder.import_symbol(name, address)
        self._symbols = dict(symbols)
        for name, symbol in symbols.items():
            builder.import_symbol(name, getattr(symbol, "address", symbol))
        for name in names:
            builder.export_symbol(name)
        for symbol in OF_PYTHON:
            builder.import_symbol(symbol, ctypes.cast(getattr(ctypes.pythonapi, symbol), ctypes.c_void_p).value)
        linker = _linker()
        try:
            self._library = builder.link(linker, f"code {next(_number)}")
        except RuntimeError as error:
            raise NotLinked(str(error)) from error
        self.addresses.update((name, self._library[name]) for name in names)


def code_of(
    module: ir.Module,
    *names: str,
    unrolled: bool = True,
    libraries: Iterable[Code] = (),
    symbols: Mapping[str, Any] | None = None,
) -> Code:
    """Compile a module, or load its object code, unless it is in memory; `names` are the functions to be called.

    What it calls and does not contain must be in libraries, in this process, or have an address in `symbols`.
    Loops are unrolled, or not: those whose bodies are wide vectors gain nothing, and take three times as long to
    compile.

    Raises NotLinked if this system's libraries lack a function, and RuntimeError for a module that LLVM refuses.
    """
    text = str(module)
    digest = hashlib.sha256(f"{host()}\n{names} {unrolled}\n{text}".encode()).hexdigest()
    key = digest, *sorted((name, id(symbol)) for name, symbol in (symbols or {}).items())
    with _compiling:
        code = _loaded.get(key)
        if code is None:
            code = _loaded[key] = Code(
                _kept(digest) or _keep(digest, _compiled(text, unrolled)), names, libraries, symbols or {}
            )
    return code


@cache
def _machine() -> Any:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    features = llvm.get_host_cpu_features().flatten()
    target = llvm.Target.from_default_triple()
    return target.create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=features, opt=SELECTION, reloc="pic", codemodel="small", jit=True
    )


@cache
def _linker() -> Any:
    # LLVM's older linker asks the system for the memory of a module's instructions and of its numbers apart, and
    # ends the process where they come to lie more than 2 GB from one another.
    return llvm.create_lljit_compiler(_machine(), use_jit_link=sys.platform != "win32")


@cache
def host() -> str:
    """What object code depends on beside the text: others may compute different last digits."""
    version = ".".join(map(str, llvm.llvm_version_info))
    processor = llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()
    return f"{llvmlite.__version__} {version} {llvm.get_process_triple()} {processor} {PASSES} {SELECTION}"


def check(module: ir.Module) -> None:
    """Raise RuntimeError for a module that LLVM refuses."""
    with _compiling, llvm.create_context() as context, llvm.parse_assembly(str(module), context) as parsed:
        parsed.verify()


def _compiled(text: str, unrolled: bool) -> bytes:
    context = llvm.create_context()  # of its own, so that all of it can be freed
    module = llvm.parse_assembly(text, context)
    try:
        module.verify()  # the parser takes values that are read where they may not have been computed
        machine = _machine()
        module.data_layout, module.triple = str(machine.target_data), machine.triple
        options = llvm.create_pipeline_tuning_options(PASSES)
        options.loop_unrolling = options.loop_interleaving = unrolled
        passes = llvm.create_pass_builder(machine, options)
        passes.getModulePassManager().run(module, passes)
        return machine.emit_object(module)
    finally:
        module.close()
        context.close()


def private_folder() -> str | None:
    """A temporary folder that no other user can write, because the code loaded from it is run."""
    try:
        folder = Path(tempfile.gettempdir()) / f"thruster-env-{os.getuid() if hasattr(os, 'getuid') else 'code'}"
        try:
            folder.mkdir(mode=0o700)
        except FileExistsError:
            if not is_private(folder):
                folder = Path(tempfile.mkdtemp(prefix="thruster-env-"))  # lasts as long as the process
                atexit.register(shutil.rmtree, folder, ignore_errors=True)
        return str(folder)
    except OSError:
        return None


@cache
def _folder(told: str) -> Path | None:
    """Where object code is kept: in numba's folder if one is set, else in the user's cache; None if nowhere."""
    home = {"win32": "~/AppData/Local", "darwin": "~/Library/Caches"}.get(sys.platform, "~/.cache")
    cached = os.environ.get("LOCALAPPDATA" if sys.platform == "win32" else "XDG_CACHE_HOME") or home
    return _folder_in(told or cached) or _folder_in(private_folder())


def _folder_in(root: str | None) -> Path | None:
    """The folder within another one; None if it cannot be made, or others could write what is run from it."""
    folder = Path(os.path.expanduser(root or "~"), FOLDER)
    if root is None or folder.parts[0].startswith("~"):  # no home is known
        return None
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        return folder if is_private(folder) and os.access(folder, os.W_OK) else None
    except OSError:
        return None


def code_folder() -> Path | None:
    """Where object code is kept; None if nowhere."""
    return _folder(os.environ.get("NUMBA_CACHE_DIR", ""))


def _file(digest: str) -> Path | None:
    folder = code_folder()
    return None if folder is None else folder / f"{digest}.o"


def _kept(digest: str) -> bytes | None:
    """Object code from an earlier process; None if there is none, or it is damaged."""
    file = _file(digest)
    try:
        content = b"" if file is None else file.read_bytes()
    except OSError:
        return None
    known, object_code = content[:DIGEST], content[DIGEST:]
    return object_code if known == hashlib.sha256(object_code).digest() and object_code else None


def _keep(digest: str, object_code: bytes) -> bytes:
    """Keep object code for later processes, if the disk takes it; return it."""
    file = _file(digest)
    if file is not None:
        aside = file.with_suffix(f".{os.getpid()}")
        try:
            aside.write_bytes(hashlib.sha256(object_code).digest() + object_code)
            os.replace(aside, file)
        except OSError:
            aside.unlink(missing_ok=True)
    return object_code


# Calls from Python. What a function works on are whole numbers and addresses, in an array of words.


_bytes_of: Any = (ctypes.c_char * 0).from_buffer


class _MethodDefinition(ctypes.Structure):
    _fields_ = [
        ("name", ctypes.c_char_p),
        ("function", ctypes.c_void_p),
        ("flags", ctypes.c_int),
        ("doc", ctypes.c_char_p),
    ]


def function_of(code: Code, *called: Code, floats: bool = False) -> Callable[..., int]:
    """Return `call(*arguments)` of a function i64 run(words), which releases the interpreter lock.

    Its arguments are arrays of float64 in C order, whole numbers, and perhaps floats. Code that is `called` by its
    addresses lives as long.
    """
    run = runner_of(code, *called)

    def call(*arguments) -> int:
        words = array("q", words_of(arguments, floats=floats))  # which must live until the function ends
        return run(words.buffer_info()[0])

    return call


def runner_of(code: Code, *called: Code) -> Callable[[int], int]:
    """The same as a function of the address of the words."""
    run: Any = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_void_p)(code.addresses["run"])
    run.code = code, called  # which live as long as the function
    return run


def builtin_of(code: Code, *arguments, lengths: Sequence[int] = ()) -> Callable[[int], int]:
    """Return `call(last)` of a function ptr call(words, last), of `add_builtin`; a call costs some 70 ns.

    The last argument is a whole number, or the address of an array of these lengths. The other arrays stay where
    they are, and live as long as `call`.
    """
    words = array("q", [*words_of(arguments), 0, *lengths])
    definition = _MethodDefinition(b"call", code.addresses["call"], METH_O, None)
    new = ctypes.pythonapi.PyCFunction_NewEx
    new.restype, new.argtypes = ctypes.py_object, [ctypes.c_void_p, ctypes.py_object, ctypes.py_object]
    return new(ctypes.addressof(definition), words.buffer_info()[0], (code, words, arguments, definition))


def words_of(arguments: Iterable, *, floats: bool = False) -> list[int]:
    """Whole numbers, and of each array its address and its lengths; tuples have those of their parts.

    Floats are refused, or become their bits, for code that takes these.

    Raises TypeError for an array that is not of float64 in C order, and for another number.
    """
    words: list[int] = []
    for argument in arguments:
        if isinstance(argument, np.ndarray):
            if argument.dtype != np.float64 or not argument.flags.c_contiguous:
                raise TypeError(f"arrays must be of float64 in C order, but got {argument.dtype}")
            words += address_of(argument), *argument.shape
        elif isinstance(argument, tuple):
            words += words_of(argument, floats=floats)
        elif isinstance(argument, (int, np.integer)):
            words.append(int(argument))
        elif floats and isinstance(argument, float):
            words += struct.unpack("q", struct.pack("d", argument))
        else:
            raise TypeError(f"a number must be a whole one, but got {argument!r}")
    return words


def address_of(values: np.ndarray) -> int:
    """The address of an array's first number, in a third of the time that NumPy takes for it."""
    return ctypes.addressof(_bytes_of(values)) if values.flags.writeable else values.ctypes.data


def add_builtin(module: ir.Module, name: str, function: ir.Function, last: int) -> None:
    """Add a builtin function of Python: i64 function(words) with its argument as the word of index `last`."""
    declared = {
        symbol: ir.Function(module, ir.FunctionType(kinds[0], kinds[1:]), symbol)
        for symbol, kinds in OF_PYTHON.items()
    }
    builtin = ir.Function(module, ir.FunctionType(POINTER, [POINTER, POINTER]), name)
    builder = ir.IRBuilder(builtin.append_basic_block())
    words, argument = builtin.args
    words = builder.bitcast(builder.call(declared["PyLong_AsVoidPtr"], [words]), LONG.as_pointer())
    value = builder.call(declared["PyLong_AsLongLong"], [argument])
    builder.store(value, builder.gep(words, [ir.Constant(LONG, last)], source_etype=LONG))
    thread = builder.call(declared["PyEval_SaveThread"], [])
    result = builder.call(function, [words])
    builder.call(declared["PyEval_RestoreThread"], [thread])
    builder.ret(builder.call(declared["PyLong_FromLongLong"], [result]))
