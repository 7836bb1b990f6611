"""Columns of a quaternion in a log: found by the names of its components, with length 1 and one sign.

The four columns of a rotation among a model's measurements have its symbols, or headers that are given. Those
of one among its states, q_w, q_x, q_y and q_z, are a reference. They may have the names of other programs,
such as orientation.x ... orientation.w of ROS, whatever their order; numbers such as q0 ... q3 do not say
which one is the scalar, so they are not read unless columns are given.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from thruster_env.logs.columns import MEASUREMENT, STATE, TIME, Column
from thruster_env.logs.findings import QUATERNION, Remark
from thruster_env.logs.grid import Series
from thruster_env.model.state_space import StateSpaceModel

PREFIXES = "q", "quat", "quaternion", "orientation", "poseorientation", "poseposeorientation", "attitude"
NUMBERED = re.compile(r"(q|quat|quaternion|orientation|attitude)[^a-z0-9]*[0-4]\W*$", re.IGNORECASE)
LEAST, MOST = 0.5, 2.0  # length of what is a quaternion at all
ROUNDED = 1e-3  # of a length, by which the digits of a file may change it


def groups_of(model: StateSpaceModel) -> list[tuple[str, list[str]]]:
    """The name of each rotation and pose of a model, states first, and the channels of its quaternion, w first."""
    parts = [(STATE, model.states, turn) for turn in model.turns]
    parts += [(MEASUREMENT, model.measurements, turn) for turn in model.measured_turns]
    return [
        (turn.name, [f"{kind}:{quantity.symbol}" for quantity in quantities[turn.quaternion]])
        for kind, quantities, turn in parts
        if turn.kind != "direction"
    ]


def named_columns(
    model: StateSpaceModel, headers: Sequence[str], columns: Mapping[str, Column]
) -> dict[str, Column]:
    """Columns of the quaternion of a model with one rotation, by names such as orientation.w; empty if not there.

    Raises:
        ValueError: if a quaternion has some of its columns alone, or two quaternions are there.
    """
    used = {column.header for column in columns.values()}
    groups = [group for group in groups_of(model) if group[1][0].startswith(STATE)]
    for name, keys in groups:
        known = [key for key in keys if key in columns]
        if 0 < len(known) < len(keys):
            missing = ", ".join(key.partition(":")[2] for key in keys if key not in columns)
            raise ValueError(
                f"the quaternion of {name!r} must have four columns, but there is none for {missing}: "
                f"use --column {missing.split(',')[0]}=HEADER"
            )
    if len(groups) != 1 or groups[0][1][0] in columns:
        return {}
    by_prefix: dict[str, dict[str, str]] = {}
    for header in headers:
        text, last = (re.sub(r"\[.*|[^a-z0-9]", "", part.lower()) for part in (header, _last(header)))
        if header not in used and text[-1:] in tuple("wxyz") and {text[:-1], last[:-1]} & {*PREFIXES}:
            by_prefix.setdefault(text[:-1], {})[text[-1]] = header
    complete = [parts for parts in by_prefix.values() if len(parts) == 4]
    if len(complete) > 1:
        two = " and ".join(parts["w"] for parts in complete)
        raise ValueError(
            f"a log must have one quaternion of {groups[0][0]!r}, but got {two}: use --column q_w=HEADER"
        )
    return (
        {key: Column(complete[0][axis], None) for key, axis in zip(groups[0][1], "wxyz", strict=True)}
        if complete
        else {}
    )


def _last(header: str) -> str:
    """The component of a header with the name before it: "orientation.w" of "field.orientation.w"."""
    return ".".join(header.split(".")[-2:])


def remark_on_numbers(
    model: StateSpaceModel, headers: Sequence[str], columns: Mapping[str, Column]
) -> list[Remark]:
    """That columns such as q0 ... q3 are not read, whose order is unknown."""
    used = {column.header for key, column in columns.items() if key != TIME}
    numbered = [header for header in headers if header not in used and NUMBERED.match(header)]
    groups = [keys for _, keys in groups_of(model) if keys[0] not in columns]
    if len(groups) != 1 or len(numbered) != 4:
        return []
    options = " ".join(f"--column {key.partition(':')[2]}=HEADER" for key in groups[0])
    text = f"{', '.join(numbered)} may be a quaternion, whose scalar is the first or the last: give {options}"
    return [Remark(QUATERNION, "", text)]


def repaired(model: StateSpaceModel, samples: Mapping[str, Series]) -> tuple[dict[str, Series], list[Remark]]:
    """Quaternions of length 1 whose sign does not jump, by channel, and what was repaired, in words.

    Samples with a length below 0.5 or above 2 are left out, as those of trackers that have lost a body.

    Raises:
        ValueError: if less than half of the samples are quaternions.
    """
    result, remarks = dict(samples), []
    for name, keys in groups_of(model):
        if not all(key in samples for key in keys):
            continue
        times = samples[keys[0]].times
        for key in keys[1:]:
            times = times[np.isin(times, samples[key].times)]
        q = np.column_stack([samples[key].values[np.isin(samples[key].times, times)] for key in keys])
        if len(q) != len(times) or not len(q):
            raise ValueError(f"the columns of the quaternion of {name!r} must have the same times, but have not")
        lengths = np.linalg.norm(q, axis=1)
        usable = (lengths > LEAST) & (lengths < MOST)
        if 2 * usable.sum() < len(q):
            rule = f"the quaternion of {name!r} must have length 1"
            raise ValueError(
                f"{rule}, but its median is {np.median(lengths):.3g}: name its columns, --column q_w=HEADER"
            )
        off = usable & (abs(lengths - 1.0) > ROUNDED)
        times, q = times[usable], q[usable] / lengths[usable, None]
        flips = np.append(False, (q[1:] * q[:-1]).sum(axis=1) < 0.0)
        q *= np.where(np.cumsum(flips) % 2, -1.0, 1.0)[:, None]
        texts = []
        if off.any():
            low, high = lengths[off].min(), lengths[off].max()
            texts.append(
                f"{off.sum()} of {len(usable)} have a length of {low:.3g} to {high:.3g}, and are divided by it"
            )
        if not usable.all():
            texts.append(f"{(~usable).sum()} have no length near 1, and are left out")
        if flips.any():
            texts.append(f"the sign changes {flips.sum()} times, which is no turn, and is undone")
        if texts:
            remarks.append(Remark(QUATERNION, keys[0], f"Quaternions of {name}: {'; '.join(texts)}"))
        result |= {key: Series(times, values) for key, values in zip(keys, q.T, strict=True)}
    return result, remarks
