"""Images that lie on a scan: JPEG, PNG, BMP or TIFF of any depth, opened within bounds."""

from __future__ import annotations

import io
import re
import struct
import unicodedata
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from solver.errors import InputError, file_error, quote

FORMATS = ("JPEG", "PNG", "BMP", "TIFF")
MOST_SIDE = 1 << 14  # px of an image
MOST_PIXELS = MOST_SIDE * MOST_SIDE  # of all images of one scan
MOST_BYTES = 256 << 20  # of a file
ENOUGH_SIDE = 1 << 13  # px; a larger image is halved when it is read
MOST_IMAGES = 64  # of one scan

Texels = NDArray[np.uint8]  # (h, w, 4) sRGB and opacity, the first row is the upper edge

# What damaged and hostile files make Pillow raise.
DAMAGED = (
    OSError,
    EOFError,
    SyntaxError,
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    OverflowError,
    MemoryError,
    struct.error,
    zlib.error,
)
UNREADABLE = (*DAMAGED, ZeroDivisionError, Image.DecompressionBombError)
SIXTEEN_BITS = re.compile("I;16.*|I")  # modes of grey


def sidecar(scan: Path, name: str, written_in: str) -> Path:
    """Return the file ``name`` that lies beside a scan, as the file ``written_in`` has it.

    Case and composition of letters need not be the same: programs and disks change them.

    Raises :class:`InputError`: ``texture.path`` for anything but a plain name, ``texture.missing``
    where no such file lies beside the scan.
    """
    plain = name.strip("\"' ").removeprefix("./").removeprefix(".\\")
    if not plain.isprintable() or plain in ("", ".", "..") or re.search(r"[/\\:]", plain):
        reason = f"names {quote(name)}: only a plain name of a file beside the scan is opened"
        raise file_error("texture.path", written_in, reason, found=quote(name))
    path = scan.with_name(plain)
    if not path.is_file():
        alike = [each for each in scan.parent.iterdir() if _plainly(each.name) == _plainly(plain)]
        path = alike[0] if len(alike) == 1 else path
    if not path.is_file() or path.is_symlink():
        reason = f"names {quote(name)}, which does not lie beside {scan.name}"
        raise file_error("texture.missing", written_in, reason, found=quote(name))
    return path


def _plainly(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


def read_sidecar(path: Path) -> bytes:
    """Return the bytes of a file beside a scan; raises ``texture.unreadable``."""
    try:
        with path.open("rb") as stream:
            content = stream.read(MOST_BYTES + 1)
    except OSError as error:
        raise file_error("texture.unreadable", path.name, str(error.strerror)) from None
    if len(content) > MOST_BYTES:
        reason = f"it has more than {MOST_BYTES >> 20} MB"
        raise file_error("texture.unreadable", path.name, reason)
    return content


class ImageReader:
    """Opens the images of one scan, within what all of them may hold together."""

    def __init__(self) -> None:
        self._left = MOST_PIXELS
        self._images = 0

    def read(self, file: str, content: bytes) -> Texels:
        """Return an image's texels; ``file`` is its name.

        The size is read from the header before anything is decoded. Grey, palettes, CMYK and 16 bit
        become 8-bit sRGB. Raises :class:`InputError` (``texture.unreadable``).
        """
        try:
            with _own_limit(), Image.open(io.BytesIO(content), formats=FORMATS) as image:
                self._count(file, image.size)
                return _texels(image)
        except InputError:
            raise
        except UNREADABLE as error:
            reason = f"no image that can be read: {quote(error)}"
            raise file_error("texture.unreadable", file, reason) from None

    def _count(self, file: str, size: tuple[int, int]) -> None:
        width, height = size
        self._left -= width * height
        self._images += 1
        found = f"{width} x {height} px"
        if max(size) > MOST_SIDE or self._left < 0 or self._images > MOST_IMAGES:
            reason = (
                f"{found} is too large: a side has at most {MOST_SIDE} px, and a scan at most "
                f"{MOST_IMAGES} images with {MOST_PIXELS >> 20} megapixels together"
            )
            raise file_error("texture.unreadable", file, reason, found=[width, height])


def opaque(colours: NDArray[np.uint8]) -> Texels:
    """Return an image of colours (h, w, 3) as one of texels that hide what is behind."""
    return np.dstack([colours, np.full(colours.shape[:2], 255, np.uint8)])


@contextmanager
def _own_limit() -> Iterator[None]:
    """Let Pillow open what :data:`MOST_PIXELS` allows, which is checked before it decodes."""
    before = Image.MAX_IMAGE_PIXELS
    Image.MAX_IMAGE_PIXELS = None
    try:
        yield
    finally:
        Image.MAX_IMAGE_PIXELS = before


def _texels(image: Image.Image) -> Texels:
    image.draft(None, (ENOUGH_SIDE, ENOUGH_SIDE))
    is_deep = SIXTEEN_BITS.fullmatch(image.mode)
    if max(image.size) > ENOUGH_SIDE and image.mode not in ("1", "P") and not is_deep:
        image = image.reduce(2)
    if is_deep:
        grey = np.asarray(image).astype(np.uint32)
        grey = np.clip(grey >> 8, 0, 255).astype(np.uint8)
        return opaque(np.dstack([grey, grey, grey]))
    if image.mode == "F":
        raise ValueError("its values are no whole numbers")
    return np.array(image.convert("RGBA"))
