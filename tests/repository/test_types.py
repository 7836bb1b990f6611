"""What `make lint` says about mypy's errors; mypy itself runs there, not here."""

import tomllib

from tests.repository.test_house import ROOMS, ROOT
from tests.repository.types import STORED, complaints, errors_by_room, lowered

OUTPUT = [
    'plants/env.py:3: error: Name "a" is not defined  [name-defined]',
    "plants/env.py:3: note: See the manual",
    "tuning/search/space.py:9: error: Incompatible types  [assignment]",
    "tuning/search/space.py:12: error: Incompatible types  [assignment]",
    "Found 3 errors in 2 files (checked 9 source files)",
]


def test_a_room_with_more_errors_than_it_is_allowed_is_named_with_its_errors():
    found = errors_by_room(OUTPUT)
    assert {room: len(lines) for room, lines in found.items()} == {"plants": 1, "tuning": 2}
    assert complaints(found, {"plants": 1, "tuning": 2}) == []
    assert complaints(found, {"tuning": 2}) == [OUTPUT[0], "plants: mypy may find at most 0 errors, but found 1"]
    assert complaints(found, {"plants": 4, "tuning": 1}) == [
        *OUTPUT[2:4],
        "tuning: mypy may find at most 1 errors, but found 2",
    ]


def test_a_number_may_only_fall():
    found = errors_by_room(OUTPUT)
    assert lowered(found, {"plants": 4, "tuning": 1, "filters": 3}) == {"plants": 1, "tuning": 1}


def test_mypy_reads_every_room():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["mypy"]
    assert sorted(settings["files"]) == sorted(ROOMS)
    assert set(tomllib.loads(STORED.read_text(encoding="utf-8"))) <= set(ROOMS)
