"""Environments with ROS 2 that `make ros-test` makes."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh
from environments import OTHERS, THIS
from net import locators, peer_config
from ros_processes import Peer, Ros, environment, peer

sys.path.append(str(Path(__file__).parents[1] / "ros_bridge"))  # the simulated rover as ROS messages


@pytest.fixture(scope="session")
def ros(request: pytest.FixtureRequest) -> Ros:
    """The environment with the colcon workspace."""
    return environment(request.config.getoption("--ros").resolve(), THIS.name)


@pytest.fixture(scope="session")
def robot(ros: Ros, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Peer]:
    """A real ROS node."""
    with peer(ros, tmp_path_factory.mktemp("robot")) as found:
        yield found


@pytest.fixture
def listener() -> Iterator[tuple[zenoh.Session, str]]:
    """A Zenoh session in the place of roughmap's, and its endpoint."""
    with zenoh.open(peer_config(listen=True, timestamping__enabled=True)) as session:
        yield session, locators(session)[0]


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run a test that wants ``other_ros`` with each further Python that `make ros-test` has found."""
    if "other_ros" in metafunc.fixturenames:
        root = metafunc.config.getoption("--ros").resolve()
        names = [kind.name for kind in OTHERS if (root / kind.name / "ready").exists()]
        metafunc.parametrize("other_ros", names, indirect=True)


@pytest.fixture
def other_ros(request: pytest.FixtureRequest) -> Ros:
    """An environment with another Python, without messages of ours."""
    return environment(request.config.getoption("--ros").resolve(), request.param)
