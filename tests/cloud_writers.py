"""Writers of clouds by the formats' specifications, which share nothing with the readers."""

import struct
from pathlib import Path

import numpy as np

SCALE = 0.00025
OFFSET = (515_000.0, 4_918_000.0, 2_000.0)


def grid_of(points: np.ndarray, scale: float = SCALE, offset: tuple[float, float, float] = OFFSET) -> np.ndarray:
    """The whole numbers of the points in a LAS file."""
    return np.rint((points - np.array(offset)) / scale).astype(np.int64)


def on_grid(points: np.ndarray) -> np.ndarray:
    """The nearest points that a LAS file of ours holds."""
    return grid_of(points) * SCALE + np.array(OFFSET)


def las_record(user: bytes, number: int, data: bytes) -> bytes:
    return struct.pack("<H16sHH32s", 0, user, number, len(data), b"") + data


def las_bytes(
    points: np.ndarray,
    *,
    minor: int = 2,
    form: int = 1,
    times: np.ndarray | None = None,
    classes: np.ndarray | None = None,
    withheld: np.ndarray | None = None,
    encoding: int = 0,
    records: tuple[bytes, ...] = (),
    extra: int = 0,
    scale: float = SCALE,
    offset: tuple[float, float, float] = OFFSET,
) -> bytes:
    """A LAS file 1.2 (formats 0 and 1) or 1.4 (format 6), as ASPRS has it; `extra` bytes follow each point."""
    count = len(points)
    times = np.zeros(count) if times is None else times
    classes = np.full(count, 2) if classes is None else classes
    withheld = np.zeros(count, bool) if withheld is None else withheld
    head = {2: 227, 4: 375}[minor]
    length = {0: 20, 1: 28, 6: 30}[form] + extra
    legacy = 0 if form >= 6 else count
    known = b"".join(records)
    out = bytearray(struct.pack("<4sHH16sBB32s32sHH", b"LASF", 0, encoding, b"", 1, minor, b"hand", b"hand", 1, 2024))
    out += struct.pack("<HIIBHI5I", head, head + len(known), len(records), form, length, legacy, legacy, 0, 0, 0, 0)
    out += struct.pack("<3d3d", scale, scale, scale, *offset)
    low, high = (points.min(axis=0), points.max(axis=0)) if count else (np.zeros(3), np.zeros(3))
    out += struct.pack("<6d", high[0], low[0], high[1], low[1], high[2], low[2])
    if minor == 4:
        out += struct.pack("<QQIQ15Q", 0, 0, 0, count, count, *[0] * 14)
    assert len(out) == head
    out += known
    whole = grid_of(points, scale, offset).tolist()
    for (x, y, z), t, kind, hidden in zip(whole, times.tolist(), classes.tolist(), withheld.tolist(), strict=True):
        if form >= 6:
            flags = 4 if hidden else 0
            out += struct.pack("<iiiHBBBBhHd", x, y, z, 7, 0x11, flags, kind, 0, 0, 1, t)
        else:
            out += struct.pack("<iiiHBBbBH", x, y, z, 7, 0x09, kind | (0x80 if hidden else 0), 0, 0, 1)
            if form == 1:
                out += struct.pack("<d", t)
        out += bytes(extra)
    return bytes(out)


def ply_bytes(points: np.ndarray, form: str = "binary_little_endian", kind: str = "double") -> bytes:
    """A PLY file with a face and a list before the vertices, a colour in each, and an element behind them."""
    order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[form]
    number = {"double": "d", "float": "f"}[kind]
    head = (
        f"ply\nformat {form} 1.0\ncomment by hand\nelement face 2\nproperty list uchar int vertex_index\n"
        f"element vertex {len(points)}\nproperty uchar red\nproperty {kind} x\nproperty {kind} y\nproperty {kind} z\n"
        "element camera 1\nproperty float view\nend_header\n"
    ).encode()
    if form == "ascii":
        digits = [[repr(float(np.float32(v)) if kind == "float" else float(v)) for v in row] for row in points]
        rows = "".join(f"200 {x} {y} {z}\n" for x, y, z in digits)
        return head + b"3 0 1 2\n4 0 1 2 3\n" + rows.encode() + b"1.5\n"
    faces = struct.pack(f"{order}B3iB4i", 3, 0, 1, 2, 4, 0, 1, 2, 3)
    rows = b"".join(struct.pack(f"{order}B3{number}", 200, *row) for row in points.tolist())
    return head + faces + rows + struct.pack(f"{order}f", 1.5)


