"""Pixels of a JPEG or PNG file, upright and in sRGB, whatever the file's depth and colours are.

The size is read from the header before anything is decoded. Of the metadata only three things are
used: how the picture is turned, its colour profile, and the focal length of a whole frame. Pictures
that a phone or a camera appends to a JPEG are left alone.
"""

from __future__ import annotations

import io
import math
import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageCms, PngImagePlugin

from solver.errors import InputError, file_error, quote
from solver.meshio.texture_images import DAMAGED

FORMATS = ("JPEG", "PNG")
MOST_PIXELS = 64 << 20  # 64 MP, as sensors are counted
MOST_BYTES = 256 << 20  # of a file
LEAST_SIDE = 64  # px; a face of which anything can be told is wider
MOST_FILL = 1024  # bytes before a JPEG's marker; Pillow reads them anew with every block of a file
MOST_SCANS = 100  # passes of a progressive JPEG, each of which costs as much as a picture

FILM_DIAGONAL_MM = 43.2666  # of a frame of 36 x 24 mm, which equivalent focal lengths are by
FRAMES = (4 / 3, 3 / 2)  # width by height of sensors; others were cropped
FRAME_TOLERANCE = 0.01  # relative; sensors have some rows more or less
FOCAL_PX = (0.2, 50.0)  # least and most, by a picture's longer side: 136 and 1.1 degrees

# Tags of EXIF.
ORIENTATION = 0x0112  # which way up the picture is stored
DETAILS = 0x8769  # the block that has the tags below
FOCAL_MM = 0x920A  # of the lens
FOCAL_FILM_MM = 0xA405  # that sees as much on film of 36 x 24 mm
PLANE_RESOLUTION = 0xA20E  # pixels a unit of the sensor
PLANE_UNIT = 0xA210  # this unit, a key of UNIT_MM
WIDTH = 0xA002  # of the picture as it was taken, px
HEIGHT = 0xA003  # the same
UNIT_MM = {
    2: 25.4,
    3: 10.0,
    4: 1.0,
}  # of the resolution in the focal plane; an inch if it says none

UPRIGHT: Mapping[
    Any, Image.Transpose
] = {  # how a picture is turned that lies as the orientation says
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}

JPEG = b"\xff\xd8\xff"
PNG = b"\x89PNG\r\n\x1a\n"
OTHER_FORMATS = (  # a pattern of the first bytes, and a name
    (rb".{4}ftyp(?:heic|heix|heim|heis|hevc|mif1|msf1)", "HEIC"),
    (rb".{4}ftypavi[fs]", "AVIF"),
    (rb".{4}ftyp", "a film"),
    (rb"GIF8", "GIF"),
    (rb"RIFF.{4}WEBP", "WebP"),
    (rb"II\*\0|MM\0\*|II\x2b\0|MM\0\x2b", "TIFF or a camera's raw format"),
    (rb"BM", "BMP"),
    (rb"8BPS", "a Photoshop document"),
    (rb"\xff\x0a|\0\0\0\x0cJXL ", "JPEG XL"),
    (rb"\0\0\0\x0cjP  ", "JPEG 2000"),
    (rb"\s*(?:<\?xml|<svg)", "SVG"),
    (rb"%PDF-", "PDF"),
)
# What no camera appends to a picture: archives, programs, documents, scripts.
ALIEN = re.compile(
    rb"PK[\1\3\5\7]|Rar!|7z\xbc\xaf|\x1f\x8b|BZh|\xfd7zXZ|MZ|\x7fELF|\xca\xfe\xba\xbe|%PDF-|%!PS"
    rb"|GIF8|#!|<(?:!doctype|html|head|body|script|svg|\?)",
    re.IGNORECASE,
)
PDF_WITHIN = 1024  # bytes from a file's beginning where readers of PDF look for one
ZIP_END = b"PK\5\6"  # signature of the end of a ZIP file
ZIP_WITHIN = 66_000  # bytes from a file's end within which readers of ZIP look for it
NEXT_MARKER = re.compile(rb"\xff+([^\x00\xd0-\xd7\xff])", re.DOTALL)  # of a JPEG, after any data
END_OF_IMAGE = 0xD9  # marker of a JPEG
START_OF_SCAN = 0xDA  # the same: compressed data follow

_unreadable = partial(file_error, "photo.unreadable")


@dataclass(frozen=True)
class Picture:
    """What a file shows."""

    pixels: NDArray[np.float32]  # (h, w, 3) sRGB from 0 to 1
    opaque: NDArray[np.bool_] | None  # (h, w); None: all
    focal_px: float | None  # of a whole frame whose file tells it
    is_turned: bool  # whether the file has it lying on its side
    format: str  # JPEG, MPO (JPEG with more pictures behind it) or PNG

    @property
    def size(self) -> tuple[int, int]:
        """Return width and height, px."""
        height, width = self.pixels.shape[:2]
        return width, height


