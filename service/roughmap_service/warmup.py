"""Compiling what the first scan and the first query would otherwise wait for."""

import threading
from itertools import product

import numpy as np

from roughmap.index import rehash
from roughmap.memory import SlotPool
from roughmap_schemas import Config, decode_cloud, encode_cloud

from .apply import integrate
from .poses import Pose
from .settings import Settings, new_map

LIMIT = 1 << 20
"""Bytes and points that the clouds in here stay below."""

UNTURNED = (0.0, 0.0, 0.0, 1.0)

STAMPS_NS = (0, 1, 1 << 7, 1 << 14, 1 << 21, 1 << 28)
"""Each takes a byte more in the message, so that the points begin at another address: those of some clouds are aligned
for their type, those of others not, and the two are two layouts."""


def warm_up(config: Config, stop: threading.Event) -> None:
    """Run the way of a scan once with every kind of cloud, on a map of its own that is thrown away; no further than
    ``stop`` being set.

    The clouds come from the codec: kernels are compiled for each layout of arrays that it hands on (either type,
    packed or with other fields between, aligned or not), and a layout left out here would cost the first scan a second
    or more.
    """
    settings = Settings(config)
    sensors = [("", frame) for frame in config.sensors]
    sensors += [(robot, frame) for robot, own in config.robots.items() for frame in own.sensors]
    line = [Pose(k * 10**9, (0.0, 0.0, 0.0), UNTURNED, None, 1, 0) for k in (0, 1)]
    points = np.array([[3.0, 0.0, -0.3], [0.0, 3.0, -0.5], [-3.0, 1.0, -0.4]])
    done = set()
    rehash(np.empty(2, np.int32), np.zeros(1, np.uint64), 0)  # an index of tiles that grows
    with new_map(config) as rough_map:
        choices = product(
            (np.float32, np.float64),
            (None, np.array([0, 10**6, 10**7])),
            [("", settings.frame_id), *sensors[:1]],
            STAMPS_NS,
            (None, ((0.0, 0.0, 0.0), UNTURNED)),  # a pose that changes nothing, for 15 bytes more
        )
        for dtype, offsets, (robot, frame), stamp, pose in choices:
            if stop.is_set():
                return
            payload = encode_cloud(points.astype(dtype), stamp, frame, offsets_ns=offsets, pose=pose)
            cloud = decode_cloud(payload, max_message=LIMIT, max_points=LIMIT)
            kind = dtype, offsets is None, frame, cloud.points.flags.aligned
            # While part of the map is frozen for a reader, what is written to is copied: that has its kernel too.
            with rough_map.freeze():
                if kind not in done:
                    integrate(rough_map, robot, cloud, line, settings)
            done.add(kind)
        rough_map.region((-2.0, -2.0, 2.0, 2.0), ["mean_height", "confidence_level", "traversability"], level=0)
        rough_map.region((-2.0, -2.0, 2.0, 2.0), ["mean_height"], level=config.map.levels - 1)
        rough_map.digest()
    pool = SlotPool()
    pool.known_rows(int(pool.allocate(1)[0]))  # what a tile that leaves memory is asked
