"""Starts the node: `ros2 launch roughmap_ros roughmap.launch.py params:=roughmap.yaml`."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description():
    """Return the node with its parameters from the file ``params``."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("params", description="YAML file with the node's topics and endpoint"),
            Node(
                package="roughmap_ros",
                executable="node",
                name="roughmap",
                output="screen",
                respawn=True,
                respawn_delay=2.0,
                parameters=[LaunchConfiguration("params")],
            ),
        ]
    )
