"""Compiling what the first scan and the first query would otherwise wait for."""

import numpy as np

from roughmap_schemas import Config, decode_cloud, encode_cloud

from .apply import integrate
from .poses import Pose
from .settings import Settings, new_map

LIMIT = 1 << 20
"""Bytes and points that the clouds in here stay below."""

UNTURNED = (0.0, 0.0, 0.0, 1.0)


def warm_up(config: Config) -> None:
    """Run the way of a scan once with every kind of cloud, on a map of its own that is thrown away.

    The clouds come from the codec: kernels are compiled for each layout of arrays that it hands on (either type,
    packed or with other fields between), and a layout left out here would cost the first scan a second or more.
    """
    settings = Settings(config)
    sensors = [("", frame) for frame in config.sensors]
    sensors += [(robot, frame) for robot, own in config.robots.items() for frame in own.sensors]
    line = [Pose(k * 10**9, (0.0, 0.0, 0.0), UNTURNED, None, 1, 0) for k in (0, 1)]
    points = np.array([[3.0, 0.0, -0.3], [0.0, 3.0, -0.5], [-3.0, 1.0, -0.4]])
    with new_map(config) as rough_map:
        for dtype in (np.float32, np.float64):
            for offsets in (None, np.array([0, 10**6, 10**7])):
                for robot, frame in [("", settings.frame_id), *sensors[:1]]:
                    payload = encode_cloud(points.astype(dtype), 0, frame, offsets_ns=offsets)
                    cloud = decode_cloud(payload, max_message=LIMIT, max_points=LIMIT)
                    integrate(rough_map, robot, cloud, line, settings)
        rough_map.region((-2.0, -2.0, 2.0, 2.0), ["mean_height", "confidence_level", "traversability"], level=0)
        rough_map.region((-2.0, -2.0, 2.0, 2.0), ["mean_height"], level=config.map.levels - 1)
        rough_map.digest()