def read_picture(path: Path) -> Picture:
    """Read a JPEG or PNG file.

    Raises :class:`InputError` with ``file``: ``photo.unreadable`` (no picture, damaged, cut short),
    ``photo.format`` (another format, by ``found``), ``photo.animated``, ``photo.polyglot`` (a file
    that is something else to other programs), ``photo.too_large`` and ``photo.too_small``.
    """
    image = _open(path)
    exif = _exif(image)
    focal = _focal_px(exif, image.size)
    try:
        image.load()
        way = UPRIGHT.get(exif.get(ORIENTATION, 1))
        upright = image if way is None else image.transpose(way)
        is_turned = upright.size != image.size
        return Picture(_colours(upright), _opaque(upright), focal, is_turned, str(image.format))
    except DAMAGED as error:
        raise _unreadable(path.name, f"it is damaged: {quote(error)}") from error


def read_mask(path: Path, picture: Picture) -> NDArray[np.bool_]:
    """Return where a PNG beside a ``picture`` is white and opaque (h, w), at least by half.

    Raises :class:`InputError` as :func:`read_picture` does, and ``photo.mask_size`` if it is not as
    large as the picture; ``photo.format`` if it is no PNG, whose edges alone are sharp.
    """
    found = read_picture(path)
    if found.format != "PNG":
        message = f"{path.name}: a mask is a PNG; a JPEG's edges are not sharp"
        raise InputError("photo.format", message, file=path.name, expected=["PNG"], found="JPEG")
    if found.size != picture.size:
        message = (
            f"{path.name}: the mask is {_by(found.size)} px large, its picture {_by(picture.size)}"
        )
        if picture.is_turned and found.size == picture.size[::-1]:
            message += " once it is turned upright as its EXIF says: turn the mask, too"
        about = {"file": path.name, "expected": [*picture.size], "found": [*found.size]}
        raise InputError("photo.mask_size", message, **about)
    shown = found.pixels.mean(axis=2) >= 0.5
    if found.opaque is not None:
        shown &= found.opaque
    if not shown.any():
        most = 255.0 * float(found.pixels.max())
        message = (
            f"{path.name}: the mask is black all over (its brightest value is {most:.0f} of 255), "
            "so that nothing of the picture counts; white is what does"
        )
        raise InputError("photo.mask_empty", message, file=path.name)
    return np.asarray(shown)


def _open(path: Path) -> Image.Image:
    """Return a file's picture, of which only the header was read."""
    try:
        with path.open("rb") as stream:
            content = stream.read(MOST_BYTES + 1)
    except OSError as error:
        raise _unreadable(path.name, str(error)) from error
    if len(content) > MOST_BYTES:
        message = f"{path.name} has more than {MOST_BYTES >> 20} MB"
        raise InputError("photo.too_large", message, file=path.name)
    if not content.startswith((JPEG, PNG)):
        raise _other_format(path.name, content)
    try:
        image = Image.open(io.BytesIO(content), formats=FORMATS)
    except Image.DecompressionBombError as error:
        message = f"{path.name}: at most {MOST_PIXELS >> 20} megapixels can be read"
        raise InputError("photo.too_large", message, file=path.name) from error
    except DAMAGED as error:
        raise _unreadable(path.name, "its header is damaged") from error
    _check_size(path.name, image.size)
    _check_end(path.name, content)
    if isinstance(image, PngImagePlugin.PngImageFile) and image.is_animated:
        message = f"{path.name} is animated: send one picture of it"
        raise InputError("photo.animated", message, file=path.name)
    return image


def _other_format(file: str, content: bytes) -> InputError:
    for pattern, name in OTHER_FORMATS:
        if re.match(pattern, content, re.DOTALL | re.IGNORECASE):
            message = f"{file} is {name}: export it as JPEG or PNG"
            about = {"file": file, "expected": ["JPEG", "PNG"], "found": name}
            return InputError("photo.format", message, **about)
    return _unreadable(file, "it is no picture: JPEG and PNG can be read")


def _check_size(file: str, size: tuple[int, int]) -> None:
    about: dict[str, Any] = {"file": file, "found": [*size]}
    if math.prod(size) > MOST_PIXELS:
        most = MOST_PIXELS >> 20
        message = f"{file} is {_by(size)} px large: at most {most} megapixels can be read"
        raise InputError("photo.too_large", message, **about)
    if min(size) < LEAST_SIDE:
        message = f"{file} is {_by(size)} px large: a face needs {LEAST_SIDE} px at least"
        raise InputError("photo.too_small", message, expected=LEAST_SIDE, **about)


def _by(size: tuple[int, int]) -> str:
    return f"{size[0]} x {size[1]}"


