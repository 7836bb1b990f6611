"""Machine code where nothing can be written: what is there is read, what is new goes to a private folder."""

import errno
import os
import stat
import tempfile
from pathlib import Path

import numba
import pytest
from numba.core import caching

from thruster_env.core import compiled as code_cache
from thruster_env.core.compiled import compiled, keep_code, private_folder

SOURCE = "def double(x):\n    return x + x\n"


@pytest.fixture(autouse=True)
def told_anew(monkeypatch):
    """As if no warning had been given yet, and NUMBA_CACHE_DIR, which would come first, were not set."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    code_cache._tell.cache_clear()
    code_cache._told_folder.cache_clear()


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """The folder of temporary files."""
    folder = tmp_path / "tmp"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


@pytest.fixture
def read_only(monkeypatch, temporary):
    """Numba finds that it can write nowhere but among the temporary files."""
    ensure = caching._CacheLocator.ensure_cache_path

    def refuse(locator):
        if not locator.get_cache_path().startswith(str(temporary)):
            raise OSError(errno.EROFS, "Read-only file system")
        ensure(locator)

    monkeypatch.setattr(caching._CacheLocator, "ensure_cache_path", refuse)


def function_of(folder):
    """A function whose source is a file in a folder."""
    path = folder / "doubling.py"
    if not path.exists():  # numba before 0.68 tells a source by the time of its file
        path.write_text(SOURCE)
    names = {"__name__": __name__}  # where numba looks for what a function needs when it reads it from a cache
    exec(compile(SOURCE, str(path), "exec"), names)
    return names["double"]


def files(folder):
    return sorted(path.suffix for path in Path(folder).rglob("*.nb?"))


def hits(dispatcher):
    assert dispatcher(2.0) == 4.0
    return sum(dispatcher.stats.cache_hits.values())


def test_code_that_can_be_kept_nowhere_else_goes_to_a_private_folder(tmp_path, read_only, temporary):
    with pytest.warns(UserWarning, match="machine code must be kept where .* NUMBA_CACHE_DIR .* it is in") as told:
        assert hits(compiled(function_of(tmp_path))) == 0
        assert hits(compiled(function_of(tmp_path))) == 1
    (line,) = [str(one.message) for one in told if one.category is UserWarning]
    assert "\n" not in line
    assert files(temporary) == [".nbc", ".nbi"] and not files(tmp_path / "__pycache__")


@pytest.mark.filterwarnings("ignore:machine code must be kept")
def test_a_warm_cache_that_cannot_be_written_is_read(tmp_path, temporary, request):
    assert hits(keep_code(numba.njit(function_of(tmp_path)))) == 0
    request.getfixturevalue("read_only")
    assert files(tmp_path / "__pycache__") == [".nbc", ".nbi"]
    assert hits(keep_code(numba.njit(function_of(tmp_path)))) == 1
    assert not files(temporary)


def test_without_any_folder_each_process_compiles(tmp_path, read_only, monkeypatch):
    monkeypatch.setattr(tempfile, "gettempdir", lambda: str(tmp_path / "gone"))
    with pytest.warns(UserWarning, match="each process compiles anew"):
        assert hits(compiled(function_of(tmp_path))) == 0


def test_a_full_disk_costs_the_cache_alone(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(caching.IndexDataCacheFile, "_save_data", full)
    with pytest.warns(UserWarning, match=r"does not take it \(No space left on device\)"):
        assert hits(compiled(function_of(tmp_path))) == 0
    assert hits(compiled(function_of(tmp_path))) == 0


@pytest.mark.parametrize("kind", ["nbc", "nbi"])
def test_a_damaged_cache_is_as_none(tmp_path, kind):
    assert hits(compiled(function_of(tmp_path))) == 0
    for path in (tmp_path / "__pycache__").glob(f"*.{kind}"):
        path.write_bytes(path.read_bytes()[:30])
    assert hits(compiled(function_of(tmp_path))) == 0
    assert hits(compiled(function_of(tmp_path))) == 1


def test_a_private_folder_is_nobody_else_s(temporary):
    folder = Path(private_folder())
    assert folder.parent == temporary and stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert private_folder() == str(folder)
    folder.chmod(0o777)  # anybody could have put code there
    other = Path(private_folder())
    assert other != folder and stat.S_IMODE(other.stat().st_mode) == 0o700
    folder.rmdir()
    os.symlink(other, folder)
    assert Path(private_folder()) not in (folder, other)


@pytest.mark.parametrize("name", ["site-packages", "dist-packages"])
def test_beside_what_pip_has_installed_no_machine_code_is_kept(tmp_path, name, monkeypatch):
    """It would outlive an uninstallation, as a package that hides the checkout's."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("HOME", str(tmp_path))
    folder = tmp_path / name / "filters"
    folder.mkdir(parents=True)
    kept = keep_code(numba.njit(function_of(folder)))
    assert hits(kept) == 0
    assert not files(folder) and str(tmp_path / name) not in kept._cache.cache_path
    assert hits(keep_code(numba.njit(function_of(folder)))) == 1  # and it is found again
    assert files(kept._cache.cache_path) == [".nbc", ".nbi"]


def test_a_folder_of_the_user_s_choice_comes_before_all(tmp_path, monkeypatch):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "mine"))
    folder = tmp_path / "site-packages"
    folder.mkdir()
    assert hits(keep_code(numba.njit(function_of(folder)))) == 0
    assert files(tmp_path / "mine") == [".nbc", ".nbi"]


def test_without_a_cache_of_the_user_s_installed_code_goes_to_the_private_folder(tmp_path, read_only, temporary):
    folder = tmp_path / "site-packages"
    folder.mkdir()
    with pytest.warns(UserWarning, match="it is in "):
        assert hits(keep_code(numba.njit(function_of(folder)))) == 0
    assert files(temporary) == [".nbc", ".nbi"]
