"""What comes over the network, as functions of any bytes: only the contract's errors come out, and what is read can be
written again. A target may take any bytes; what it raises is a finding."""

import contextlib
import math
from collections.abc import Callable

import numpy as np

from roughmap_client.errors import RoughMapError
from roughmap_client.replies import read_cells, read_model, read_region, read_tiles
from roughmap_client.session import Answer, Part
from roughmap_schemas import (
    BadJson,
    CellAnswer,
    CellsQuery,
    Cloud,
    ContractError,
    Keys,
    MapStatus,
    MessageFault,
    QueryFault,
    Receipt,
    RegionQuery,
    RunMetadata,
    TileQuery,
    TimeForm,
    UnknownEventKind,
    contract_timed,
    decode_cloud,
    decode_event,
    decode_grid,
    decode_odometry,
    decode_transform,
    encode_cloud,
    encode_event,
    encode_odometry,
    encode_transform,
    parse_model,
    timed,
)
from roughmap_service.run.point_times import find_form, misfit

MAX_MESSAGE = 1 << 20
MAX_POINTS = 10_000
KEYS = Keys("site")
LEVELS = 8


def decoded(payload: bytes) -> Cloud:
    return decode_cloud(payload, max_message=MAX_MESSAGE, max_points=MAX_POINTS, map_frame="map")


def check_forms(raw: Cloud) -> None:
    """Whatever its fields hold, a cloud's times come out within their limits in every form."""
    form = find_form([(raw.stamp_ns, raw.time_fields)], last=True)
    forms = [TimeForm("t", unit, origin) for unit in ("s", "ns") for origin in ("start", "end", "absolute")]
    for tried in [form, *forms] if isinstance(form, TimeForm) else forms:
        misfit(raw, tried)
        got = timed(raw, tried)
        assert 0 <= got.stamp_ns < 2**32 * 10**9
        assert got.offsets_ns is None or np.all((got.offsets_ns >= -1) & (got.offsets_ns <= 10**9))


def cloud(payload: bytes) -> None:
    with contextlib.suppress(MessageFault):
        raw = decoded(payload)
        check_forms(raw)
        got = contract_timed(raw)
        assert got.points.shape == (len(got.points), 3)
        assert len(got.points) <= min(MAX_POINTS, len(payload))
        assert 0 <= got.stamp_ns < 2**32 * 10**9
        offsets = got.offsets_ns
        if offsets is not None:
            assert offsets.shape == (len(got.points),)
            assert np.all((offsets >= -1) & (offsets <= 10**9))
            offsets = np.where(offsets < 0, 2 * 10**9, offsets)  # a time that is off is written as one that is off
        written = encode_cloud(got.points, got.stamp_ns, got.frame_id, offsets)
        again = contract_timed(decoded(written))
        assert (again.frame_id, again.stamp_ns) == (got.frame_id, got.stamp_ns)
        assert again.points.tobytes() == got.points.tobytes()
        if got.offsets_ns is not None:
            assert again.offsets_ns is not None
            assert np.array_equal(again.offsets_ns, got.offsets_ns)


def odometry(payload: bytes) -> None:
    with contextlib.suppress(MessageFault):
        got = decode_odometry(payload, max_message=MAX_MESSAGE)
        assert all(map(math.isfinite, got.position))
        assert abs(math.hypot(*got.rotation) - 1.0) < 1e-12, "of unit length but for rounding"
        written = encode_odometry(
            got.stamp_ns, got.frame_id, got.position, got.rotation, got.covariance, got.body_frame_id
        )
        again = decode_odometry(written, max_message=MAX_MESSAGE)
        assert (again.stamp_ns, again.frame_id, again.body_frame_id) == (got.stamp_ns, got.frame_id, got.body_frame_id)
        assert again.position == got.position
        assert (again.covariance is None) == (got.covariance is None)
        if got.covariance is not None:
            assert not got.covariance_fault
            assert np.array_equal(got.covariance, again.covariance)


