"""Compiling what the first scan and the first query would otherwise wait for."""

import logging
import threading

import numpy as np

from roughmap.tiles.index import rehash
from roughmap.tiles.slots import SlotPool
from roughmap_schemas import Config, decode_cloud, encode_cloud
from roughmap_service.host.log_lines import note
from roughmap_service.run.placing import place_cloud
from roughmap_service.run.poses import Pose
from roughmap_service.run.settings import Settings, new_map

log = logging.getLogger(__name__)

TELL_SECONDS = 3.0
"""What takes longer is no loading of kernels that an earlier start compiled."""

LIMIT = 1 << 20
"""Bytes and points that the clouds in here stay below."""

UNTURNED = (0.0, 0.0, 0.0, 1.0)


def warm_up(config: Config, stop: threading.Event) -> None:
    """Run the way of a scan once from a sensor and once in the map's frame, on a map of its own that is thrown away; no
    further than ``stop`` being set. Where it takes long, the log says why.

    Kernels read points by address: they are the same for every layout of a cloud.
    """
    text = "kernels are compiled, once: this takes a minute or more"
    slow = threading.Timer(TELL_SECONDS, note, (log, logging.INFO, "compiling", text))
    slow.daemon = True
    slow.start()
    try:
        _run(config, stop)
    finally:
        slow.cancel()


def _run(config: Config, stop: threading.Event) -> None:
    settings = Settings(config)
    sensors = [("", frame) for frame in config.sensors]
    sensors += [(robot, frame) for robot, own in config.robots.items() for frame in own.sensors]
    line = [Pose(k * 10**9, (0.0, 0.0, 0.0), UNTURNED, None, 1, 0) for k in (0, 1)]
    points = np.tile([[3.0, 0.0, -0.3], [0.0, 3.0, -0.5], [-3.0, 1.0, -0.4]], (1400, 1))  # work for two threads
    rehash(np.empty(2, np.int32), np.zeros(1, np.uint64), 0)  # an index of tiles that grows
    with new_map(config) as rough_map:
        for robot, frame in [("", settings.frame_id), *sensors[:1]]:
            if stop.is_set():
                return
            payload = encode_cloud(points, 0, frame, offsets_ns=np.arange(len(points)) * 1000)
            cloud = decode_cloud(payload, max_message=LIMIT, max_points=LIMIT)
            # While part of the map is frozen for a reader, what is written to is copied: that has its kernel too.
            with rough_map.freeze():
                rough_map.integrate(place_cloud(rough_map, robot, cloud, line, settings))
        rough_map.region((-2.0, -2.0, 2.0, 2.0), ["mean_height", "confidence_level", "traversability"], level=0)
        rough_map.region((-2.0, -2.0, 2.0, 2.0), ["mean_height"], level=config.map.levels - 1)
        rough_map.digest()
    pool, dense = SlotPool(), np.ones(1, np.bool_)
    pool.release(pool.allocate(1, dense))
    (slot,) = pool.allocate(1, dense).tolist()  # the same again, and what was in it is cleared
    pool.known_rows(slot)  # what a tile that leaves memory is asked
