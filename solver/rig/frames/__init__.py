"""Frames of a face over time: their files as they come, and what a fitted performance leaves.

A folder ``frames`` holds JSON files: ``000010-000019.json`` has the 11th to the 20th frame, and
beside them what its kind of job needs to go on. A file is whole or not there, and files follow on
one another; docs/guide/sequences.md and docs/guide/simulation.md describe all files and values.
"""

from __future__ import annotations

import base64
import csv
import json
import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, Generic, Literal, Self, TypeVar

import numpy as np

from solver.errors import InputError
from solver.fitting.contraction import Contraction
from solver.fitting.drives import are_fibres
from solver.kinds import FILES
from solver.mechanics.boundary import JAW_FREEDOM
from solver.rig.expression import ENTRIES
from solver.rig.frames.read_back import compare_activations
from solver.storage import MOST_BYTES, read_arrays, write_container, write_json
from solver.surface import Floats

FORMAT = FILES["sequence.npz"].formats[0]  # of files of frames and of reports, too
FRAMES = "frames"  # name of the folder
CONTRACTIONS = "contractions.bin"  # what the page moves its sliders by
TABLE_DECIMALS = 6  # of activations.csv


@dataclass(frozen=True)
class FrameRecord:
    """One frame of a face over time, as far as all jobs with frames know it."""

    frame: int  # its number, in a take of markers as the file counts
    activations: Floats  # (m, 6), as of an expression, or (m,) of fibre muscles
    jaw: Floats  # (5,)
    head: Floats  # (6,) rotation vector (rad), translation (mm): in the world, x -> R x + t
    inverted: int  # number of tets with det F <= 0
    iterations: int  # of the solve
    seconds: float

    FORMAT: ClassVar[int] = FORMAT
    ARRAYS: ClassVar[tuple[str, ...]] = ("activations", "jaw", "head")
    # array (., 3) -> its name in a file, where it is packed in single precision
    PACKED: ClassVar[Mapping[str, str]] = {}

    def as_dict(self) -> dict[str, Any]:
        """Return the frame as JSON values."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        for name in self.ARRAYS:
            values[name] = values[name].tolist()
        for name, key in self.PACKED.items():
            values[key] = pack(values.pop(name), "<f4")
        return values

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Self:
        """Return the frame that :meth:`as_dict` gave these values of."""
        given = dict(values)
        for name in cls.ARRAYS:
            given[name] = np.array(given[name], np.float64)
        for name, key in cls.PACKED.items():
            given[name] = unpack(given.pop(key), "<f4")
        return cls(**given)


Record = TypeVar("Record", bound=FrameRecord)


def write_chunk(
    folder: Path, first: int, frames: Sequence[FrameRecord], beside: Mapping[str, Any]
) -> Path:
    """Write frames, the ``first``-th and on, and values ``beside`` them; whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    format_ = max((frame.FORMAT for frame in frames), default=FORMAT)
    content = {"format": format_, **beside, "frames": [frame.as_dict() for frame in frames]}
    path = folder / _name(first, len(frames))
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(content, allow_nan=False), encoding="utf-8")
    partial.replace(path)
    return path


@dataclass(frozen=True)
class ChunkOptions:
    """Size of the files of frames: written after so many frames or seconds, whichever is first."""

    frames: int = 30
    seconds: float = 2.0


class ChunkWriter(Generic[Record]):
    """Writes frames as they come, the ``first``-th and on; ``beside`` gets each file's last."""

    def __init__(
        self,
        folder: Path,
        first: int,
        options: ChunkOptions,
        beside: Callable[[Record], Mapping[str, Any]] = lambda _last: {},
    ) -> None:
        self._folder = folder
        self._first = first
        self._options = options
        self._beside = beside
        self._frames: list[Record] = []
        self._since = time.monotonic()

    def add(self, frame: Record) -> bool:
        """Take a frame; write a file if it is full or long due, and tell whether it was."""
        self._frames.append(frame)
        overdue = time.monotonic() - self._since > self._options.seconds
        due = overdue or len(self._frames) >= self._options.frames
        if due:
            self.flush()
        return due

    def flush(self) -> None:
        """Write the frames that wait, if there are any."""
        if self._frames:
            write_chunk(self._folder, self._first, self._frames, self._beside(self._frames[-1]))
        self._first += len(self._frames)
        self._frames = []
        self._since = time.monotonic()


