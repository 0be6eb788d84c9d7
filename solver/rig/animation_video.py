"""``animation.mp4``: frames as a film, by PyAV (the extra ``video``)."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from solver.drawing.raster import Pixels
from solver.errors import InputError

CODECS = {"libx264": {"crf": "18", "preset": "medium"}, "mpeg4": {"qscale": "3"}}
"""What is tried, the best first; not every FFmpeg has the first."""


def check_video() -> None:
    """Raise :class:`InputError` (``options.video``) where films can not be written."""
    if find_spec("av") is None:
        raise InputError(
            "options.video",
            "a film needs PyAV, which is not installed: pip install 'myoface[video]'",
        )


def write_video(path: Path, pictures: Iterable[Pixels], size: tuple[int, int], fps: float) -> None:
    """Write sRGB ``pictures`` (h, w, 3) from 0 to 1 at ``fps``; ``size`` is (w, h), even numbers.

    Raises as :func:`check_video`.
    """
    check_video()
    import av

    codec = next(name for name in CODECS if name in av.codecs_available)
    rate = Fraction(fps).limit_denominator(1001)
    with av.open(str(path), "w", options={"movflags": "faststart"}) as film:
        stream = film.add_stream(codec, rate=rate, options=CODECS[codec])
        assert isinstance(stream, av.VideoStream)
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p"
        for picture in pictures:
            pixels = np.ascontiguousarray((picture * 255.0 + 0.5).astype(np.uint8))
            film.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        film.mux(stream.encode())
