"""A live session: a face followed frame after frame, checked and mended meanwhile.

    session = LiveSession.open(files, out, LiveOptions("weights"))
    frame = GivenFrame(number, seconds, data)
    followed, sample = session.step(frame, session.read(frame))

The same steps serve the job of the service and a program that holds a session itself.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from solver.errors import InputError
from solver.kinds.live_messages import GAP, HELD, RESUMED, FollowedFrame, GivenFrame
from solver.kinds.live_session import VIEW_FILE, Source
from solver.live.checks import Checked, CheckOptions, CheckOrder, CheckProcess, Sample
from solver.live.mending import Mend
from solver.live.rigged import LiveFace
from solver.live.samples import read_samples
from solver.live.sent import SentModes
from solver.live.skin import FILE
from solver.live.smoothing import OneEuro, Smoother, SmoothScales
from solver.live.source import FollowedFace, LiveSource
from solver.live.weights import ANGLE_NAMES
from solver.rig.preview import Listener
from solver.scans.live_link import ARKIT_NAMES
from solver.scans.markers.places.marker_set import MarkerSet
from solver.similarity import Similarity, small_motion
from solver.storage import hash_file, write_container
from solver.surface import Floats

Layout = tuple[tuple[str, tuple[int, ...]], ...]  # names and shapes of a followed frame's arrays


@dataclass(frozen=True)
class LiveOptions:
    """What a session is told, and numbers of its own."""

    source: Source
    rate: float = 60.0  # frames a second that will come
    smooth_hz: float | None = None
    send_skin: bool = False
    check_seconds: float = 0.1  # 0: no frames are solved in full
    resume: bool = False  # whether it goes on for a session that left its files in the same folder
    gap_s: float = 1.0  # from which on what was before counts no more
    window_s: float = 10.0  # of the running error
    farthest: float = 1e5  # of a frame's numbers: what is beyond counts as not seen
    speeds: SmoothScales = field(default_factory=SmoothScales)


class RunningError:
    """Distances of full solves: of the last seconds, and of the whole session.

    A frame counts by the time since the one before it that was solved: hard frames take longer, and
    are solved more rarely.
    """

    def __init__(self, window_s: float) -> None:
        self._window = window_s
        self._recent: deque[tuple[float, float, float]] = deque()  # when, error, weight
        self._last: float | None = None
        self._all = Counts(0.005, 4000)
        self.solved = 0
        self.failed = 0
        self.told = (float("nan"), float("nan"))  # p50 and p95 of the last seconds, mm

    def add(self, error_mm: float | None, now: float) -> None:
        """Take the distance of a frame that was solved at a time in s; None: it could not be."""
        if error_mm is None:
            self.failed += 1
            return
        self.solved += 1
        self._all.add(error_mm)
        weight = 1.0 if self._last is None else min(now - self._last, self._window)
        self._last = now
        self._recent.append((now, error_mm, max(weight, 1e-3)))
        while self._recent[0][0] < now - self._window:
            self._recent.popleft()
        _, errors, weights = np.array(self._recent).T
        order = np.argsort(errors)
        below = np.cumsum(weights[order]) - 0.5 * weights[order]
        p50, p95 = np.interp((0.5, 0.95), below / weights.sum(), errors[order]).tolist()
        self.told = p50, p95

    def figures(self) -> dict[str, Any]:
        """Return what a report says of the whole session."""
        return {**self._all.figures((50, 95)), "solved": self.solved, "failed": self.failed}


class Counts:
    """A histogram of numbers from 0 on, for percentiles in the same memory however many come."""

    def __init__(self, step: float, most: int) -> None:
        self._step = step
        self._counts = np.zeros(most, np.int64)
        self._sum = 0.0

    def add(self, value: float) -> None:
        """Count a number; one beyond the last step is counted there."""
        self._counts[min(int(value / self._step), len(self._counts) - 1)] += 1
        self._sum += value

    def figures(self, percents: Sequence[int]) -> dict[str, float | None]:
        """Return mean and percentiles, None of no numbers."""
        count = int(self._counts.sum())
        if not count:
            return dict.fromkeys(("mean", *(f"p{each}" for each in percents)))
        below = np.cumsum(self._counts)
        found: dict[str, float | None] = {"mean": round(self._sum / count, 4)}
        for each in percents:
            step = int(np.searchsorted(below, each / 100 * count))
            found[f"p{each}"] = round((step + 0.5) * self._step, 4)
        return found


class LiveSession:
    """Follows one performer's frames with a face; see the module.

    ``order`` is what a process needs that solves frames in full; not given: none are.
    """

    def __init__(
        self,
        face: LiveFace,
        source: LiveSource,
        options: LiveOptions,
        order: CheckOrder | None = None,
        skin_sha256: str = "",
    ) -> None:
        self.face = face
        self.source = source
        self.options = options
        self.errors = RunningError(options.window_s)
        self.frames = 0
        # of the amounts that are sent
        self.modes = SentModes.of_skin(face.rig.model, face.rig.weights, face.skin.basis)
        self._held = 0
        self._gaps = 0
        self._solve_ms = Counts(0.05, 10_000)
        self._last_seconds: float | None = None
        self._is_resumed = False
        self._sha256 = skin_sha256
        count = len(face.skin.names)
        modes = len(face.skin.basis)
        # of other sources the skin is by the sliders
        self._is_learned = options.source == "weights"
        at_rest = np.zeros(count)  # makes what frames use, so that the first does not wait for it
        face.amounts(at_rest, learned=self._is_learned)
        face.contractions(at_rest)
        self._mend = Mend.nothing(count + source.clue_count, modes)
        self._smoother: Smoother | None = None
        if options.smooth_hz is not None:
            speeds = options.speeds
            each = speeds.value, speeds.amount, speeds.turn_rad, speeds.shift_mm
            scale = np.repeat(each, (count, modes, 3, 3))
            self._smoother = Smoother(OneEuro(options.smooth_hz), scale)
        self._checks = None
        if order is not None:
            self._checks = CheckProcess(order, self._take_mend, self._take_check)

    @classmethod
    def open(
        cls,
        files: Mapping[str, Path],
        out: Path,
        options: LiveOptions,
        listen: Listener = lambda _phase, _part: None,
    ) -> LiveSession:
        """Begin a session with a rig's files by their roles; what it makes it leaves in ``out``.

        Raises as :meth:`LiveFace.open`, and what reading a marker set raises.
        """
        face = LiveFace.open(files, out, listen)
        markers = None
        if options.source == "markers":
            markers = MarkerSet.load(files["marker_set"], face.rig.model)
        left = read_samples(files["live_samples"]) if "live_samples" in files else {}
        source = face.source(options.source, markers)
        write_view(face, out / VIEW_FILE)
        order = None
        if options.check_seconds > 0:
            checks = CheckOptions(options.check_seconds)
            order = CheckOrder(
                dict(files),
                out,
                options.source,
                options.rate,
                checks,
                source.clue_count,
                options.resume,
                left,
            )
        return cls(face, source, options, order, hash_file(out / FILE))

    @property
    def layout(self) -> Layout:
        """Names and shapes of a followed frame's arrays."""
        live = self.face.skin
        skin = (("skin", self.face.rig.model.skin.vertices.shape),) * self.options.send_skin
        return (
            ("head", (4, 4)),
            ("jaw", (5,)),
            ("values", (len(live.names),)),
            ("amounts", (len(live.basis),)),
            ("contractions", (self.face.rig.model.muscle_count,)),
            *skin,
        )

    @property
    def is_checking(self) -> bool:
        """Return whether the process of full solves has begun and waits for a frame."""
        return self._checks is not None and self._checks.wants_one

    def ready(self) -> dict[str, Any]:
        """Return the message that says what frames are to be, and what comes back."""
        source = self.source
        rows = {"rows": source.rows, "width": source.width, "labels": list(source.labels)}
        return {
            "type": "ready",
            "source": self.options.source,
            "expects": rows,
            "layout": [{"name": name, "shape": list(shape)} for name, shape in self.layout],
            "sliders": list(self.face.skin.names),
            "muscles": list(self.face.rig.model.muscle_names),
            "sha256": self._sha256,
        }

    def read(self, frame: GivenFrame) -> NDArray[np.float32]:
        """Return a frame's numbers (rows, width).

        Weights may be ARKit's 52 alone. Raises :class:`InputError` (``live.frame``) for another
        number of them.
        """
        source = self.source
        numbers = np.frombuffer(frame.numbers[: len(frame.numbers) // 4 * 4], "<f4")
        wanted = source.rows * source.width
        if self.options.source == "weights" and len(numbers) == len(ARKIT_NAMES):
            numbers = np.append(numbers, np.full(len(ANGLE_NAMES), np.nan, np.float32))
        if len(numbers) != wanted or len(frame.numbers) % 4 or not np.isfinite(frame.seconds):
            message = (
                f"frame {frame.number} has {len(frame.numbers)} bytes at {frame.seconds:g} s: "
                f"{source.rows} rows of {source.width} numbers are {4 * wanted} bytes"
            )
            about = {"number": frame.number, "expected": 4 * wanted, "found": len(frame.numbers)}
            raise InputError("live.frame", message, **about)
        found: NDArray[np.float32] = numbers.reshape(source.rows, source.width).astype(np.float32)
        with np.errstate(invalid="ignore"):
            found[~(np.abs(found) <= self.options.farthest)] = np.nan
        return found

    def step(
        self, frame: GivenFrame, numbers: NDArray[np.float32], dropped: int = 0
    ) -> tuple[FollowedFrame, Sample]:
        """Follow a frame by the ``numbers`` that :meth:`read` found in it.

        ``dropped`` are those that came too fast so far. A clock that stands still counts as a
        frame's time; where it goes back, or jumps, what was before is forgotten.
        """
        begin = time.perf_counter()
        seconds, flags = self._after(frame.seconds)
        followed = self.source.step(numbers.astype(np.float64), seconds)
        plain = self.face.amounts(followed.values, learned=self._is_learned)
        mended = plain + self._mend(followed.values, followed.clues)
        shown, sent = self._smooth(followed, mended, seconds)
        arrays = self._arrays(shown, sent)
        if followed.is_held:
            flags |= HELD
            self._held += 1
        values = followed.values
        sample = Sample(frame.number, numbers, values, followed.clues, plain, sent)
        if self._checks is not None and not followed.is_held and self._checks.wants_one:
            self._checks.offer(sample)
        self.frames += 1
        spent = 1e3 * (time.perf_counter() - begin)
        self._solve_ms.add(spent)
        packed = b"".join(np.ascontiguousarray(each, "<f4").tobytes() for each in arrays)
        told = self.errors.told
        answer = FollowedFrame(frame.number, frame.seconds, spent, *told, dropped, flags, packed)
        return answer, sample

    def begin(self) -> None:
        """Forget the frames before, as after one that could not be followed."""
        self.source.begin()
        if self._smoother is not None:
            self._smoother.begin()

    def resume(self, frame: FollowedFrame) -> None:
        """Go on from a frame that another session of the same rig and kind has followed last.

        Raises :class:`InputError` (``live.resume``) for one of another layout.
        """
        count = sum(math.prod(shape) for _, shape in self.layout)
        is_alike = len(frame.numbers) == 4 * count
        if not is_alike or not np.isfinite(np.frombuffer(frame.numbers, "<f4")).all():
            message = "the last frame of the session is of another layout: it begins anew"
            raise InputError("live.resume", message)
        found = arrays_of(frame, self.layout)
        matrix = found["head"]
        head = Similarity(1.0, matrix[:3, :3], matrix[:3, 3])
        self.source.resume(found["values"], head)
        self._last_seconds = frame.seconds
        self._is_resumed = True

    def figures(self) -> dict[str, Any]:
        """Return what a report says of the session so far."""
        return {
            "source": self.options.source,
            "frames": self.frames,
            "held": self._held,
            "gaps": self._gaps,
            "solve_ms": self._solve_ms.figures((50, 95, 99)),
            "error_mm": self.errors.figures(),
            "skin_error_mm": self.face.skin.error_mm,
        }

    def close(self) -> None:
        """End the full solves."""
        if self._checks is not None:
            self._checks.close()

    def _after(self, seconds: float) -> tuple[float, int]:
        """Return the time since the last frame in s, and the flags that this makes."""
        flags = 0
        usual = 1.0 / self.options.rate
        passed = usual
        if self._last_seconds is not None:
            passed = seconds - self._last_seconds
            if self._is_resumed:
                flags |= RESUMED
                self._is_resumed = False
                passed = float(np.clip(passed, usual, self.options.gap_s))
            elif passed < 0.0 or passed > self.options.gap_s:
                flags |= GAP
                self._gaps += 1
                self.begin()
                passed = usual
        self._last_seconds = seconds
        return passed or usual, flags

    def _smooth(
        self, followed: FollowedFace, amounts: Floats, seconds: float
    ) -> tuple[FollowedFace, Floats]:
        """Return a frame and its amounts as they go out."""
        if self._smoother is None:
            return followed, amounts
        parts = (followed.values, amounts, followed.head.twist)
        smooth = self._smoother(np.concatenate(parts), seconds)
        values, amounts, twist = np.split(smooth, np.cumsum([len(each) for each in parts[:2]]))
        return replace(followed, values=values, head=small_motion(twist)), amounts

    def _arrays(self, shown: FollowedFace, amounts: Floats) -> list[Floats]:
        """Return a frame's arrays in the order of the layout."""
        head = np.eye(4)
        head[:3, :3] = shown.head.rotation
        head[:3, 3] = shown.head.shift
        values = shown.values
        jaw = self.face.jaw(values, learned=self._is_learned)
        arrays = [head, jaw, values, amounts, self.face.contractions(values)]
        return [*arrays, self.face.skin_of(amounts)] if self.options.send_skin else arrays

    def _take_check(self, found: Checked) -> None:
        """Take what was solved in full, in the thread that waits for it."""
        self.errors.add(found.error_mm, time.monotonic())
        self._take_mend(found.mend)

    def _take_mend(self, mend: Mend | None) -> None:
        if mend is not None:
            self._mend = mend  # whole, at once: a frame has the one or the other


def arrays_of(frame: FollowedFrame, layout: Layout) -> dict[str, Floats]:
    """Return a frame's arrays by their names; it has as many numbers as the layout."""
    numbers = np.frombuffer(frame.numbers, "<f4").astype(np.float64)
    ends = np.cumsum([math.prod(shape) for _, shape in layout])
    parts = np.split(numbers, ends[:-1])
    return {name: part.reshape(shape) for (name, shape), part in zip(layout, parts, strict=True)}


def write_view(face: LiveFace, path: Path) -> None:
    """Write the skin's modes as a page maps them: a container as ``preview.bin``."""
    header = {
        "sliders": list(face.skin.names),
        "muscles": list(face.rig.model.muscle_names),
        "error_mm": face.skin.error_mm,
    }
    write_container(path, header, {"basis": np.asarray(face.skin.basis, np.float16)})
