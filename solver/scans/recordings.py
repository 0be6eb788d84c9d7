"""Recordings of faces of all formats, told apart by their content."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from solver.errors import InputError
from solver.kinds.scene_recording import Recording
from solver.progress import ProgressCallback, Step
from solver.scans.film import is_film
from solver.scans.live_link import FaceTake, read_live_link, write_signals
from solver.scans.openface import is_openface, read_openface
from solver.scans.signals import play_signals
from solver.scans.video import read_video

SIGNALS_FILE = "signals.csv"  # what is measured of a video, beside what is made of it
NAMES = {"live_link": "Live Link Face", "video": "a video"}
TOLD_EVERY = 30  # frames of a video


def tell_detection(progress: ProgressCallback, done: float) -> Callable[[int], None]:
    """Return what tells now and then how many frames of a video were looked at.

    ``done`` is the part of the work that lies before.
    """

    def listen(frames: int) -> None:
        if frames % TOLD_EVERY == 0:
            progress(Step("detect", done, frames, message=f"frame {frames}"))

    return listen


def read_recording(
    path: Path,
    entry: Recording,
    keep: Path | None = None,
    progress: Callable[[int], None] = lambda _: None,
) -> FaceTake:
    """Return a recording of Live Link Face or OpenFace, a video, or the signals of one.

    What is measured of a video is written to ``keep``, which is such a recording itself;
    ``progress`` gets the number of its frames that are done. Raises as the readers, and
    ``live_link.options`` or ``video.options`` for what only others have.
    """
    if is_film(path):
        _refuse_others(path, entry, "video", ("au_scale",))
        measured = read_video(path, entry.face, progress=progress)
        if keep is not None:
            write_signals(keep, measured)
        return play_signals(path.name, measured, entry)
    if is_openface(path):
        return read_openface(path, entry)
    measured = read_live_link(path)
    _refuse_others(path, entry, measured.source, ("au_scale", "face"))
    return play_signals(path.name, measured, entry)


def _refuse_others(path: Path, entry: Recording, source: str, others: tuple[str, ...]) -> None:
    found = [name for name in others if getattr(entry, name) is not None]
    if found:
        reason = f"{found[0]} is no option of a recording of {NAMES[source]}"
        message = f"{path.name}: {reason}"
        raise InputError(f"{source}.options", message, file=path.name, found=found)
