"""Progress of long work: what is told, in which order, and only to those who listen."""

from thruster_env.core.checks import listening, with_progress


def test_what_is_inside_a_part_stands_behind_it_and_a_single_part_is_not_told():
    heard = []
    with listening(heard.append):
        for part in with_progress("N", (5, 10)):
            for _ in with_progress("runs", range(part), sizes=[2] * part):
                break  # leaves nothing behind
            assert list(with_progress("alone", [1])) == [1]
        assert list(with_progress("runs", [3, 4])) == [3, 4]
    assert list(with_progress("unheard", [1, 2])) == [1, 2]
    inside = ["N: 0 of 2", "N: 0 of 2, runs: 0 of 10", "N: 1 of 2", "N: 1 of 2, runs: 0 of 20"]
    assert heard == [*inside, "runs: 0 of 2", "runs: 1 of 2"]


def test_work_goes_on_after_whoever_listened_has_stopped():
    heard = []
    with listening(heard.append):
        parts = with_progress("runs", [5, 6, 7])
        assert next(parts) == 5
    assert list(parts) == [6, 7]
    assert heard == ["runs: 0 of 3"]
