"""Tables that are nearly right: comments above the header, columns of text, and errors that name the way out."""

import numpy as np
import pytest

from thruster_env.logs.table import read_table
from tuning.series.column import column_of

ROWS = np.arange(40)
Z = np.sin(ROWS).round(4)


def written(tmp_path, header, rows):
    file = tmp_path / "log.csv"
    file.write_text("\n".join([header, *rows]) + "\n")
    return file


@pytest.mark.parametrize(
    ("head", "names", "first"),
    [
        ("# t,z", ["t", "z"], 2),
        ("# recorded in 2024\n# by A, B and C\nt,z", ["t", "z"], 4),
        ("% 1, 2\n\n# t,z", ["t", "z"], 4),
    ],
)
def test_comments_above_the_header_are_left_out(tmp_path, head, names, first):
    table = read_table(written(tmp_path, head, ["0,1.5", "1,2.5"]))
    assert [*table.names] == names and [*table.lines] == [first, first + 1]
    np.testing.assert_array_equal(table.numbers("z"), [1.5, 2.5])


def test_columns_of_text_are_not_fitted(tmp_path):
    rows = [f"2024-01-{1 + k // 24:02d}T{k % 24:02d}:00,Oslo,{z}" for k, z in enumerate(Z)]
    assert column_of(written(tmp_path, "date,place,z", rows)).quantities[0].symbol == "z"


def test_a_column_with_a_text_among_its_numbers_is_no_column_of_text(tmp_path):
    rows = [f"{k},{'error' if k == 7 else z},{z}" for k, z in enumerate(Z)]
    with pytest.raises(ValueError, match="one column of numbers .* but .*log.csv has a, b"):
        column_of(written(tmp_path, "t,a,b", rows))


@pytest.mark.parametrize(
    ("cell", "hint"),
    [
        ("{}%", r"numbers alone, with their unit in the header, as z \[%\]"),
        ("{} V", r"numbers alone, with their unit in the header, as z \[V\]"),
        ('"1,234,567"', "numbers without separators of thousands"),
        ('"{},5"', "numbers, with decimal points|numbers without"),
        ("[{}", "numbers"),
    ],
)
def test_cells_that_are_nearly_numbers(tmp_path, cell, hint):
    rows = [f"{k};{cell.format(k)}" for k in ROWS]
    with pytest.raises(ValueError, match=f"columns must hold ({hint})"):
        column_of(written(tmp_path, "t;z", rows))


def test_a_line_of_units_belongs_to_the_header(tmp_path):
    rows = ["s,m", *(f"{k},{z}" for k, z in enumerate(Z))]
    with pytest.raises(
        ValueError, match=r"below the header, which has their unit, as z \[m\], but got 'm' in line 2"
    ):
        column_of(written(tmp_path, "t,z", rows))


@pytest.mark.parametrize(
    ("times", "way"),
    [
        (-ROWS, "the newest row is the first one, reverse the rows"),
        (ROWS // 10, r"delete the column .* \(about 0.0769\)"),
    ],
)
def test_times_that_do_not_increase_say_what_to_do(tmp_path, times, way):
    rows = [f"{time},{z}" for time, z in zip(times, Z, strict=True)]
    with pytest.raises(ValueError, match=f"times must increase from row to row, .*: .*{way}"):
        column_of(written(tmp_path, "t,z", rows))
