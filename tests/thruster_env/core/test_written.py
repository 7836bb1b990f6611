"""Functions written out as text: what tracebacks show of them, and how machine code of them is found again."""

import linecache

from numba.core.serialize import dumps

from thruster_env.core.sources import written_out


def shifted(size, by):
    """A function whose text depends on more than the sizes in its name."""
    return written_out("shift", "x", f"x + {by:.1f}")


def key(function):
    """What numba compares of a function in a closure to find its machine code again."""
    return dumps((function,))


def test_machine_code_is_found_again_whatever_was_written_out_before(monkeypatch):
    first, other = key(shifted(2, 1.0)), key(shifted(2, 2.0))
    assert first != other
    monkeypatch.setattr(linecache, "cache", {})  # as in another process
    assert key(shifted(2, 2.0)) == other and key(shifted(2, 1.0)) == first


def test_the_source_of_each_of_equal_names_is_shown():
    for function, text in ((shifted(2, 1.0), "x + 1.0"), (shifted(2, 2.0), "x + 2.0")):
        file = function.__code__.co_filename
        assert linecache.getlines(file) == ["def shift(x):\n", f"    return {text}\n"]
        assert file.startswith("<shift, written out by tests.thruster_env.core.test_written.shifted(2), ")
