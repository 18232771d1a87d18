"""Builds the ROS package; `colcon build` calls it."""

from setuptools import setup

setup(
    name="roughmap_ros",
    version="0.1.0",
    description="Carries ROS 2 topics to roughmap and its maps back, over Zenoh",
    license="Apache-2.0",
    packages=["roughmap_ros_node"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/roughmap_ros"]),
        ("share/roughmap_ros", ["package.xml"]),
        ("share/roughmap_ros/launch", ["launch/roughmap.launch.py"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    entry_points={"console_scripts": ["node = roughmap_ros_node.node:main"]},
)
