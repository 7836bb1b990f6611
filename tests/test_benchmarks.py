import json
import subprocess
import sys
from pathlib import Path

import pytest


def test_the_quick_benchmark_measures_every_row():
    pytest.importorskip("filterpy")
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks", "--quick", "--json", "-"],
        cwd=Path(__file__).parents[1],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    rows = json.loads(done.stdout)["rows"]
    assert len(rows) >= 8
    assert all(row["ours_seconds"] > 0 for row in rows)
