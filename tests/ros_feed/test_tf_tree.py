"""The tree of transforms against 4x4 matrices and scipy's Slerp."""

import math

import numpy as np
import pytest
from feed_tools import T0, Floats, S, matrix, rigid, transform
from hypothesis import given
from hypothesis import strategies as st
from properties import examples
from scipy.spatial.transform import Rotation, Slerp

from roughmap_ros.tf.link import MAX_AGE_NS, MAX_SAMPLES, Link, Sample
from roughmap_ros.tf.rigid import IDENTITY, between
from roughmap_ros.tf.tree import MAX_ALL_SAMPLES, MAX_LINKS, Tree
from roughmap_schemas import Transform

NUMBER = st.floats(-3, 3)
POSE = st.lists(NUMBER, min_size=6, max_size=6)


@st.composite
def trees(draw: st.DrawFn) -> list[Transform]:
    """Draw a tree: each frame's parent is one before it; names and order are mixed."""
    number = draw(st.integers(2, 12))
    names = draw(st.permutations([f"f{i}" for i in range(number)]))
    links = [transform(names[draw(st.integers(0, i - 1))], names[i], T0, draw(POSE)) for i in range(1, number)]
    return draw(st.permutations(links))


@given(trees(), st.data())
@examples(100)
def test_a_chain_gives_the_product_of_its_matrices(links: list[Transform], data: st.DataObject) -> None:
    tree = Tree()
    for link in links:
        tree.take([link], static=data.draw(st.booleans()), log_ns=T0)
    places: dict[str, Floats] = {}
    parents = {link.child_frame_id: link for link in links}
    for frame in {link.parent_frame_id for link in links} | set(parents):
        place, at = np.eye(4), frame
        while at in parents:
            place, at = matrix(parents[at]) @ place, parents[at].parent_frame_id
        places[frame] = place
    frames = st.sampled_from(sorted(places))
    target, source = data.draw(frames), data.draw(frames)
    found = tree.find(target, source, T0)
    assert found is not None
    expected = np.linalg.inv(places[target]) @ places[source]
    np.testing.assert_allclose(matrix(found), expected, atol=1e-12)


@given(POSE, POSE, st.floats(0, 1))
@examples(200)
def test_poses_between_two_are_linear_and_slerped(a: list[float], b: list[float], share: float) -> None:
    first, second = rigid(a), rigid(b)
    found = between(first, second, share)
    turn = Slerp([0, 1], Rotation.from_quat([first.rotation, second.rotation]))(share)
    position = (1 - share) * np.array(first.translation) + share * np.array(second.translation)
    np.testing.assert_allclose(found.translation, position, atol=1e-14)
    apart = Rotation.from_quat(first.rotation).inv() * Rotation.from_quat(second.rotation)
    if apart.magnitude() < math.pi - 1e-6:  # half a turn has two shorter ways
        np.testing.assert_allclose(Rotation.from_quat(found.rotation).as_matrix(), turn.as_matrix(), atol=1e-9)


