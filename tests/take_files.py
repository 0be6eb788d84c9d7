"""Files of takes as capture programs write them, of points that are given."""

from __future__ import annotations

import io
import math
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np

BLOCK = 512
INTEL = 84
DEC = 85
MIPS = 86


def face_points(frames: int = 12, tracks: int = 5, seed: int = 1) -> np.ndarray:
    """Return points (f, k, 3) in mm about as far apart as markers of a face, some missing."""
    random = np.random.default_rng(seed)
    rest = random.normal((10.0, 800.0, 30.0), (45.0, 55.0, 25.0), (tracks, 3))
    points = rest + random.normal(0.0, 2.0, (frames, tracks, 3))
    points[frames // 2, 0] = np.nan
    return points.astype(np.float32).astype(float)


def default_labels(count: int) -> list[str]:
    return [f"LBRO{number}" for number in range(1, count + 1)]


def c3d_bytes(
    points: np.ndarray,
    labels: Sequence[str] | None = None,
    *,
    processor: int = INTEL,
    scale: float = -1.0,
    rate: float = 120.0,
    first: int = 1,
    unit: str | None = "mm",
    analog: tuple[int, int] = (0, 0),
    residual: float = 2.0,
    header: dict[str, float] | None = None,
    parameters: dict[tuple[str, str], Any] | None = None,
) -> bytes:
    """Return a C3D; ``analog`` has channels and samples a frame.

    ``header`` and ``parameters`` overrule single values; a parameter of None is left out.
    """
    frames, tracks = points.shape[:2]
    labels = default_labels(tracks) if labels is None else labels
    channels, samples = analog
    said: dict[tuple[str, str], Any] = {
        ("POINT", "USED"): np.int16(tracks),
        ("POINT", "SCALE"): np.float32(scale),
        ("POINT", "RATE"): np.float32(rate),
        ("POINT", "FRAMES"): _word(min(frames, 65535)),
        ("POINT", "DATA_START"): np.int16(0),
        **_label_parameters(labels),
        ("POINT", "UNITS"): None if unit is None else [unit],
        ("ANALOG", "USED"): np.int16(channels),
        ("ANALOG", "RATE"): np.float32(rate * samples),
        **(parameters or {}),
    }
    if said["POINT", "DATA_START"] == 0:
        length = len(_section(said, processor, 0))
        start = 2 + math.ceil(length / BLOCK)
        said["POINT", "DATA_START"] = _word(start)
    else:
        start = int(said["POINT", "DATA_START"])
    section = _section(said, processor, start - 2).ljust((start - 2) * BLOCK, b"\0")
    words: dict[str, float] = {
        "points": tracks,
        "analog": channels * samples,
        "first": first,
        "last": min(first + frames - 1, 65535),
        "scale": scale,
        "data": start,
        "samples": samples,
        "rate": rate,
        **(header or {}),
    }
    order = ">" if processor == MIPS else "<"
    head = b"\2P" + struct.pack(
        f"{order}5H", *(int(words[name]) for name in ("points", "analog", "first", "last")), 10
    )
    head += _floats([words["scale"]], processor)
    head += struct.pack(f"{order}2H", int(words["data"]), int(words["samples"]))
    head += _floats([words["rate"]], processor)
    return (
        head.ljust(BLOCK, b"\0")
        + section
        + _data(points, scale, channels * samples, processor, residual)
    )


def _label_parameters(labels: Sequence[str]) -> dict[tuple[str, str], Any]:
    """Return LABELS, LABELS2 ... of at most 255 labels each."""
    parts = [labels[first : first + 255] for first in range(0, max(len(labels), 1), 255)]
    return {
        ("POINT", f"LABELS{number if number > 1 else ''}"): part
        for number, part in enumerate(parts, 1)
    }


def _data(points: np.ndarray, scale: float, analog: int, processor: int, residual: float) -> bytes:
    """Return frames, padded to a whole block; missing points have a residual of -1."""
    seen = np.isfinite(points).all(axis=-1)
    table = np.zeros((*points.shape[:2], 4))
    table[..., :3] = np.where(seen[..., None], points, 0.0) / (scale if scale > 0 else 1.0)
    table[..., 3] = np.where(seen, residual, -1.0)
    rows = np.hstack(
        [table.reshape(len(points), 4 * points.shape[1]), np.full((len(points), analog), 7.0)]
    )
    if scale < 0:
        content = _floats(rows.ravel(), processor)
    else:
        content = np.rint(rows).astype(">i2" if processor == MIPS else "<i2").tobytes()
    return content + b"\0" * (-len(content) % BLOCK)


def _floats(values: Any, processor: int) -> bytes:
    numbers = np.asarray(values, np.float32)
    if processor != DEC:
        return numbers.astype(">f4" if processor == MIPS else "<f4").tobytes()
    bits = (numbers * np.float32(4)).view(np.uint32)
    return np.column_stack([bits >> 16, bits & 0xFFFF]).astype("<u2").tobytes()


def _word(number: int) -> np.int16:
    return np.uint16(number).view(np.int16)


def _section(said: dict[tuple[str, str], Any], processor: int, blocks: int) -> bytes:
    order = ">" if processor == MIPS else "<"
    groups = list(dict.fromkeys(group for group, _ in said))
    parts = [bytes([1, 0x50, min(blocks, 255), processor])]
    for number, group in enumerate(groups, start=1):
        parts.append(struct.pack("bb", len(group), -number) + group.encode())
        parts.append(struct.pack(f"{order}h", 3) + b"\0")
    for (group, name), value in said.items():
        if value is None:
            continue
        record = _parameter(value, processor) + b"\0"
        parts.append(struct.pack("bb", len(name), groups.index(group) + 1) + name.encode())
        parts.append(struct.pack(f"{order}h", len(record) + 2) + record)
    return b"".join(parts) + b"\0\0"


def _parameter(value: Any, processor: int) -> bytes:
    if isinstance(value, list):
        texts = [text.encode() for text in value]
        width = max(map(len, texts), default=0)
        body = b"".join(text.ljust(width) for text in texts)
        return struct.pack("bBBB", -1, 2, width, len(texts)) + body
    values = np.asarray(value)
    shape = bytes([values.ndim, *reversed(values.shape)])
    if values.dtype.kind == "f":
        return struct.pack("b", 4) + shape + _floats(values.ravel(), processor)
    return (
        struct.pack("b", 2) + shape + values.astype(">i2" if processor == MIPS else "<i2").tobytes()
    )


def trc_bytes(
    points: np.ndarray,
    labels: Sequence[str] | None = None,
    *,
    rate: float = 120.0,
    first: int = 1,
    unit: str = "mm",
    says: dict[str, str] | None = None,
) -> bytes:
    """Return a TRC as Cortex writes it, blanks where a point is missing."""
    frames, tracks = points.shape[:2]
    labels = default_labels(tracks) if labels is None else labels
    said = {
        "DataRate": f"{rate:.2f}",
        "CameraRate": f"{rate:.2f}",
        "NumFrames": f"{frames}",
        "NumMarkers": f"{tracks}",
        "Units": unit,
        "OrigDataRate": f"{rate:.2f}",
        "OrigDataStartFrame": f"{first}",
        "OrigNumFrames": f"{frames}",
        **(says or {}),
    }
    axes = [f"{axis}{number}" for number in range(1, tracks + 1) for axis in "XYZ"]
    lines = [
        "PathFileType\t4\t(X/Y/Z)\ta.trc",
        "\t".join(said),
        "\t".join(said.values()),
        "Frame#\tTime\t" + "\t\t\t".join(labels) + "\t\t",
        "\t\t" + "\t".join(axes),
        "",
        *("\t".join(row) for row in _rows(points, rate, first)),
    ]
    return "".join(f"{line}\r\n" for line in lines).encode()


def motive_bytes(
    points: np.ndarray,
    labels: Sequence[str] | None = None,
    *,
    rate: float = 120.0,
    first: int = 0,
    unit: str = "Millimeters",
    newer: bool = False,
) -> bytes:
    """Return a CSV of Motive with a rigid body before the markers and its own after them."""
    frames, tracks = points.shape[:2]
    labels = default_labels(tracks) if labels is None else labels
    heading = {
        "Format Version": "1.24" if newer else "1.23",
        "Take Name": "a",
        "Capture Frame Rate": f"{rate:.6f}",
        "Export Frame Rate": f"{rate:.6f}",
        "Total Exported Frames": f"{frames}",
        "Rotation Type": "Quaternion",
        "Length Units": unit,
        "Coordinate Space": "Global",
    }
    ridden = [*labels[:1], "Head:Marker1"]  # the first label was seen as well

    def row(name: str, body: str, marker: str, solved: str, each: bool = False) -> str:
        names = [label if each else marker for label in labels for _ in range(3)]
        own = [part for label in ridden for part in [label if each else solved] * 3 + [""]]
        return ",".join(["", name if newer else "", *[body] * 8, *names, *own])

    axes = ["X", "Y", "Z", "W", "X", "Y", "Z", "", *["X", "Y", "Z"] * tracks]
    own = ["X", "Y", "Z", ""] * 2
    kinds = [*["Rotation"] * 4, *["Position"] * 3, "Mean Marker Error", *["Position"] * 3 * tracks]
    lines = [
        ",".join(f"{name},{value}" for name, value in heading.items()),
        "",
        row("Type", "Rigid Body", "Marker", "Rigid Body Marker"),
        row("Name", "Head", "", "", each=True),
        row("ID", '"FE7B"', '"A1"', '"B2"'),
        *([row("Parent", "", "", "")] if newer else []),
        ",".join(["", "", *kinds, *(["Position"] * 3 + ["Marker Quality"]) * 2]),
        ",".join(["Frame", "Time (Seconds)", *axes, *own]),
    ]
    body = ["0"] * 3 + ["1", "5", "5", "5", "0.1"]
    ends = ["9", "8", "7", "1"] * 2
    for fields in _rows(points, rate, first):
        lines.append(",".join([*fields[:2], *body, *fields[2:], *ends]))
    return "".join(f"{line}\r\n" for line in lines).encode()


def npz_bytes(points: np.ndarray, labels: Sequence[str] | None = None, **more: Any) -> bytes:
    """Return landmarks as NPZ."""
    labels = default_labels(points.shape[1]) if labels is None else labels
    stream = io.BytesIO()
    np.savez_compressed(stream, names=np.array(labels), points=points, **more)
    return stream.getvalue()


def _rows(points: np.ndarray, rate: float, first: int) -> list[list[str]]:
    rows = []
    for number, frame in enumerate(points):
        numbers = ["" if math.isnan(each) else f"{each:.6f}" for each in frame.ravel()]
        rows.append([f"{first + number}", f"{number / (rate or 1.0):.6f}", *numbers])
    return rows
