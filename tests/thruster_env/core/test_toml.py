"""TOML that is written is read again; what is none is one clear line."""

import tomllib

import pytest

from thruster_env.core.files import as_toml, read_toml


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
