"""Blocks of logs with gaps and of short logs, and what is held out of logs that are given twice."""

import shutil

import numpy as np
import pytest

from tests.tuning.test_log_problem import GUESS, MODEL, logs_of
from thruster_env.logs.findings import Recording
from thruster_env.logs.log import Log
from thruster_env.logs.read import read_log
from thruster_env.logs.write import write_columns
from tuning.evaluation.evaluate import evaluate
from tuning.logs.problem import cut_at_gaps, log_problem, split_runs
from tuning.problems.log_parts import parts_of
from tuning.problems.log_problem import LogProblem
from tuning.search.space import untuned_choice


def table_of(log, rows=slice(None)):
    inputs = np.append(log.inputs[:, 0], np.nan)
    return {"t": log.times[rows], "u_1": inputs[rows], "z_1": log.measurements[rows, 0]}


def with_gap(pause, steps=600, at=240):
    """A log whose recorder paused for some rows."""
    table = table_of(*logs_of(steps))
    keep = np.r_[0:at, at + pause : steps + 1]
    return {name: values[keep] for name, values in table.items()}


@pytest.mark.parametrize("hold", [False, True])
def test_blocks_without_measurements_are_in_no_score_and_their_number_is_said(hold):
    (log,) = logs_of(3000)
    quiet = log.measurements.copy()
    quiet[400:2600] = np.nan  # the sensor is lost, the recorder goes on
    quiet[2500] = 1.0
    lost = Log("run", log.dt, log.inputs, quiet, log.input_quantities, log.measured)
    problem = LogProblem(lost, GUESS, hold_gaps=hold)
    data = problem.data(range(len(problem.parts.blocks)))
    scored = (~np.isnan(data.measurements[:, data.first_scored :, 0])).sum(axis=1)
    assert scored.min() >= np.median(scored) / 4 and len(problem.parts.blocks) + problem.parts.empty == 73
    assert problem.parts.empty >= 50
    assert f"{problem.parts.empty} of 73 blocks are left out and in no score" in " ".join(problem.remarks)
    held = problem.data(problem.parts.held_out)
    evaluation = evaluate(untuned_choice("kf", problem).filter(problem), held, None)
    assert (evaluation.log_likelihoods != 0.0).all()


def test_a_run_is_cut_at_a_gap_unless_its_input_is_to_be_held():
    table = with_gap(pause=1200, steps=3000)
    cut, held = (log_problem(table, model=MODEL, hold_gaps=hold) for hold in (False, True))
    (log,) = cut.logs
    assert log.recording.gaps == ((240, 1200),) and log.pieces == ((0, 240), (1440, 1561))
    for block in cut.parts.blocks:
        assert block.first + block.rows <= 240 or block.first >= 1440
    assert cut.parts.empty == 0 and held.parts.empty > 5 and cut.digest != held.digest
    assert any("Runs are cut at gaps" in said for said in cut.remarks)
    assert any("a gap: 1200 rows (120 s) are missing" in said for said in cut.remarks)
    assert any("the last input is held" in said for said in held.remarks)


def test_an_identification_has_the_pieces_of_a_run_as_runs():
    options = {"model": MODEL, "use_all": True}
    (first, second), _ = split_runs(with_gap(100), **options)
    (log,), _ = split_runs(with_gap(100), **options, hold_gaps=True)
    assert (first.steps, second.steps, log.steps) == (239, 260, 600)
    assert second.name == "run1, rows 340 to 600" and second.start == pytest.approx(34.0)
    np.testing.assert_array_equal(second.measurements, log.measurements[340:])
    np.testing.assert_array_equal(second.inputs, log.inputs[340:])
    assert cut_at_gaps(second) == [second]
    few, _ = split_runs(with_gap(100, steps=345), **options)  # five rows after the gap tell nothing
    assert [one.steps for one in few] == [239]


def test_the_last_quarter_of_a_recording_is_held_out_unless_it_is_short():
    (first, second), (late,) = split_runs(with_gap(100), model=MODEL)
    assert (first.steps, second.steps + 1, late.steps + 1) == (239, 111, 150)  # of 601 rows
    (early,), (late,) = split_runs(with_gap(100), model=MODEL, hold_gaps=True)
    assert early.steps + 1 == 451 and late.name == "run1, rows 451 to 600"
    assert split_runs({name: values[:150] for name, values in with_gap(100).items()}, model=MODEL)[1] == []


def test_pieces_keep_the_samples_of_their_own_times():
    table = with_gap(100)
    table["z_1"][1::2] = np.nan
    log = read_log(table, MODEL)
    first, second = cut_at_gaps(log)
    series = second.series("measurement:z_1")
    assert series.times[0] == pytest.approx(0.0) and len(first.series("measurement:z_1").times) == 120
    np.testing.assert_array_equal(series.values, second.measurements[~np.isnan(second.measurements[:, 0]), 0])