def test_a_link_holds_its_first_and_last_pose_outside_its_samples() -> None:
    link = Link("a", "b", static=False)
    poses = [rigid([float(i), 0, 0, 0, 0, 0]) for i in range(3)]
    for i in (1, 0, 2):  # one comes late
        assert not link.add(Sample(T0 + i * S // 10, poses[i]), T0)
    assert link.at(T0 - S) == poses[0]
    assert link.at(T0 + S) == poses[2]
    middle = link.at(T0 + S // 20)
    assert middle is not None
    assert middle.translation == (0.5, 0.0, 0.0)


def test_the_first_sample_of_a_stamp_counts() -> None:
    link = Link("a", "b", static=False)
    link.add(Sample(T0, IDENTITY), T0)
    link.add(Sample(T0, rigid([1, 0, 0, 0, 0, 0])), T0)
    assert link.at(T0) == IDENTITY


def test_a_flood_of_samples_keeps_a_bounded_number() -> None:
    tree = Tree()
    for i in range(5_000):
        tree.take([transform("a", "b", T0 + i * S // 1000)], static=False, log_ns=T0)
    assert len(tree.links["a", "b"].samples) == MAX_SAMPLES
    for i in range(100):
        tree.take([transform("c", "d", T0 + i * S)], static=False, log_ns=T0)
    assert len(tree.links["c", "d"].samples) == MAX_AGE_NS // S + 1


def test_a_flood_of_frames_keeps_a_bounded_number_and_names_the_first_without_room() -> None:
    tree = Tree()
    tree.take([transform("base", f"f{i}", T0) for i in range(MAX_LINKS + 5)], static=False, log_ns=T0)
    assert (len(tree.links), tree.refused, tree.full) == (MAX_LINKS, 5, f"base -> f{MAX_LINKS}")


def test_samples_of_all_links_together_are_bounded() -> None:
    tree = Tree()
    pose = transform("base", "f", T0)
    for k in range(400):
        row = [
            Transform(T0 + k * S // 1000, "base", f"f{i}", pose.translation, pose.rotation) for i in range(MAX_LINKS)
        ]
        tree.take(row, static=False, log_ns=T0)
    kept = sum(len(link.samples) for link in tree.links.values())
    assert 0 < kept <= MAX_ALL_SAMPLES


def test_a_clock_that_is_set_back_empties_the_buffers_and_the_new_time_begins() -> None:
    tree = Tree()
    for i in range(100):
        tree.take([transform("map", "odom", T0 + i * S // 10)], static=False, log_ns=T0)
        tree.take([transform("odom", "base", T0 + i * S // 10)], static=False, log_ns=T0)
    tree.take([transform("base", "lidar", 0)], static=True, log_ns=T0)
    for i in range(3):
        assert tree.era == 0
        tree.take([transform("odom", "base", T0 + i * S // 10)], static=False, log_ns=T0)
        if i == 0:
            tree.take([transform("map", "odom", T0)], static=False, log_ns=T0)
    assert tree.era == 1
    assert [s.stamp_ns for s in tree.links["odom", "base"].samples] == [T0, T0 + S // 10, T0 + S // 5]
    assert [s.stamp_ns for s in tree.links["map", "odom"].samples] == [T0]
    assert tree.find("map", "lidar", T0) is not None


def test_one_wild_stamp_is_forgotten_after_three_right_ones() -> None:
    tree = Tree()
    for stamp in (T0, T0 + 7000 * S, T0 + 1, T0 + 2, T0 + 3):
        tree.take([transform("odom", "base", stamp)], static=False, log_ns=T0)
    assert tree.links["odom", "base"].newest_ns == T0 + 3


def test_a_static_frame_that_gets_another_parent_leaves_the_first() -> None:
    tree = Tree()
    tree.take([transform("base", "lidar", 0, [1, 0, 0, 0, 0, 0])], static=True, log_ns=T0)
    tree.take([transform("mast", "lidar", 0)], static=True, log_ns=T0)
    assert tree.replaced == {"lidar": ("base", "mast")}
    assert tree.find("base", "lidar", T0) is None


def test_a_parent_that_is_silent_for_long_gives_way() -> None:
    tree = Tree()
    tree.take([transform("odom", "base", T0)], static=False, log_ns=T0)
    tree.take([transform("map", "base", T0)], static=False, log_ns=T0 + S)
    assert len(tree.parents("base")) == 2
    tree.take([transform("map", "base", T0 + 40 * S)], static=False, log_ns=T0 + 40 * S)
    assert [link.parent for link in tree.parents("base")] == ["map"]


@pytest.mark.parametrize(
    "bad",
    [
        Transform(T0, "a", "a", (0, 0, 0), (0, 0, 0, 1)),
        Transform(T0, "", "a", (0, 0, 0), (0, 0, 0, 1)),
        Transform(T0, "a", "b" * 300, (0, 0, 0), (0, 0, 0, 1)),
        Transform(T0, "a", "b", (math.nan, 0, 0), (0, 0, 0, 1)),
        Transform(T0, "a", "b", (0, 0, 0), (0, 0, 0, 0)),
        Transform(-1, "a", "b", (0, 0, 0), (0, 0, 0, 1)),
        Transform(2**32 * S, "a", "b", (0, 0, 0), (0, 0, 0, 1)),
    ],
)
def test_what_is_no_transform_is_counted(bad: Transform) -> None:
    tree = Tree()
    tree.take([bad], static=False, log_ns=T0)
    assert (tree.links, tree.refused) == ({}, 1)


def test_transforms_of_the_largest_numbers_give_no_pose() -> None:
    tree = Tree()
    far = [1.7e308, 0, 0, 0, 0, 0]
    tree.take([transform("a", "b", T0, far), transform("b", "c", T0, far)], static=False, log_ns=T0)
    assert tree.find("a", "c", T0) is None


LINKS = st.tuples(st.sampled_from("abcdef"), st.sampled_from("abcdef"), st.integers(0, 20), st.booleans())


@given(st.lists(LINKS, max_size=40))
@examples(200)
def test_any_links_in_any_order_leave_a_tree_that_answers(links: list[tuple[str, str, int, bool]]) -> None:
    tree = Tree()
    for parent, child, seconds, static in links:
        tree.take([transform(parent, child, T0 + seconds * S)], static=static, log_ns=T0)
        assert sum(len(link.samples) for link in tree.links.values()) == tree._samples
        for target in "af":
            tree.find(target, "b", T0 + 5 * S)
    assert {link.child for link in tree.links.values()} == set(tree._by_child)
