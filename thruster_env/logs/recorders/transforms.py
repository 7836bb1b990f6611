"""Transforms between frames: messages that hold arrays of them give one topic for each pair of frames."""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from thruster_env.logs.recorders.topics import MOST_FIELDS, Refused, Wanted

HEADER_TYPE = "std_msgs/msg/Header"
STAMPED = "geometry_msgs/msg/TransformStamped"


def array_of_transforms(defined: dict, kind: str) -> str:
    """The only field of a type of messages, if it is an array of transforms; empty for other types.

    Source: ROS, tf2_msgs/TFMessage, tf/tfMessage, geometry_msgs/TransformStamped.
    """
    fields: Sequence[Any] = defined[kind][1] if kind in defined else ()
    if len(fields) != 1 or not _has_frames(dict(defined.get(STAMPED, ((), ()))[1]), defined):
        return ""
    ((name, (node, what)),) = fields
    is_array = node.name in ("ARRAY", "SEQUENCE") and what[0][0].name == "NAME"
    return name if is_array and what[0][1] == STAMPED else ""


def _has_frames(fields: Mapping, defined: dict) -> bool:
    """Whether a message has a header, the child's frame and a transform, and nothing else."""
    if set(fields) != {"header", "child_frame_id", "transform"}:
        return False
    child, (node, transform) = fields["child_frame_id"], fields["transform"]
    is_text = child[0].name == "BASE" and child[1][0] == "string"
    return fields["header"][1] == HEADER_TYPE and is_text and node.name == "NAME" and transform in defined


def wants_pairs(wanted: Wanted, topic: str) -> bool:
    """Whether a column is wanted that may belong to a pair of frames of a topic."""
    return wanted is not None and any(one.startswith(f"{topic}/") for one in wanted)


class Pairs:
    """Names of the topics of pairs of frames: TOPIC/PARENT/CHILD, without slashes at the beginning of a frame."""

    def __init__(self, path: Path):
        """There is none yet; the path of the bag is for messages."""
        self._path = path
        self._pairs: dict[str, tuple[str, str, str]] = {}

    def topics(self, topic: str, transforms: Any) -> Iterator[tuple[str, Any]]:
        """Each transform of a message of a topic, with the name of its pair's topic.

        Raises:
            ValueError: if two pairs have one name, or there are more than MOST_FIELDS.
        """
        for one in transforms:
            parent, child = one.header.frame_id.lstrip("/"), one.child_frame_id.lstrip("/")
            name = f"{topic}/{parent}/{child}"
            if self._pairs.setdefault(name, (topic, parent, child)) != (topic, parent, child):
                raise self._doubled(name)
            if len(self._pairs) > MOST_FIELDS:
                raise Refused(
                    f"a bag must have at most {MOST_FIELDS} pairs of frames, but got more ({self._path})"
                )
            yield name, one

    def check(self, topics: Container[str]) -> None:
        """Raise ValueError if a pair has the name of one of the topics of the bag."""
        for name in self._pairs:
            if name in topics:
                raise self._doubled(name)

    def _doubled(self, name: str) -> Refused:
        rule = "pairs of frames must have names of their own, TOPIC/PARENT/CHILD"
        return Refused(f"{rule}, but two topics of {self._path} are {name[:200]!r}")
