"""Where sensors are on the robot, from transforms, and the clouds that wait for it."""

import numpy as np
from feed_tools import T0, S, cloud, feed, matrix, read, tf, transform

from roughmap_ros.tf.mountings import MAX_HELD


def test_a_mounting_goes_out_before_the_sensors_clouds() -> None:
    one = feed(["lidar"])
    links = transform("base_link", "mast", 0, [0, 0, 1, 0, 0, 0.5]), transform("mast", "lidar", 0, [1, 0, 0, 0.1, 0, 0])
    assert read(one.take("/points", cloud(T0, "lidar"), T0)).order == ""
    assert read(one.take("/tf_static", tf(links[0]), T0 + 1)).order == ""
    got = read(one.take("/tf_static", tf(links[1]), T0 + 2))
    assert got.order == "tp"
    [told] = got.transforms
    assert (told.stamp_ns, told.parent_frame_id, told.child_frame_id) == (0, "base_link", "lidar")
    np.testing.assert_allclose(matrix(told), matrix(links[0]) @ matrix(links[1]), atol=1e-14)
    assert got.clouds == [("lidar", T0)]
    assert read(one.take("/points", cloud(T0 + S, "lidar"), T0 + S)).order == "p"


def test_a_mounting_is_told_again_only_when_it_changes() -> None:
    one = feed(["lidar"])
    for x, expected in ((1.0, "t"), (1.0, ""), (2.0, "t")):
        assert (
            read(one.take("/tf_static", tf(transform("base_link", "lidar", 0, [x, 0, 0, 0, 0, 0])), T0)).order
            == expected
        )


def test_clouds_of_other_sensors_do_not_wait() -> None:
    one = feed(["lidar"])
    assert read(one.take("/points", cloud(T0, "camera"), T0)).clouds == [("camera", T0)]


def test_eight_clouds_of_each_sensor_wait_and_the_oldest_are_dropped_and_told() -> None:
    one = feed(["front", "rear"])
    for i in range(MAX_HELD + 3):
        one.take("/points", cloud(T0 + i, "front"), T0 + i)
    one.take("/points", cloud(T0, "rear"), T0)
    got = read(
        one.take("/tf_static", tf(transform("base_link", "front", 0), transform("base_link", "rear", 0)), T0 + S)
    )
    assert got.order == "t" + "p" * MAX_HELD + "tp"
    assert [stamp - T0 for _, stamp in got.clouds] == [*range(3, MAX_HELD + 3), 0]
    assert "3 clouds of front were dropped: they came before base_link -> front" in one.problems(T0 + S)


def test_clouds_that_still_wait_at_the_end_come_out() -> None:
    one = feed(["lidar"])
    one.take("/points", cloud(T0, "lidar"), T0)
    assert read(one.end()).clouds == [("lidar", T0)]
    assert one.end() == []


def test_a_sensor_in_the_base_frame_needs_no_transform() -> None:
    one = feed(["base_link"])
    assert read(one.take("/points", cloud(T0, "base_link"), T0)).order == "tp"


def test_a_sensor_that_moves_is_placed_at_the_stamp_of_each_cloud() -> None:
    one = feed(["lidar"])
    got = []
    for i in range(5):
        angle = [0, 0, 0, 0, 0, 0.1 * i]
        got += one.take("/tf", tf(transform("base_link", "lidar", T0 + i * S, angle)), T0 + i * S)
    got += one.take("/points", cloud(T0 + 3 * S + S // 2, "lidar"), T0 + 5 * S)
    told = read(got)
    assert told.order == "ttp"
    np.testing.assert_allclose(
        matrix(told.transforms[-1]), matrix(transform("a", "b", 0, [0, 0, 0, 0, 0, 0.35])), atol=1e-12
    )
    assert any("lidar moves on base_link" in line for line in one.problems(T0 + 5 * S))


def test_a_joint_that_stands_still_is_told_once() -> None:
    one = feed(["lidar"])
    orders = ""
    for i in range(20):
        one.take("/tf", tf(transform("base_link", "lidar", T0 + i, [0, 0, 1, 0, 0, 1e-6 * (i % 2)])), T0 + i)
        orders += read(one.take("/points", cloud(T0 + i, "lidar"), T0 + i)).order
    assert orders == "p" * 20
    assert not any("moves" in line for line in one.problems(T0 + 20))


def test_a_known_mounting_outlives_a_clock_that_is_set_back() -> None:
    one = feed(["lidar"])
    order = ""
    for base in (T0 + 100 * S, T0):
        for i in range(5):
            order += read(one.take("/tf", tf(transform("base_link", "lidar", base + i * S // 10)), base)).order
            order += read(one.take("/points", cloud(base + i * S // 10, "lidar"), base)).order
    assert order == "t" + "p" * 10