def read_chunks(
    folder: Path,
    record: type[Record],
    code: str,
    fits: Callable[[Record], bool],
    take: Callable[[Mapping[str, Any], Sequence[Record]], None] = lambda _values, _frames: None,
) -> list[Record]:
    """Return the frames of a folder in their order, none if it is not there.

    ``fits`` says whether a frame is of this model. ``take`` is called with each file's values and
    frames before they are looked at, and may raise an :class:`InputError` of its own. Raises
    :class:`InputError` (``code``) if there is a gap, what is no frame, or another model's.
    """
    frames: list[Record] = []
    for path in sorted(folder.glob("*.json")):
        try:
            content = json.loads(path.read_bytes())
            if content["format"] != record.FORMAT:
                raise ValueError(f"their format is {content['format']}, not {record.FORMAT}")
            read = [record.of(each) for each in content["frames"]]
            take(content, read)
        except InputError as error:
            error.context["file"] = path.name
            raise
        except (OSError, ValueError, LookupError, TypeError, zlib.error) as error:
            message = f"{path.name} holds no frames: {error}"
            raise InputError(code, message, file=path.name) from error
        if path.name != _name(len(frames), len(read)) or not all(map(fits, read)):
            message = f"{path.name} does not follow on the {len(frames)} frames before it"
            raise InputError(code, message, file=path.name)
        frames += read
    return frames


def _name(first: int, count: int) -> str:
    return f"{first:06d}-{first + count - 1:06d}.json"


def pack(values: Floats, kind: str) -> str:
    """Return an array as text: zlib of its bytes as ``kind``, in base 64."""
    return base64.b64encode(zlib.compress(values.astype(kind).tobytes(), 1)).decode()


def unpack(text: str, kind: str, columns: int = 3) -> Floats:
    """Return the array (., columns) that :func:`pack` gave a text of."""
    content = zlib.decompress(base64.b64decode(text))
    return np.frombuffer(content, kind).reshape(-1, columns).astype(np.float64)


# Fitted performances.

# kept: the fit failed, the pose is the frame before's; unseen: so it is as too little was seen;
# predicted: no marker was seen that counts, the pose fades to the rest
# smoothed: kept or predicted, then bridged by a sweep back
Status = Literal["fitted", "kept", "unseen", "predicted", "smoothed"]


@dataclass(frozen=True)
class SequenceFrame(FrameRecord):
    """One frame of a performance, fitted; its number is the performance's.

    The head is in the studio, zero where it was not asked for. Distances are between fit and frame
    over the face's points that were seen, None without any.
    """

    status: Status
    mean_mm: float | None
    p95_mm: float | None
    max_mm: float | None
    coverage: float  # share of the face's points that were seen


@dataclass(frozen=True)
class MarkerFrame(SequenceFrame):
    """One frame of a take of k markers, fitted; distances are those of the markers that count.

    Arrays over the q controls are in the order of activations and jaw, or tracks. Activations of
    fibre muscles are (m,); ``jaw`` is the free jaw that comes nearest to one on its tracks.
    """

    marker_mm: Floats  # (k,) off the fitted face, NaN where nothing was seen
    marker_weight: Floats  # (k,) in [0, 1]: the say that it had
    marker_state: tuple[str, ...]  # (k,) seen, missing, outlier, swapped or relabelled
    sd: Floats  # (q,) standard deviations
    information: Floats  # (q,) in [0, 1]: part of the variance that this frame takes away
    contraction_sd: Floats  # (m,) of the contractions, NaN without fibres; (0,) of fibre muscles
    held: Floats  # (m,) 1 where the frame tells too little of a muscle
    tracks: Floats  # (3,) of a jaw on its tracks, (0,) of a free one
    mandible: Floats  # (4, 4) its motion in the head's frame: x -> R x + t, mm

    FORMAT: ClassVar[int] = FILES["sequence.npz"].formats[1]
    ARRAYS: ClassVar[tuple[str, ...]] = (
        *FrameRecord.ARRAYS,
        *("marker_mm", "marker_weight", "sd", "information", "contraction_sd", "held"),
        *("tracks", "mandible"),
    )

    def as_dict(self) -> dict[str, Any]:
        """Return the frame as JSON values, null where a marker was not seen or nothing is known."""
        known = {
            name: [None if np.isnan(each) else each for each in getattr(self, name).tolist()]
            for name in ("marker_mm", "contraction_sd")
        }
        return super().as_dict() | known | {"marker_state": list(self.marker_state)}


