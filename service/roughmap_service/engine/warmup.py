"""Compiling the kernels that the first scan and the first query need."""

import logging
import threading

import numpy as np

from roughmap.reading.cell_values import known_bits
from roughmap.tiles.index import rehash
from roughmap.tiles.slots import SlotPool
from roughmap_schemas import Config, contract_timed, decode_cloud, encode_cloud
from roughmap_schemas.layers import layers_of
from roughmap_service.host.log_lines import note
from roughmap_service.run.placing import place_cloud
from roughmap_service.run.pose_algebra import angle_between
from roughmap_service.run.poses import Pose
from roughmap_service.run.settings import Settings, new_map

logger = logging.getLogger(__name__)

TELL_SECONDS = 3.0
"""After this many seconds a log line says that kernels are being compiled; loading compiled ones takes less."""

LIMIT = 1 << 20
"""Bytes and points that the clouds here stay below."""

UNTURNED = (0.0, 0.0, 0.0, 1.0)


def warm_up(config: Config, stop: threading.Event) -> None:
    """Integrate a scan in a sensor's frame and one in the map's frame into a temporary map, unless ``stop`` is set.

    Kernels read points by address, so they are the same for every layout of a cloud. If it takes long, a log line says
    why.
    """
    text = "compiling kernels, once; this takes a minute or more"
    slow = threading.Timer(TELL_SECONDS, note, (logger, logging.INFO, "compiling", text))
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
    places = [[3.0, 0.0, -0.3], [0.0, 3.0, -0.5], [-3.0, 1.0, -0.4], [3.0, 0.0, 0.9]]  # the last is off the ground
    points = np.tile(places, (1400, 1))  # work for two threads
    points += np.linspace(0.0, 1e-3, len(points))[:, None]  # equal ones would be rejected
    angle_between(UNTURNED, UNTURNED)  # how far a pose turned
    rehash(np.empty(2, np.int32), np.zeros(1, np.uint64), 0)  # the index of tiles grows
    with new_map(config) as rough_map:
        for robot, frame in [("", settings.frame_id), *sensors[:1]]:
            if stop.is_set():
                return
            payload = encode_cloud(points, 0, frame, offsets_ns=np.arange(len(points)) * 1000)
            cloud = contract_timed(decode_cloud(payload, max_message=LIMIT, max_points=LIMIT))
            # While a reader holds a frozen map, tiles are copied before they change; that has a kernel too.
            with rough_map.freeze() as frozen:
                frozen.packed_layers(0, 0, ["mean_height"])
                known_bits(frozen.records(0, 0))
                rough_map.integrate(place_cloud(rough_map, robot, cloud, line, settings, clear=settings.clears))
        for level in (0, config.map.levels - 1):
            with rough_map.freeze(level) as frozen:
                for name in layers_of(config.map.surface):
                    frozen.packed_layers(0, 0, [name])
                    frozen.tile_layers(0, 0, [name])
        rough_map.digest()
        rough_map.forget(rough_map.tile_sequences()[0])
    pool, dense = SlotPool(), np.ones(1, np.bool_)
    pool.release(pool.allocate(1, dense))
    slots = pool.allocate(1, dense)  # the same slot again, cleared
    pool.take_columns(slots)
    for _ in range(2):  # the second copy has the same column again, cleared
        pool.release(pool.duplicate(slots))
