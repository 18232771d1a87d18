"""The section on ROS 2: which topics come in, and which go out."""

from typing import Annotated, Final, Literal

from pydantic import Field, model_validator

from roughmap_schemas.layers import LAYERS
from roughmap_schemas.sections import Section
from roughmap_schemas.values import NUMBER, Frame, MaybeBounds, MaybeNone, Name, NotNegativeWhole, Once, Positive, Share

TOPIC_PATTERN: Final = r"^(/[A-Za-z_][A-Za-z0-9_]*)+$"
"""An absolute ROS topic."""

Topic = Annotated[str, Field(pattern=TOPIC_PATTERN, max_length=256)]
MaybeTopic = Annotated[Topic | None, MaybeNone]
Topics = Annotated[list[Topic], Once]

SHARED: Final = ("tf", "tf_static")
"""Settings whose topic several robots may name: its messages say which frames they are about."""

PoseSource = Literal["auto", "odometry", "pose", "pose_stamped", "tf"]
OutType = Literal["GridMap", "OccupancyGrid", "PointCloud2"]


class Ros2RobotConfig(Section):
    """The topics of one robot."""

    clouds: Topics = Field(default=[])
    """Topics of sensor_msgs/PointCloud2."""
    livox: Topics = Field(default=[])
    """Topics of livox_ros_driver2/CustomMsg."""
    odometry: MaybeTopic = None
    """Topic of nav_msgs/Odometry."""
    pose: MaybeTopic = None
    """Topic of geometry_msgs/PoseWithCovarianceStamped."""
    pose_stamped: MaybeTopic = None
    """Topic of geometry_msgs/PoseStamped."""
    tf: MaybeTopic = "/tf"
    """Topic of tf2_msgs/TFMessage; "" for none."""
    tf_static: MaybeTopic = "/tf_static"
    """Topic of static transforms; "" for none."""
    base: Frame = "base_link"
    """The robot's base frame, in which its sensors are mounted."""
    poses: PoseSource = "auto"
    """Where poses come from. "auto": the first topic that is set of odometry, pose and pose_stamped, else tf. With
    "tf", the covariance comes from the odometry or pose topic, if one is set."""

    @property
    def source(self) -> Literal["odometry", "pose", "pose_stamped", "tf"]:
        """Where poses come from, after "auto" is decided."""
        if self.poses != "auto":
            return self.poses
        if self.odometry is not None:
            return "odometry"
        if self.pose is not None:
            return "pose"
        return "tf" if self.pose_stamped is None else "pose_stamped"

    @property
    def roles(self) -> list[tuple[str, str]]:
        """Each topic that is set, with the setting that names it."""
        single = ("odometry", "pose", "pose_stamped", "tf", "tf_static")
        several = [*((topic, "clouds") for topic in self.clouds), *((topic, "livox") for topic in self.livox)]
        return several + [(topic, name) for name in single if (topic := getattr(self, name)) is not None]

    @model_validator(mode="after")
    def _has_poses(self) -> "Ros2RobotConfig":
        source = self.source
        if getattr(self, source) is None:
            raise ValueError(f"poses: {source!r} needs a topic; {source} has none")
        return self


class Ros2OutConfig(Section):
    """One topic with a part of the map."""

    type: OutType
    """Message type: grid_map_msgs/GridMap, nav_msgs/OccupancyGrid or sensor_msgs/PointCloud2."""
    topic: MaybeTopic = None
    """Default: /roughmap/NAME."""
    rate: Annotated[float, Field(gt=0, le=100), NUMBER] = 1.0
    """Most messages per second. None is sent while the map does not change."""
    layers: Annotated[list[str], Once] = Field(default=[])
    """Layers of GridMap and PointCloud2; the first is GridMap's basic layer. Default: mean_height, traversability and
    confidence. An OccupancyGrid shows traversability."""
    level: NotNegativeWhole = 0
    """Level of the map."""
    robot: Annotated[Name | None, MaybeNone] = None
    """Robot around which the window lies. Default: the only one in ros2.robots."""
    size: tuple[Positive, Positive] = (20.0, 20.0)
    """Size of the window around the robot along x and y, metres."""
    box: MaybeBounds = None
    """A fixed window instead: xmin, ymin, xmax, ymax in the map frame, metres."""
    threshold: Share | None = None
    """OccupancyGrid: cells of at least this traversability are free (0), others occupied (100). Default: 0 to 100 by
    traversability, which Nav2's static layer reads as free below 100 unless trinary_costmap is false."""

    @model_validator(mode="after")
    def _fits(self) -> "Ros2OutConfig":
        for name in self.layers:
            if name not in LAYERS:
                raise ValueError(f"layers: must be from {', '.join(LAYERS)}; found {name!r}")
        if self.type == "OccupancyGrid" and self.layers:
            raise ValueError("layers: an OccupancyGrid shows traversability alone")
        if self.type != "OccupancyGrid" and self.threshold is not None:
            raise ValueError(f"threshold: only for an OccupancyGrid, not for a {self.type}")
        return self


class Ros2Config(Section):
    """ROS 2: without robots and outputs nothing is subscribed or published."""

    keys: Literal["rmw_zenoh", "ros2dds"] = "rmw_zenoh"
    """Zenoh keys of the topics: as of rmw_zenoh (Jazzy, Kilted), or as of zenoh-bridge-ros2dds and roughmap's own node:
    the topic without its first slash."""
    domain: Annotated[int, Field(ge=0, le=232), NUMBER] = 0
    """ROS_DOMAIN_ID, with keys = "rmw_zenoh"."""
    node: Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$", max_length=64)] = "roughmap"
    """Name of the node that other ROS nodes see."""
    robots: dict[Name, Ros2RobotConfig] = Field(default={})
    """Topics of each robot."""
    out: dict[Name, Ros2OutConfig] = Field(default={})
    """Topics with parts of the map."""

    @property
    def active(self) -> bool:
        """Whether anything comes in or goes out."""
        return bool(self.robots or self.out)

    @model_validator(mode="after")
    def _topics(self) -> "Ros2Config":
        known: dict[str, tuple[str, str]] = {}
        for robot, topics in self.robots.items():
            for topic, role in topics.roles:
                before = known.setdefault(topic, (robot, role))
                if before != (robot, role) and (before[1] != role or role not in SHARED):
                    found = " and ".join(f"{name}.{setting}" for name, setting in (before, (robot, role)))
                    raise ValueError(f"robots.{robot}.{role}: {topic} has one meaning, for one robot; found {found}")
        return self

    @model_validator(mode="after")
    def _windows(self) -> "Ros2Config":
        for name, out in self.out.items():
            if out.box is not None:
                continue
            if out.robot is not None and out.robot not in self.robots:
                raise ValueError(f"out.{name}.robot: must be from ros2.robots; found {out.robot!r}")
            if out.robot is None and len(self.robots) != 1:
                raise ValueError(f"out.{name}: needs a box, or the robot around which the window lies")
        return self