def read_frames(folder: Path, muscles: int) -> list[SequenceFrame]:
    """Return a sequence's frames by :func:`read_chunks`, whose code is ``sequence.frames``."""
    shape = (muscles, 6)
    return read_chunks(
        folder, SequenceFrame, "sequence.frames", lambda frame: frame.activations.shape == shape
    )


def write_sequence(
    out: Path,
    frames: Sequence[SequenceFrame],
    muscles: Sequence[str],
    fps: float,
    report: dict[str, Any],
    contraction: Contraction | None = None,
    first: int = 0,
    beside: Mapping[str, Any] = {},
) -> list[Path]:
    """Write ``sequence.npz``, ``activations.csv`` and ``sequence.json``; returns their paths.

    With ``contraction``, that of blended muscles, there is ``contractions.bin``, too. The frame
    with the number ``first`` is at 0 s; ``beside`` are arrays of all frames together, of frames
    with weights the ``shapes``. ``report``, which has the ``files`` that were compared,
    gets these: how far their activations are off, read back. Raises
    :class:`~solver.errors.SolveError` (``file.differs``).
    """
    files = [out / "sequence.npz", out / "activations.csv", out / "sequence.json"]
    kinds: dict[str, Any] = dict.fromkeys(("frame", "inverted", "iterations"), np.int64)
    kinds |= {"status": np.str_, "marker_state": np.str_, "held": np.bool_}
    record = type(frames[0])
    arrays: dict[str, Any] = {
        each.name: np.array(
            [getattr(frame, each.name) for frame in frames], kinds.get(each.name, np.float64)
        )
        for each in fields(record)
    }
    arrays |= {
        "format": record.FORMAT,
        "muscles": muscles,
        "fps": fps,
        "time": (arrays["frame"] - first) / fps,
        **beside,
    }
    if contraction is not None:
        arrays["contraction"] = contraction(arrays["activations"])
        files.append(out / CONTRACTIONS)
        found = {name: arrays[name].astype(np.float32) for name in ("contraction", "jaw")}
        write_container(files[-1], {"muscles": list(muscles)}, found)
    np.savez_compressed(files[0], allow_pickle=False, **arrays)
    columns = _columns(muscles, arrays)
    _write_table(files[1], frames, arrays, columns)
    wanted = arrays["activations"].reshape(len(frames), -1)
    # a long take may hold more than what is read of strangers
    most = MOST_BYTES + 2 * sum(np.asarray(each).nbytes for each in arrays.values())
    packed = read_arrays(files[0], most)["activations"].reshape(len(frames), -1)
    entries = _entries(muscles, arrays)
    with files[1].open(newline="", encoding="utf-8") as stream:
        rows = [[float(row[e] or "nan") for e in entries] for row in csv.DictReader(stream)]
    compared = {
        files[0].name: compare_activations(files[0], packed, wanted, 0.0),
        files[1].name: compare_activations(files[1], np.array(rows), wanted, 10.0**-TABLE_DECIMALS),
    }
    write_json(files[2], {**report, "files": {**report.get("files", {}), **compared}})
    return files


