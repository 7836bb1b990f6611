"""The study on standard errors of identified parameters, in a quick form."""

import numpy as np

from studies import identification
from studies.identification import TRUTH, coverage, report, study


def test_estimates_lie_within_their_standard_errors_of_the_truth():
    found = study(3, starts=1, runs=3, steps=250)
    rows = coverage(found)
    assert [one.name for one in rows] == list(TRUTH)
    assert sum(one.within for one in rows) >= 0.85 * 3 * len(rows)
    for one in rows:
        distances = [abs(f.values[one.name] - one.truth) / f.standard_errors[one.name] for f in found]
        assert max(distances) < 5, one.name
        assert np.isclose(one.mean, np.mean([f.values[one.name] for f in found]))
    text = report(rows, 3)
    assert text.count("\n| ") == 1 + len(rows) and "hold the truth" in text


def test_a_mistake_is_one_line(capsys):
    assert identification.main(["--repetitions", "1"]) == 2
    assert "repetitions must be a whole number of at least 2" in capsys.readouterr().err
