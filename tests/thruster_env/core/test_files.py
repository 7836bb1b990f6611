"""Files are whole or not there, links stay links, other files are written as they are; TOML is read again."""

import os
import stat
import tomllib

import numpy as np
import pytest

from thruster_env.core.files import as_toml, check_target, read_toml, write_whole


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def mode_of(path):
    return stat.S_IMODE(path.stat().st_mode)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_file_is_replaced_whole_and_its_mode_is_kept(here):
    old = here / "a.json"
    old.write_text("old")
    old.chmod(0o640)
    number = old.stat().st_ino
    with old.open() as reader:
        write_whole("a.json", "new")
        assert reader.read() == "old"  # who has opened it sees one moment
    assert old.read_text() == "new" and old.stat().st_ino != number and mode_of(old) == 0o640
    assert names(here) == ["a.json"]


@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o077, 0o600), (0o002, 0o664)])
def test_a_new_file_has_what_the_umask_leaves(here, umask, mode):
    before = os.umask(umask)
    try:
        write_whole(here / "deep" / "er" / "a.json", b"new")
    finally:
        os.umask(before)
    assert mode_of(here / "deep" / "er" / "a.json") == mode


def test_a_link_stays_and_what_it_leads_to_is_written(here):
    folder = here / "elsewhere"
    folder.mkdir()
    (folder / "a.json").write_text("old")
    (here / "second").symlink_to("elsewhere/a.json")
    (here / "first").symlink_to("second")
    check_target("first")
    write_whole("first", "new")
    assert (here / "first").is_symlink() and (here / "second").is_symlink()
    assert (folder / "a.json").read_text() == "new" and names(folder) == ["a.json"]


def test_a_link_that_leads_nowhere_makes_the_file(here):
    (here / "link").symlink_to("there.json")
    check_target("link")
    assert names(here) == ["link"]
    write_whole("link", "new")
    assert (here / "link").is_symlink() and (here / "there.json").read_text() == "new"


def test_links_in_a_circle_and_links_to_where_nothing_can_be_are_refused(here):
    (here / "a").symlink_to("b")
    (here / "b").symlink_to("a")
    (here / "c").symlink_to("/proc/no-such-place/c.json")
    (here / "d").symlink_to(".")
    rules = {"a": "Too many levels of symbolic links", "c": "No such file or directory", "d": "it is a folder"}
    for name, rule in rules.items():
        for door in (check_target, lambda path: write_whole(path, "new")):
            with pytest.raises(ValueError, match=f"must be where it can be written, but {name} is not: {rule}$"):
                door(name)
    assert names(here) == ["a", "b", "c", "d"] and all((here / name).is_symlink() for name in rules)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everything")
def test_a_read_only_file_and_a_link_into_a_read_only_folder_are_refused(here):
    (here / "kept.json").write_text("old")
    (here / "kept.json").chmod(0o444)
    (here / "folder").mkdir(mode=0o555)
    (here / "link").symlink_to("folder/a.json")
    for name, rule in {"kept.json": "it is read-only", "link": "Permission denied"}.items():
        with pytest.raises(ValueError, match=f"but {name} is not: {rule}"):
            check_target(name)
        with pytest.raises(ValueError, match=f"but {name} is not: {rule}"):
            write_whole(name, "new")
    assert (here / "kept.json").read_text() == "old"


def test_a_pipe_is_written_to_and_stays_a_pipe(here):
    os.mkfifo("pipe")
    (here / "link").symlink_to("pipe")
    check_target("link")  # and waits for no reader
    reader = os.open("pipe", os.O_RDONLY | os.O_NONBLOCK)
    try:
        write_whole("link", lambda stream: np.savez(stream, a=np.arange(3)))
        assert stat.S_ISFIFO((here / "pipe").stat().st_mode) and names(here) == ["link", "pipe"]
        (here / "a.npz").write_bytes(os.read(reader, 65536))
    finally:
        os.close(reader)
    np.testing.assert_array_equal(np.load("a.npz")["a"], np.arange(3))


@pytest.mark.parametrize(("minor", "full"), [(3, False), (7, True)])
def test_a_device_is_written_to_and_stays_a_device(here, minor, full):
    try:  # of one's own: a failure must not replace the machine's
        os.mknod("device", stat.S_IFCHR | 0o666, os.makedev(1, minor))
        with open("device", "wb"):
            pass
    except OSError as error:
        pytest.skip(f"devices cannot be made here: {error.strerror}")
    check_target("device")
    if full:
        with pytest.raises(ValueError, match="but device is not: No space left on device"):
            write_whole("device", "new")
    else:
        write_whole("device", "new")
    assert stat.S_ISCHR((here / "device").stat().st_mode) and names(here) == ["device"]


def test_one_s_own_standard_output_is_not_replaced(here):
    """As in `thruster ... --json /dev/stdout > all.txt`, where the path leads to a regular file."""
    kept = os.dup(1)
    try:
        with open("all.txt", "wb") as stream:
            os.dup2(stream.fileno(), 1)
        os.write(1, b"tables\n")
        (here / "stdout").symlink_to("/dev/fd/1")
        check_target("stdout")
        write_whole("stdout", "{}\n")
    finally:
        os.dup2(kept, 1)
        os.close(kept)
    assert (here / "all.txt").read_bytes() == b"tables\n{}\n"


def test_a_failure_leaves_the_old_file_and_nothing_aside(here):
    (here / "a.json").write_text("old")

    def fail(stream):
        stream.write(b"half")
        raise RuntimeError("no more")

    with pytest.raises(RuntimeError):
        write_whole("a.json", fail)
    assert (here / "a.json").read_text() == "old" and names(here) == ["a.json"]


def test_what_is_written_is_read_again(tmp_path):
    tables = {
        "numbers": {"one": 1, "tenth": 0.1, "tiny": 1e-300, "yes": True, "name with spaces": 'a "b"\n\\ ü'},
        "none": {},
        "nested": {"list": [1.0, 2.5], "by": {"x y": 1, "z": [True, "t"]}},
    }
    text = as_toml(tables, "about")
    assert text.startswith("# about\n\n[numbers]\n") and "[none]" not in text
    kept = {name: table for name, table in tables.items() if table}
    assert tomllib.loads(text) == kept
    (tmp_path / "x.toml").write_text(text, encoding="utf-8")
    assert read_toml(tmp_path / "x.toml", "a file") == kept


@pytest.mark.parametrize("content", [b"x = ", b"\xff\xfe", b"[" * 5000])
def test_what_is_no_toml_is_one_line(content, tmp_path):
    (tmp_path / "x.toml").write_bytes(content)
    with pytest.raises(ValueError, match="a file must be TOML, but .*x.toml is not"):
        read_toml(tmp_path / "x.toml", "a file")
    with pytest.raises(ValueError, match="a file must be readable, but .*none.toml is not: No such file"):
        read_toml(tmp_path / "none.toml", "a file")
