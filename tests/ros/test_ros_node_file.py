"""The node's file alone: what it imports, and that the oldest Python that it runs on reads it."""

import ast
import sys

from environments import NODE_PACKAGE

SOURCE = (NODE_PACKAGE / "roughmap_ros_node/node.py").read_text()


def test_the_node_imports_rclpy_zenoh_and_the_standard_library_alone() -> None:
    imported = set()
    for node in ast.walk(ast.parse(SOURCE)):
        if isinstance(node, ast.Import):
            imported |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            imported.add((node.module or "").split(".")[0])
    assert imported - sys.stdlib_module_names == {"rclpy", "zenoh"}


def test_the_node_is_python_3_10() -> None:
    ast.parse(SOURCE, feature_version=(3, 10))