def test_what_is_held_out_is_never_learnt_from_however_it_is_named(tmp_path):
    a, b, c = (table_of(log) for log in logs_of(200, 200, 200))
    copy = {name: values.copy() for name, values in c.items()}
    for held in (c, copy):
        problem = log_problem([a, b, c], held_out=held, model=MODEL)
        assert len(problem.logs) == 3
        learnt = {problem.parts.blocks[i].run for i in problem.parts.training}
        digests = [read_log(one, MODEL).digest for one in (a, b)]
        assert sorted(problem.logs[run].digest for run in learnt) == sorted(digests)
        learning, proving = split_runs([a, b, c], held, model=MODEL)
        assert sorted(log.digest for log in learning) == sorted(digests) and len(proving) == 1
    for name, table in zip("abc", (a, b, c), strict=True):
        write_columns(tmp_path / f"{name}.csv", table, "exact")
    files = [str(tmp_path / f"{name}.csv") for name in "abc"]
    shutil.copy(files[2], tmp_path / "d.csv")
    (tmp_path / "sub").mkdir()
    for other in (tmp_path / "sub" / ".." / "c.csv", tmp_path / "d.csv"):
        problem = log_problem(files, held_out=str(other), model=MODEL)
        names = {problem.logs[problem.parts.blocks[i].run].name for i in problem.parts.training}
        assert names == set(files[:2]) and len(problem.logs) == 3
    with pytest.raises(ValueError, match="at least one log must be left to learn from"):
        log_problem([c], held_out=copy, model=MODEL)


def test_a_part_of_a_training_run_cannot_be_held_out():
    (log,) = logs_of(600)
    whole, part, other = table_of(log), table_of(log, slice(100, 400)), table_of(logs_of(10, 300)[1])
    part["t"] = part["t"] + 7.0  # another clock does not hide it
    said = "held-out runs must have no rows in common with the others, but run2 has some of run1"
    with pytest.raises(ValueError, match=said):
        log_problem([whole], held_out=part, model=MODEL)
    with pytest.raises(ValueError, match=said):
        split_runs([whole], part, model=MODEL)
    assert len(log_problem([whole], held_out=other, model=MODEL).logs) == 2
    still = {name: values * (name == "t") for name, values in other.items()}
    still["z_1"][0] = 1.0  # two runs that begin at rest have nothing in common
    again = {name: values.copy() for name, values in still.items()}
    again["z_1"][1] = 2.0
    log_problem([still], held_out=again, model=MODEL)


@pytest.mark.parametrize(
    ("rows", "lead"), [((24,), 2), ((50,), 12), ((21, 20, 22), 6), ((20,) * 9, 12), ((199,), 25)]
)
def test_short_logs_have_shorter_lead_ins_and_blocks_and_it_is_said(rows, lead):
    problem = LogProblem(logs_of(*(count - 1 for count in rows)), GUESS)
    assert problem.parts.lead == problem.first_scored_step == lead
    assert len(problem.parts.training) >= 2 and len(problem.parts.held_out) >= 2
    assert f"The logs are short: a lead-in has {lead} rows" in problem.remarks[-1]
    assert LogProblem(logs_of(200), GUESS).remarks == () and LogProblem(logs_of(200), GUESS).parts.lead == 50


def test_a_lead_in_that_is_given_stays():
    problem = LogProblem(logs_of(23, 24, 20), GUESS, lead=0)
    assert problem.parts.lead == 0 and [block.rows for block in problem.parts.blocks] == [6] * 11  # of 70 rows


@pytest.mark.parametrize(("steps", "count"), [((1500, 1500, 1500), 72), ((900, 130, 400), 51), ((4000,), 73)])
def test_blocks_of_all_logs_have_one_length_and_few_rows_are_left_out(steps, count):
    parts = parts_of(logs_of(*steps), sizes=True)
    lengths = {block.rows for block in parts.blocks}
    assert len(lengths) == 1 and len(parts.blocks) == count
    assert sum(steps) - 50 * len(steps) - count * (lengths.pop() - 50) <= 0.1 * sum(steps)
    assert len(parts.sizes) * 3 <= len(parts.training) + len(parts.sizes) < (len(parts.sizes) + 1) * 3
    assert {parts.blocks[i].run for i in parts.sizes} == {parts.blocks[i].run for i in parts.training}


def test_recordings_of_logs_that_were_not_read_are_empty():
    assert logs_of(100)[0].recording == Recording() and logs_of(100)[0].pieces == ((0, 101),)