def _check_end(file: str, content: bytes) -> None:
    """Refuse a picture that ends too soon, and a file that is something else as well.

    Cameras append pictures, films and notes of their own to a JPEG, which stay unread.
    """
    end = _png_end(content) if content.startswith(PNG) else _jpeg_end(file, content)
    if end is None:
        raise _unreadable(file, "it ends too soon: copy it again")
    beyond = content[end:].lstrip(b"\0 \t\r\n")
    is_zip = content.rfind(ZIP_END, max(end, len(content) - ZIP_WITHIN)) >= 0
    if is_zip or b"%PDF-" in content[:PDF_WITHIN] or ALIEN.match(beyond):
        message = (
            f"{file} is a picture and another kind of file at once, an archive, a document or a "
            "program: open it and save the picture alone"
        )
        raise InputError("photo.polyglot", message, file=file)


def _png_end(content: bytes) -> int | None:
    """Return where a PNG's chunks end; None: before their last."""
    place = len(PNG)
    while place + 12 <= len(content):
        length, kind = struct.unpack_from(">I4s", content, place)
        place += length + 12
        if kind == b"IEND":
            return place if place <= len(content) else None
    return None


def _jpeg_end(file: str, content: bytes) -> int | None:
    """Return where a JPEG's first picture ends; None: it does not."""
    place = 2
    scans = 0
    while (found := NEXT_MARKER.search(content, place)) is not None:
        marker = found[1][0]
        place = found.end()
        if place - found.start() > MOST_FILL:
            raise _unreadable(file, "it is filled up with nothing: save it again")
        if marker == END_OF_IMAGE:
            return place
        scans += marker == START_OF_SCAN
        if scans > MOST_SCANS:
            raise _unreadable(file, f"it has more than {MOST_SCANS} passes: save it again")
        place += int.from_bytes(content[place : place + 2])
    return None


def _exif(image: Image.Image) -> Mapping[int, Any]:
    """Return a picture's tags, those of its details beside the others; none if it has no order."""
    try:
        exif = image.getexif()
        return {**exif, **exif.get_ifd(DETAILS)}
    except DAMAGED:
        return {}


def _focal_px(exif: Mapping[int, Any], size: tuple[int, int]) -> float | None:
    """Return the focal length that a file tells, None if its picture may have been cropped.

    Programs that crop write the new size into EXIF as well, so that it must be a sensor's shape.
    """
    longer = max(size)
    shorter = min(size)
    if (exif.get(WIDTH), exif.get(HEIGHT)) not in (size, size[::-1]):
        return None
    if all(abs(longer / shorter / shape - 1.0) > FRAME_TOLERANCE for shape in FRAMES):
        return None
    focal = _number(exif, FOCAL_FILM_MM) * math.hypot(*size) / FILM_DIAGONAL_MM
    if not focal > 0:
        pixels_a_mm = _number(exif, PLANE_RESOLUTION) / UNIT_MM.get(exif.get(PLANE_UNIT, 2), 25.4)
        focal = _number(exif, FOCAL_MM) * pixels_a_mm
    least, most = FOCAL_PX
    return focal if least * longer <= focal <= most * longer else None


def _number(exif: Mapping[int, Any], tag: int) -> float:
    """Return a number of EXIF, 0 where there is none."""
    try:
        found = float(exif[tag])
    except (LookupError, TypeError, ValueError, ZeroDivisionError, OverflowError):
        return 0.0
    return found if math.isfinite(found) else 0.0


def _opaque(image: Image.Image) -> NDArray[np.bool_] | None:
    """Return where a picture is opaque, at least by half."""
    if not image.has_transparency_data:
        return None
    alpha = np.asarray(image.convert("RGBA").getchannel("A"))
    return None if alpha.min() > 127 else np.asarray(alpha > 127)


def _colours(image: Image.Image) -> NDArray[np.float32]:
    """Return colours (h, w, 3) in sRGB."""
    if image.mode.startswith("I"):  # grey of 16 bits
        grey = np.asarray(image).astype(np.float32) / 65535.0
        return np.repeat(np.clip(grey, 0.0, 1.0)[:, :, None], 3, axis=2)
    pixels = np.asarray(_in_srgb(image).convert("RGB"))
    return pixels.astype(np.float32) / np.float32(255.0)


def _in_srgb(image: Image.Image) -> Image.Image:
    """Return a picture with its colour profile applied; as it is if it has none that is valid."""
    content = image.info.get("icc_profile")
    if image.mode in ("P", "PA", "RGBA", "1", "LA"):
        image = image.convert("L" if image.mode in ("1", "LA") else "RGB")
    if not content:
        return image
    try:
        profile = ImageCms.ImageCmsProfile(io.BytesIO(content))
        if ImageCms.getProfileDescription(profile).startswith("sRGB"):
            return image
        # Pillow's inks of a CMYK picture are those of its file, as the profile has them
        srgb = ImageCms.createProfile("sRGB")
        found = ImageCms.profileToProfile(image, profile, srgb, outputMode="RGB")
    except (ImageCms.PyCMSError, *DAMAGED):
        return image
    return image if found is None else found