def pcd_head(points: np.ndarray, data: str, size: int = 8, viewpoint: str = "0 0 0 1 0 0 0") -> bytes:
    """The header of a PCD file with an intensity, a padding of three bytes, and x, y, z."""
    return (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS intensity _ x y z\n"
        f"SIZE 4 1 {size} {size} {size}\nTYPE F U F F F\nCOUNT 1 3 1 1 1\nWIDTH {len(points)}\nHEIGHT 1\n"
        f"VIEWPOINT {viewpoint}\nPOINTS {len(points)}\nDATA {data}\n"
    ).encode()


def lzf_literal(data: bytes) -> bytes:
    """Data in LZF's form, without a copy."""
    return b"".join(bytes([len(part) - 1]) + part for part in (data[k : k + 32] for k in range(0, len(data), 32)))


def pcd_bytes(points: np.ndarray, data: str, size: int = 8, viewpoint: str = "0 0 0 1 0 0 0") -> bytes:
    """A PCD file with points (N, 3) of so many bytes a number."""
    head = pcd_head(points, data, size, viewpoint)
    values = points.astype({4: "<f4", 8: "<f8"}[size])
    if data == "ascii":
        rows = [[repr(value) for value in row] for row in values.astype(float).tolist()]
        return head + "".join(f"0.5 1 2 3 {x} {y} {z}\n" for x, y, z in rows).encode()
    if data == "binary":
        return head + b"".join(struct.pack("<fBBB", 0.5, 1, 2, 3) + row.tobytes() for row in values)
    planes = struct.pack("<f", 0.5) * len(points) + bytes(3 * len(points))
    planes += b"".join(np.ascontiguousarray(values[:, k]).tobytes() for k in range(3))
    packed = lzf_literal(planes)
    return head + struct.pack("<II", len(packed), len(planes)) + packed


def tum_line(stamp_ns: int, position: np.ndarray, rotation: np.ndarray) -> str:
    numbers = " ".join(repr(float(value)) for value in (*position, *rotation))
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d} {numbers}\n"


def write_tum(path: Path, stamps_ns: list[int], poses: np.ndarray) -> Path:
    """A trajectory of poses (K, 4, 4), with all digits."""
    from scipy.spatial.transform import Rotation

    turns = [Rotation.from_matrix(pose[:3, :3]).as_quat() for pose in poses]
    lines = [tum_line(stamp, pose[:3, 3], turn) for stamp, pose, turn in zip(stamps_ns, poses, turns, strict=True)]
    path.write_text("# t x y z qx qy qz qw\n" + "".join(lines))
    return path


def write_kitti(folder: Path, scans: list[np.ndarray], poses: np.ndarray, tr: np.ndarray, times: list[float]) -> Path:
    """A sequence with poses (K, 4, 4) of the scanner in the map, whose camera sits at `tr` (4, 4)."""
    (folder / "velodyne").mkdir(parents=True)
    for k, scan in enumerate(scans):
        rows = np.zeros((len(scan), 4), "<f4")
        rows[:, :3] = scan
        rows.tofile(folder / "velodyne" / f"{k:06d}.bin")
    cameras = tr @ poses @ np.linalg.inv(tr)
    text = ["".join(f"{value!r} " for value in row[:3].ravel().tolist()).rstrip() + "\n" for row in (*cameras, tr)]
    (folder / "poses.txt").write_text("".join(text[:-1]))
    (folder / "calib.txt").write_text("P0: " + "1 " * 12 + "\nTr: " + text[-1])
    (folder / "times.txt").write_text("".join(f"{second:.6e}\n" for second in times))
    return folder