def sequence_report(frames: Sequence[SequenceFrame], fps: float, name: str) -> dict[str, Any]:
    """Return the figures of a sequence; distances in mm over frames, times in seconds or ms."""
    fitted = [frame for frame in frames if frame.status == "fitted"]
    errors = [frame.mean_mm for frame in fitted if frame.mean_mm is not None]
    seconds = [frame.seconds for frame in fitted]
    worst = max(fitted, key=lambda frame: frame.mean_mm or 0.0, default=None)
    return {
        "performance": name,
        "frames": len(frames),
        "fitted": len(fitted),
        "kept": [frame.frame for frame in frames if frame.status == "kept"],
        "unseen": [frame.frame for frame in frames if frame.status == "unseen"],
        "predicted": [frame.frame for frame in frames if frame.status == "predicted"],
        "smoothed": [frame.frame for frame in frames if frame.status == "smoothed"],
        "fps": fps,
        "mean_mm": _round(np.mean, errors),
        "median_mm": _round(np.median, errors),
        "p95_mm": _round(lambda values: np.percentile(values, 95), errors),
        "worst_frame": worst.frame if worst else None,
        "max_mm": max((frame.max_mm for frame in fitted if frame.max_mm is not None), default=None),
        "inverted": sum(frame.inverted for frame in frames),
        "iterations": _round(np.mean, [frame.iterations for frame in fitted]),
        "frame_ms": _round(np.median, [1e3 * each for each in seconds]),
        "frames_per_second": round(len(seconds) / sum(seconds), 2) if sum(seconds) else None,
    }


def _round(statistic: Any, values: Sequence[float]) -> float | None:
    return round(float(statistic(values)), 4) if values else None


def _entries(muscles: Sequence[str], arrays: Mapping[str, Any]) -> list[str]:
    """Return the names of the table's columns of activations."""
    if are_fibres(arrays["activations"]):
        return [*muscles]
    return [f"{name}.{entry}" for name in muscles for entry in ENTRIES]


def _columns(muscles: Sequence[str], arrays: Mapping[str, Any]) -> dict[str, Floats]:
    """Return the table's columns (f,) of numbers by their names: how much muscles pull comes first.

    A muscle's column is its contraction, a fibre muscle's its activation; NaN where unknown.
    """
    jaw = [f"jaw.{number}" for number in range(1, JAW_FREEDOM + 1)]
    head = [f"head.{entry}" for entry in ("rx", "ry", "rz", "tx", "ty", "tz")]
    activations = arrays["activations"]
    controls = _by_name(_entries(muscles, arrays), activations.reshape(len(activations), -1))
    spread: dict[str, Floats] = {}
    if "sd" in arrays:
        on_tracks = [f"tracks.{name}" for name in ("opening", "left", "right")]
        names = [*controls, *(on_tracks if arrays["tracks"].size else jaw)]
        spread = _by_name(_spread_of(names), arrays["sd"])
    first = {}
    if are_fibres(activations):
        first = controls | {name: spread[name] for name in _spread_of(muscles) if name in spread}
    elif "contraction" in arrays:
        own = [f"{name}.contraction" for name in muscles]
        first = _by_name(own, arrays["contraction"])
        if spread:
            first |= _by_name(_spread_of(own), arrays["contraction_sd"])
    if "weights" in arrays:
        shapes = [f"shape.{name}" for name in arrays["shapes"]]
        first = _by_name(shapes, arrays["weights"]) | first
    placed = _by_name(jaw, arrays["jaw"]) | _by_name(head, arrays["head"])
    return first | placed | controls | spread


def _by_name(names: Sequence[str], values: Floats) -> dict[str, Floats]:
    return dict(zip(names, values.T, strict=True))


def _spread_of(names: Sequence[str]) -> list[str]:
    return [f"{name}.sd" for name in names]


def _write_table(
    path: Path,
    frames: Sequence[SequenceFrame],
    arrays: Mapping[str, Any],
    columns: Mapping[str, Floats],
) -> None:
    with path.open("w", newline="", encoding="utf-8") as stream:
        rows = csv.writer(stream)
        rows.writerow(["frame", "time", "status", "mean_mm", *columns])
        values = np.array([*columns.values()]).T
        for frame, time, row in zip(frames, arrays["time"], values, strict=True):
            error = "" if frame.mean_mm is None else f"{frame.mean_mm:.4f}"
            rows.writerow(
                [frame.frame, f"{time:.4f}", frame.status, error]
                + ["" if np.isnan(value) else f"{value:.{TABLE_DECIMALS}f}" for value in row]
            )