def transform(payload: bytes) -> None:
    with contextlib.suppress(MessageFault):
        got = decode_transform(payload, max_message=MAX_MESSAGE)
        assert all(map(math.isfinite, got.translation))
        written = encode_transform(got.stamp_ns, got.parent_frame_id, got.child_frame_id, got.translation, got.rotation)
        again = decode_transform(written, max_message=MAX_MESSAGE)
        assert again.translation == got.translation
        assert (again.parent_frame_id, again.child_frame_id) == (got.parent_frame_id, got.child_frame_id)


def grid(payload: bytes) -> None:
    for compression in (None, "zstd"):
        with contextlib.suppress(MessageFault):
            got = decode_grid(payload, compression, max_data=MAX_MESSAGE)  # type: ignore[arg-type]
            for layer in got.layers.values():
                assert layer.nbytes <= MAX_MESSAGE
                layer.copy()


def selectors(payload: bytes) -> None:
    text = payload.decode(errors="replace")
    with contextlib.suppress(QueryFault):
        tiles = TileQuery.parse(text)
        assert TileQuery.parse(tiles.format()) == tiles
    with contextlib.suppress(QueryFault):
        region = RegionQuery.parse(text, LEVELS)
        assert RegionQuery.parse(region.format(), LEVELS) == region


def cells(payload: bytes) -> None:
    """The parameters, and behind the first line break the payload."""
    parameters, _, places = payload.partition(b"\n")
    with contextlib.suppress(QueryFault):
        query = CellsQuery.parse(parameters.decode(errors="replace"), places)
        assert len(query.points) <= 10_000
        assert all(math.isfinite(x) and math.isfinite(y) for x, y in query.points)
        if query.points:  # of none, nothing is left to tell parameters from payload
            assert CellsQuery.parse(*query.format()) == query


def keys(payload: bytes) -> None:
    key = payload.decode(errors="replace")
    with contextlib.suppress(QueryFault):
        z, x, y = KEYS.parse_tile_selector(key, LEVELS)
        assert KEYS.tiles(z, x, y) == key
    robots: tuple[tuple[Callable[[str], str], Callable[[str], str]], ...] = (
        (KEYS.parse_points, KEYS.points),
        (KEYS.parse_odometry, KEYS.odometry),
        (KEYS.parse_transform, KEYS.transform),
    )
    for parse, make in robots:
        with contextlib.suppress(MessageFault):
            robot = parse(key)
            assert 1 <= len(robot) <= 64
            assert make(robot) == key
    with contextlib.suppress(MessageFault):
        kind, robot = KEYS.parse_ingest(key)
        assert KEYS.form(f"ingest_{kind}").make(robot=robot) == key
    with contextlib.suppress(ContractError):
        Keys(key[:64], {"points": key})


def events(payload: bytes) -> None:
    with contextlib.suppress(BadJson, UnknownEventKind):
        event = decode_event(payload)
        assert decode_event(encode_event(event)) == event
    for kind in (Receipt, CellAnswer, MapStatus):
        with contextlib.suppress(BadJson):
            parse_model(kind, payload)
    record = dict(line.partition("=")[::2] for line in payload.decode(errors="replace").splitlines())
    with contextlib.suppress(BadJson):
        RunMetadata.from_record(record)


def replies(payload: bytes) -> None:
    """What a client gets: the attachment, and behind the first line break the payload."""
    attachment, _, rest = payload.partition(b"\n")
    part = Part(key="maps/site/tiles/0/0/0", payload=rest, attachment=attachment, encoding="", replier="r")
    layers = ("mean_height",)
    with contextlib.suppress(RoughMapError):
        assert read_tiles([part], ())[0].shape == (64, 64)
    with contextlib.suppress(RoughMapError):
        read_tiles([part, part], layers)
    with contextlib.suppress(RoughMapError):
        region = read_region(part, layers)
        assert list(region) == list(layers)
        assert region["mean_height"].shape == region.shape
    with contextlib.suppress(RoughMapError):
        assert len(read_cells(part, layers, 1).i) == 1
    with contextlib.suppress(RoughMapError):
        read_model(part, MapStatus)
    with contextlib.suppress(RoughMapError):
        Answer(errors=[(rest, attachment.decode(errors="replace"))]).whole()
