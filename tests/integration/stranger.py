"""A program of someone who read the contract and nothing else: zenoh, Foxglove's protobuf, JSON and numpy.

It feeds a service whose map keeps all points, asks it, and holds the answers against a calculation of its own (whole
arrays at a time, two passes, matrix products: nothing is done the way the service does it). It digests the cells it is
told as the contract says, and tells the map's digest. Usage: stranger.py ENDPOINT MODEL
"""

import json
import math
import sys
import threading
from collections import defaultdict
from typing import Any

import numpy as np
import xxhash
import zenoh
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud

WAIT_S = 30.0
T0 = 1_700_000_000 * 10**9
CELL, COVERAGE, MIN_RADIUS, MIN_DISTANCE, MIN_SHARE = 0.1, 2.0, 1e-3, 1e-3, 0.05
PLACED_SIGMA, POSE_ERROR_TIME = 0.02, 5.0
TILE = 64
CELL_RECORD = np.dtype(
    [("count", "<u4"), ("updated", "<u4")]
    + [(name, "<f8") for name in ("weight", "weight_sq", "mean", "m2", "min", "max", "inv_cf")]
)
TRUST_RECORD = np.dtype(
    [(name, "<f4") for name in ("variance", "shared", "pose_variance", "mount_sigma")] + [("newest_ms", "<u4")]
)

SENSOR = {
    "translation": [0.3, -0.1, 0.8],
    "rotation": [0.0, 0.25881904510252074, 0.0, 0.9659258262890683],  # 30 degrees about y: it looks down
    "range_sigma": 0.01,
    "range_sigma_per_m": 0.002,
    "beam_sigma": 0.003,
    "mount_sigma": [0.002, 0.003, 0.004, 0.001, 0.002, 0.003],
}
"""What the service's configuration says of this sensor: the one thing that both must know."""


def rotation(q: np.ndarray) -> np.ndarray:
    """The matrix of x, y, z, w."""
    x, y, z, w = q / np.linalg.norm(q)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * K + 2 * K @ K


def skew(v: np.ndarray) -> np.ndarray:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def slerp(a: np.ndarray, b: np.ndarray, u: float) -> np.ndarray:
    angle = math.acos(min(1.0, float(a @ b)))
    return (math.sin((1 - u) * angle) * a + math.sin(u * angle) * b) / math.sin(angle)


POSES = (
    (T0, np.array([100.2, -50.7, 3.0]), np.array([0.0, 0.0, math.sin(0.3), math.cos(0.3)])),
    (T0 + 10**8, np.array([100.5, -50.6, 3.1]), np.array([0.02, -0.03, math.sin(0.35), math.cos(0.35)])),
)
POSES = tuple((t, p, q / np.linalg.norm(q)) for t, p, q in POSES)
A = np.random.default_rng(5).normal(size=(2, 6, 6))
COVARIANCES = [0.004**2 * (a @ a.T) for a in A]


