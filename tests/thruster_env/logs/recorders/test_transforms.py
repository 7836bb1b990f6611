"""Transforms of bags (/tf, /tf_static): a topic for each pair of frames."""

import numpy as np
import pytest

from filters.logs.estimate import estimate
from tests.thruster_env.logs.recorders.files import EPOCH, bag_writer, messages_of, stamped
from tests.thruster_env.logs.recorders.test_bad_recordings import refused
from thruster_env.logs.recorders import topics
from thruster_env.logs.recorders.registry import contents, fields, read
from thruster_env.thruster.model import thruster_model

TF2, TF = "tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"
DEFINITION = "geometry_msgs/TransformStamped[] transforms\n"
FIELDS = [*(f"translation.{axis}" for axis in "xyz"), *(f"rotation.{axis}" for axis in "xyzw")]


def write_transforms(path, messages, kind="ros1", type_name=TF2):
    """A bag of arrays of transforms: (topic, received [ns], [(parent, child, stamp [ns], seven numbers)])."""
    from rosbags.typesys import get_types_from_msg

    store, serialize = messages_of(kind)
    if type_name not in store.fielddefs:
        store.register(get_types_from_msg(DEFINITION, type_name))
    types = store.types
    vector, rotation = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    transform, one_stamped = types["geometry_msgs/msg/Transform"], types["geometry_msgs/msg/TransformStamped"]
    with bag_writer(path, kind) as writer:
        connections = {
            topic: writer.add_connection(topic, type_name, typestore=store)
            for topic in dict.fromkeys(topic for topic, *_ in messages)
        }
        for topic, received, rows in messages:
            array = []
            for parent, child, stamp, numbers in rows:
                header = stamped(types, kind, stamp)
                header.frame_id = parent
                array.append(one_stamped(header, child, transform(vector(*numbers[:3]), rotation(*numbers[3:]))))
            writer.write(connections[topic], received, serialize(types[type_name](array), type_name))


def moving(rows=40):
    """The base at each message, an arm at every fourth one, 3 ms behind, and a sensor once, without a stamp."""
    rng = np.random.default_rng(1)
    base, arm = rng.normal(size=(rows, 7)), rng.normal(size=(rows, 7))
    messages = [("/tf_static", EPOCH, [("base_link", "imu", 0, np.arange(7.0))])]
    for k in range(rows):
        stamp = EPOCH + 10**7 * k
        parts = [("map", "base_link", stamp, base[k])]
        parts += [("base_link", "arm.1", stamp - 3 * 10**6, arm[k])] if k % 4 == 3 else []
        messages.append(("/tf", stamp + 10**6, parts[::-1]))
    return messages, base, arm


@pytest.mark.parametrize(
    ("kind", "type_name"), [("ros1", TF2), ("ros1", TF), ("sqlite3", TF2), ("mcap", TF2), ("mcap", TF)]
)
def test_each_pair_of_frames_is_a_topic_with_its_own_stamps(tmp_path, kind, type_name):
    messages, base, arm = moving()
    write_transforms(tmp_path / "a.bag", messages, kind, type_name)
    found = read(tmp_path / "a.bag", None)
    pairs = "/tf/base_link/arm.1", "/tf/map/base_link", "/tf_static/base_link/imu"
    assert list(found) == [f"{pair}.{field}" for pair in pairs for field in FIELDS]
    for place, field in enumerate(FIELDS):
        one, other, fixed = (found[f"{pair}.{field}"] for pair in (pairs[1], pairs[0], pairs[2]))
        np.testing.assert_array_equal(one.values, base[:, place])
        np.testing.assert_array_equal(other.values, arm[3::4, place])
        np.testing.assert_array_equal(fixed.values, [place])
        np.testing.assert_allclose(one.times, 0.01 * np.arange(40), atol=1e-9)
        np.testing.assert_allclose(other.times, 0.01 * np.arange(3, 40, 4) - 0.003, atol=1e-9)
        np.testing.assert_allclose(one.received, 0.01 * np.arange(40) + 0.001, atol=1e-9)
        assert (one.clock, other.clock, fixed.clock, fixed.times[0]) == ("header", "header", "receipt", 0.0)
    asked = [f"{pairs[0]}.translation.x", "/tf.x", "/tf/no/such.translation.x"]
    assert list(read(tmp_path / "a.bag", asked)) == asked[:1]
    some = contents(tmp_path / "a.bag", "header")
    assert {one.topic: one.samples for one in some.fields} == dict(zip(pairs, (10, 40, 1), strict=True))
    assert some.unread == {}


def test_a_log_is_read_of_transforms(tmp_path):
    messages, base, _ = moving()
    write_transforms(tmp_path / "a.bag", messages[1:])
    columns = {"V_s": "/tf/map/base_link.translation.y", "thrust": "/tf/map/base_link.translation.x"}
    log = estimate(tmp_path / "a.bag", "ekf", thruster_model, columns=columns).log
    assert (log.steps, log.dt) == (39, pytest.approx(0.01))
    np.testing.assert_array_equal(log.series("measurement:thrust").values, base[:, 0])


def test_slashes_before_frames_are_no_part_of_their_names_and_pairs_are_not_mixed(tmp_path):
    """As of tf and of tf2; "a/b" within "c" has the name of "b" within "c/a"."""
    numbers = np.arange(7.0)
    rows = [[("/map", "/base", EPOCH + k, numbers), ("map", "base", EPOCH + k + 5, numbers)] for k in range(3)]
    write_transforms(tmp_path / "a.bag", [("/tf", EPOCH + k, row) for k, row in enumerate(rows)])
    assert {one.topic: one.samples for one in fields(tmp_path / "a.bag")} == {"/tf/map/base": 6}
    rows = [("c", "a/b", EPOCH, numbers)], [("c/a", "b", EPOCH, numbers)]
    write_transforms(tmp_path / "b.bag", [("/tf", EPOCH + k, row) for k, row in enumerate(rows)])
    refused(
        tmp_path / "b.bag", "must have names of their own, TOPIC/PARENT/CHILD, but two topics of .* '/tf/c/a/b'"
    )
    rows = ("/tf", EPOCH, [("c", "b", EPOCH, numbers)]), ("/tf/c/b", EPOCH, [("c", "d", EPOCH, numbers)])
    write_transforms(tmp_path / "c.bag", rows)
    refused(tmp_path / "c.bag", "must have names of their own, .* '/tf/c/b'")


def test_pairs_of_frames_have_a_limit(tmp_path, monkeypatch):
    rows = [("map", f"body{k}", EPOCH, np.arange(7.0)) for k in range(12)]
    write_transforms(tmp_path / "a.bag", [("/tf", EPOCH, rows), ("/tf", EPOCH + 1, [])], "mcap")
    assert len(fields(tmp_path / "a.bag")) == 12 * 7
    monkeypatch.setattr(topics, "MOST_FIELDS", 11)
    refused(tmp_path / "a.bag", "a bag must have at most 11 pairs of frames, but got more")
