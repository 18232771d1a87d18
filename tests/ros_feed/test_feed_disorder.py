"""Messages in any order, with any frames and stamps: nothing is raised, and what comes out can be read."""

import numpy as np
from feed_tools import T0, S, cloud, feed, odometry, pose_with_covariance, read, rigid, tf, transform
from hypothesis import given
from hypothesis import strategies as st
from properties import examples

from roughmap_ros.feed import MAX_PROBLEMS
from roughmap_ros.messages import BadRosMessage

FRAMES = ["map", "odom", "base_link", "lidar", "wheels", ""]
HUGE = [0.0, 1.0, -3.5, 1e300, -1.7e308]
SETTINGS: list[dict[str, object]] = [
    {"poses": "tf"},
    {"poses": "tf", "odometry": "/odom"},
    {"poses": "tf", "pose": "/pose"},
    {"odometry": "/odom"},
    {"pose": "/pose"},
    {"odometry": "/odom", "tf": "", "tf_static": ""},
]
WHAT = st.tuples(
    st.sampled_from(["/tf", "/tf_static", "/points", "/odom", "/pose", "bytes"]),
    st.integers(0, 40),
    st.sampled_from(FRAMES),
    st.sampled_from(FRAMES),
    st.sampled_from(HUGE),
    st.sampled_from([0.0, 0.01, -1.0, 1e7, float("nan"), 1e308]),
)


def message(what: tuple[str, int, str, str, float, float]) -> tuple[str, bytes]:
    """Return a topic and a message."""
    kind, tenths, frame, other, x, variance = what
    stamp, place, covariance = T0 + tenths * S // 10, [x, 0, x, 0, 0, 0.3], np.eye(6) * variance
    if kind in ("/tf", "/tf_static"):
        return kind, tf(transform(frame, other, stamp, place))
    if kind == "/points":
        return kind, cloud(stamp, frame)
    if kind == "/odom":
        return kind, odometry(stamp, frame, other, rigid(place), covariance)
    if kind == "/pose":
        return kind, pose_with_covariance(stamp, frame, rigid(place), covariance)
    return "/tf", b"\0\1\0\0" + repr(what).encode()


@given(st.sampled_from(SETTINGS), st.lists(WHAT, max_size=60))
@examples(300)
def test_messages_in_any_order_never_raise(
    settings: dict[str, object], messages: list[tuple[str, int, str, str, float, float]]
) -> None:
    one = feed(["lidar"], **settings)
    got, clouds = [], 0
    for i, what in enumerate(messages):
        topic, cdr = message(what)
        try:
            got += one.take(topic, cdr, T0 + i)
        except BadRosMessage:
            assert what[0] == "bytes"
        clouds += what[0] == "/points"
        lines = one.problems(T0 + i)
        assert len(lines) <= MAX_PROBLEMS
        assert all("\n" not in line for line in lines)
    got += one.end()
    found = read(got)
    lost = sum(int(line.split()[0]) for line in one.problems(T0) if "were dropped" in line)
    assert len(found.clouds) + lost == clouds
    assert one.position is None or np.isfinite(one.position).all()


def test_a_flood_of_transforms_and_odometry_stays_bounded() -> None:
    one = feed(["lidar"], odometry="/odom")
    for i in range(3_000):
        at = T0 + i * S // 1000
        one.take("/tf", tf(transform("map", "odom", at), transform(f"a{i}", f"b{i}", at)), at)
        one.take("/odom", odometry(at, f"odom{i % 100}", f"wheels{i}", rigid([0] * 6)), at)
        one.take("/points", cloud(at, "lidar"), at)
    assert len(one._tree.links) <= 500
    assert len(one._tree._chains) <= 64
    assert len(one._given._waiting) <= 1_000
    assert len(one.problems(T0 + 3 * S)) <= MAX_PROBLEMS