def placed(points: np.ndarray, offsets_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Eq. 1 for each point with the pose at its own time: positions and covariances in the map frame.

    Then (N, 3): the variances of the heights from poses and mounting, and the times in milliseconds.
    """
    positions, covariances, shared = [], [], []
    R_rs, t_rs = rotation(np.array(SENSOR["rotation"])), np.array(SENSOR["translation"])
    for r_s, offset in zip(points, offsets_ns, strict=True):
        u = (20_000_000 + offset) / 1e8  # the cloud's stamp lies 20 ms after the first pose
        t = (1 - u) * POSES[0][1] + u * POSES[1][1]
        R = rotation(slerp(POSES[0][2], POSES[1][2], u))
        S_pose = (1 - u) * COVARIANCES[0] + u * COVARIANCES[1]
        r_map = R @ (R_rs @ r_s + t_rs) + t
        r = np.linalg.norm(r_s)
        along = np.outer(r_s, r_s) / r**2
        sr, st = SENSOR["range_sigma"] + SENSOR["range_sigma_per_m"] * r, SENSOR["beam_sigma"] * r
        S = R @ R_rs @ (sr**2 * along + st**2 * (np.eye(3) - along)) @ R_rs.T @ R.T
        J = np.hstack([np.eye(3), -skew(r_map - t)])
        J_m = np.hstack([np.eye(3), -skew(R @ R_rs @ r_s)])
        turn = np.kron(np.eye(2), R)
        S_mount = turn @ np.diag(np.array(SENSOR["mount_sigma"]) ** 2) @ turn.T
        positions.append(r_map)
        from_pose, from_mount = J @ S_pose @ J.T, J_m @ S_mount @ J_m.T
        covariances.append(S + from_pose + from_mount)
        shared.append([from_pose[2, 2], from_mount[2, 2], (T0 + 20_000_000 + int(offset)) // 10**6])
    return np.array(positions), np.array(covariances), np.array(shared)


def overlap(model: str, centre: np.ndarray, S: np.ndarray, i: int, j: int) -> float:
    """The point's share in cell (i, j)."""
    x0, x1, y0, y1 = i * CELL, (i + 1) * CELL, j * CELL, (j + 1) * CELL
    if model == "point":
        return float(x0 <= centre[0] < x1 and y0 <= centre[1] < y1)
    if model == "cuboid":
        rx, ry = (max(COVERAGE * math.sqrt(S[n, n]), MIN_RADIUS) for n in (0, 1))
        dx = min(centre[0] + rx, x1) - max(centre[0] - rx, x0)
        dy = min(centre[1] + ry, y1) - max(centre[1] - ry, y0)
        return max(dx, 0.0) * max(dy, 0.0) / (4 * rx * ry)
    # The ellipse by slices between the cell's two x, as thin at its ends as they are steep: x = c - rx cos(phi).
    rx = COVERAGE * math.sqrt(S[0, 0])
    first, last = (math.acos(min(1.0, max(-1.0, (centre[0] - x) / rx))) for x in (x0, x1))
    if first == last:
        return 0.0
    phi = first + (np.arange(20_000) + 0.5) * ((last - first) / 20_000)
    middle = centre[1] - S[0, 1] / S[0, 0] * rx * np.cos(phi)
    half = COVERAGE * math.sqrt(np.linalg.det(S[:2, :2]) / S[0, 0]) * np.sin(phi)
    height = np.clip(np.minimum(middle + half, y1) - np.maximum(middle - half, y0), 0.0, None)
    area = float((height * rx * np.sin(phi)).sum()) * (last - first) / 20_000
    return area / (math.pi * COVERAGE**2 * math.sqrt(np.linalg.det(S[:2, :2])))


def volume_weight(model: str, S: np.ndarray) -> float:
    """The weight without the share."""
    if model == "point":
        return 1.0
    if model == "cuboid":
        return CELL / math.prod(max(COVERAGE * math.sqrt(S[n, n]), MIN_RADIUS) for n in range(3))
    return CELL / (COVERAGE**3 * math.sqrt(np.linalg.det(S)))


def expected(
    model: str, points: np.ndarray, covariances: np.ndarray, shared: np.ndarray
) -> dict[tuple[int, int], dict[str, float]]:
    """Every cell's state, from all its points at once."""
    hits: dict[tuple[int, int], list[tuple[float, ...]]] = defaultdict(list)
    for point, S, (c, m, ms) in zip(points, covariances, shared, strict=True):
        i0, j0 = (math.floor(v / CELL) for v in point[:2])
        around = [(i, j) for i in range(i0 - 6, i0 + 7) for j in range(j0 - 6, j0 + 7)]
        shares = {cell: overlap(model, point, S, *cell) for cell in around}
        least = MIN_SHARE * max(shares.values())
        for cell, p in shares.items():
            assert abs(p - least) > 1e-5 or p == 0.0, "too close to min_share for a calculation by slices"
            if p >= least and p > 1e-12:
                hits[cell].append((point[2], volume_weight(model, S) * p, p, c, m, ms))
    states = {}
    for cell, rows in hits.items():
        h, w, p, c, m, ms = np.array(rows).T
        states[cell] = {**state(h, w, p), **trust(w, c, np.sqrt(m), ms)}
    return states


def trust(w: np.ndarray, c: np.ndarray, m: np.ndarray, ms: np.ndarray) -> dict[str, float]:
    """What poses and mounting do to the mean height: the mean's weights times what two of its points share.

    Each weight is a part w / W. Two points' pose errors have the older one's variance in common, less what each step of
    time between them takes away.
    """
    part = w / w.sum()
    step = np.clip(1 - np.abs(np.diff(ms)) / (4000 * POSE_ERROR_TIME), 0, None) ** 4
    variance, shared = float((part**2 * c).sum()), 0.0
    for old in range(len(w)):
        alike = c[old] * np.concatenate([[1.0], np.cumprod(step[old:])])
        variance += float(2 * part[old] * (part[old + 1 :] * alike[1:]).sum())
        shared += float(part[old] * alike[-1])
    return {
        "variance": variance, "shared": shared, "pose_variance": float((part * c).sum()),
        "mount_sigma": float((part * m).sum()), "newest_ms": int(ms[-1]) % 2**32,
    }  # fmt: skip


def state(h: np.ndarray, w: np.ndarray, p: np.ndarray) -> dict[str, float]:
    mean = float((w * h).sum() / w.sum())
    running = np.cumsum(w * h) / np.cumsum(w)
    distance = np.maximum(np.abs(h - running), MIN_DISTANCE)
    W, W2, m2 = float(w.sum()), float((w * w / p).sum()), float((w * (h - mean) ** 2).sum())
    n = W * W / W2
    deviation = math.sqrt(m2 / (W - W2 / W)) if len(h) > 1 and n > 1 + 1e-6 else math.nan
    confidence = math.erf(0.05 * math.sqrt(n) / (2 * deviation) / math.sqrt(2)) if deviation > 0 else math.nan
    return {
        "count": len(h), "weight": W, "weight_sq": W2, "mean": mean, "m2": m2, "min": float(h.min()),
        "max": float(h.max()), "inv_cf": float((w / distance**2).sum()), "std_dev": deviation,
        "expected_count": n, "confidence_level": confidence, "range": float(h.max() - h.min()),
    }  # fmt: skip


def cloud(points: np.ndarray, frame: str, stamp_ns: int, offsets_ns: np.ndarray | None = None) -> bytes:
    """x, y, z as float64 with a gap between, and t in nanoseconds."""
    packed = np.zeros(len(points), np.dtype({"names": ["t", "x", "y", "z"], "formats": ["<u4", "<f8", "<f8", "<f8"],
                                             "offsets": [0, 8, 16, 24], "itemsize": 40}))  # fmt: skip
    for axis, name in enumerate("xyz"):
        packed[name] = points[:, axis]
    message = PointCloud(frame_id=frame, point_stride=40, data=packed.tobytes())
    message.timestamp.FromNanoseconds(stamp_ns)
    for name, offset in (("x", 8), ("y", 16), ("z", 24)):
        message.fields.append(PackedElementField(name=name, offset=offset, type=PackedElementField.FLOAT64))
    if offsets_ns is not None:
        packed["t"] = offsets_ns
        message.data = packed.tobytes()
        message.fields.append(PackedElementField(name="t", offset=0, type=PackedElementField.UINT32))
    return bytes(message.SerializeToString())


def odometry(stamp_ns: int, position: np.ndarray, q: np.ndarray, covariance: np.ndarray) -> bytes:
    message = Odometry(frame_id="map", body_frame_id="base_link", pose_covariance=covariance.ravel().tolist())
    message.timestamp.FromNanoseconds(stamp_ns)
    p, o = message.pose.position, message.pose.orientation
    p.x, p.y, p.z = position
    o.x, o.y, o.z, o.w = q
    return bytes(message.SerializeToString())


def ask(session: zenoh.Session, selector: str, payload: bytes | None = None) -> list[zenoh.Sample]:
    replies = session.get(selector, payload=payload, timeout=WAIT_S, consolidation=zenoh.ConsolidationMode.NONE)
    found = []
    for reply in replies:
        assert reply.ok is not None, reply.err.payload.to_string()
        found.append(reply.ok)
    return found


def check(what: str, found: float | None, wanted: float, rtol: float, atol: float = 0.0) -> None:
    if math.isnan(wanted):
        assert found is None, f"{what}: {found}, expected null"
    else:
        assert found is not None, f"{what}: null, expected {wanted}"
        assert math.isclose(found, wanted, rel_tol=rtol, abs_tol=atol), f"{what}: {found}, expected {wanted}"


def main(endpoint: str, model: str) -> None:
    config = zenoh.Config()
    for key, value in (("mode", "client"), ("connect/endpoints", [endpoint]), ("scouting/multicast/enabled", False)):
        config.insert_json5(key, json.dumps(value))
    rng = np.random.default_rng(11)
    # Beams to a small patch of ground, so that cells get several points each; two of them alone, far from the rest.
    points = np.vstack([rng.uniform([2.0, -0.25, -0.2], [2.6, 0.25, 0.2], (60, 3)), [[4.0, 0.3, 0.4], [1.2, 0.9, 0.1]]])
    offsets = rng.integers(0, 70_000_000, len(points))
    alone = np.array([[0.05, 0.05, 1.25]])

    integrated = threading.Semaphore(0)
    with zenoh.open(config) as session:

        def heard(sample: zenoh.Sample) -> None:
            event = json.loads(sample.payload.to_bytes())
            if event["kind"] == "integration":
                assert event["outcome"] == "integrated", event
                integrated.release()

        session.declare_subscriber("maps/site/events", heard)
        assert json.loads(ask(session, "maps/site/status")[0].payload.to_bytes())["error_model"] == model
        block = {"congestion_control": zenoh.CongestionControl.BLOCK}
        session.put("robots/mule/points", cloud(alone, "map", T0), **block)
        for (stamp, position, q), covariance in zip(POSES, COVARIANCES, strict=True):
            session.put("robots/mule/odometry", odometry(stamp, position, q, covariance), **block)
        session.put("robots/mule/points", cloud(points, "lidar", T0 + 20_000_000, offsets), **block)
        for _ in range(2):
            assert integrated.acquire(timeout=WAIT_S), "the clouds were not integrated"

        # By hand: r = 2 * 0.02 m, the whole footprint within one cell; eq. 14's weight is 0.1 / 0.04^3 either way.
        weight = 1.0 if model == "point" else 1562.5
        answer = json.loads(
            ask(session, "maps/site/cells?x=0.05;y=0.05;layers=mean_height,std_dev")[0].payload.to_bytes()
        )
        (cell,) = answer["cells"]
        assert (cell["i"], cell["j"]) == (0, 0)
        assert cell["layers"] == {"mean_height": 1.25, "std_dev": None}
        by_hand = {
            "count": 1, "updated": T0 // 10**9, "weight": weight, "weight_sq": weight**2, "mean": 1.25, "m2": 0.0,
            "min": 1.25, "max": 1.25, "inv_cf": weight * 1e6,
        }  # fmt: skip
        for name, value in by_hand.items():
            assert math.isclose(cell["state"][name], value, rel_tol=1e-12), (name, cell["state"][name], value)
        for name in ("variance", "shared", "pose_variance"):
            assert cell["state"][name] == float(np.float32(PLACED_SIGMA**2)), name
        assert cell["state"]["mount_sigma"] == 0.0

        cells = expected(model, *placed(points, offsets))
        states = compare(session, model, cells, alone=(0, 0))
        states[0, 0] = {**cell["state"], "newest_ms": T0 // 10**6 % 2**32}
        digest = map_digest(session, states)
        print(json.dumps({"cells": len(cells), "counts": [c["count"] for c in cells.values()], "digest": digest}))


def map_digest(session: zenoh.Session, states: dict[tuple[int, int], Any]) -> str:
    """The map's digest, from the states of all known cells. Each tile's must be the one that the service tells."""
    tiles = {}
    for (i, j), told in states.items():
        key = i // TILE, j // TILE
        records, trusts = tiles.setdefault(
            key, (np.zeros((TILE, TILE), CELL_RECORD), np.zeros((TILE, TILE), TRUST_RECORD))
        )
        for array in (records, trusts):
            array[j % TILE, i % TILE] = tuple(told[name] for name in array.dtype.names)
    total = 0
    for (x, y), arrays in tiles.items():
        digest = xxhash.xxh3_128(b"".join(array.tobytes() for array in arrays)).digest()
        (reply,) = ask(session, f"maps/site/tiles/0/{x}/{y}")
        assert json.loads(reply.attachment.to_bytes())["digest"] == digest.hex(), f"tile {x}, {y}"
        total += xxhash.xxh3_128_intdigest(np.array([x, y], "<i4").tobytes() + digest)
    return xxhash.xxh3_128_hexdigest(len(tiles).to_bytes(8, "little") + (total % 2**128).to_bytes(16, "little"))


def compare(
    session: zenoh.Session, model: str, cells: dict[tuple[int, int], Any], alone: tuple[int, int]
) -> dict[tuple[int, int], Any]:
    """Hold all answers against ``cells``; return the states as told, with the times that the contract doesn't tell."""
    # Slices give an ellipse's share to about 1e-8 of the whole, hence 1e-6 of a small one; the rest agrees to rounding.
    rtol = 1e-6 if model == "ellipsoid" else 1e-9
    order = sorted(cells)
    centres = [[(i + 0.5) * CELL, (j + 0.5) * CELL] for i, j in order]
    layers = ["std_dev", "expected_count", "confidence_level", "range"]
    selector = f"maps/site/cells?layers={','.join(layers)}"
    answer = json.loads(ask(session, selector, json.dumps(centres).encode())[0].payload.to_bytes())
    for wanted, got in zip(order, answer["cells"], strict=True):
        assert (got["i"], got["j"]) == wanted
        for name in ("count", "weight", "weight_sq", "mean", "m2", "min", "max", "inv_cf"):
            # Heights near 3 m are rounded to some 1e-16: of equal ones, m2 may come out as the square of that, not 0.
            atol = 1e-28 * cells[wanted]["weight"] if name == "m2" else 0.0
            check(f"{wanted} {name}", got["state"][name], cells[wanted][name], rtol, atol)
        for name in ("variance", "shared", "pose_variance", "mount_sigma"):
            # Kept in float32: every point rounds some 6e-8 away, and a cell has tens of them.
            check(f"{wanted} {name}", got["state"][name], cells[wanted][name], 1e-5)
        for name in layers:
            # The service's error function is a polynomial, good to 1e-7.
            atol = 1e-7 if name == "confidence_level" else 0.0
            check(f"{wanted} {name}", got["layers"][name], cells[wanted][name], rtol, atol)

    known: dict[tuple[int, int], float] = {}
    replies = ask(session, "maps/site/tiles/0/*/*?layers=mean_height,count;dtype=f8")
    for reply in replies:
        info, grid = json.loads(reply.attachment.to_bytes()), Grid.FromString(reply.payload.to_bytes())
        assert info["answer_tiles"] == len(replies)
        assert str(reply.key_expr) == f"maps/site/tiles/0/{info['x']}/{info['y']}"
        assert [field.name for field in grid.fields] == ["mean_height", "count"]
        planes = np.frombuffer(grid.data, "<f8").reshape(-1, grid.column_count, 2)
        assert grid.cell_stride == 16
        assert grid.row_stride == 16 * grid.column_count
        for row, column in np.argwhere(planes[:, :, 1] > 0):
            known[info["x"] * 64 + int(column), info["y"] * 64 + int(row)] = float(planes[row, column, 0])
    assert set(known) == {*cells, alone}, "the tiles know other cells"
    for cell in order:
        check(f"{cell} in the tile", known[cell], cells[cell]["mean"], rtol)
    return {
        cell: {**got["state"], "newest_ms": cells[cell]["newest_ms"]}
        for cell, got in zip(order, answer["cells"], strict=True)
    }


if __name__ == "__main__":
    main(*sys.argv[1:])
    assert not [name for name in sys.modules if name.startswith("roughmap")], "a stranger has no roughmap"
