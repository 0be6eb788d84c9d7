"""Pictures of every depth, colour and turn are read alike; what is no picture is refused."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image, ImageCms

from solver.errors import InputError
from solver.photo import picture as module
from solver.photo.picture import read_mask, read_picture
from tests.fixtures import data_folder

WIDTH = 96
HEIGHT = 72


def _colours() -> NDArray[np.uint8]:
    """Return a picture (h, w, 3) none of whose corners is like another."""
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
    found = np.stack([2 * columns, 3 * rows, 255 - columns - rows], axis=2)
    return found.astype(np.uint8)


COLOURS = _colours()
SHOWN = COLOURS / np.float32(255.0)


def _save(path: Path, image: Image.Image, **more: object) -> Path:
    image.save(path, **more)
    return path


def _refused(path: Path, code: str) -> InputError:
    with pytest.raises(InputError) as caught:
        read_picture(path)
    assert caught.value.code == code, caught.value.message
    assert caught.value.context["file"] == path.name
    return caught.value


def test_colours_are_read_as_they_are(tmp_path: Path) -> None:
    found = read_picture(_save(tmp_path / "a.png", Image.fromarray(COLOURS)))
    np.testing.assert_allclose(found.pixels, SHOWN, atol=1e-6)
    assert (found.size, found.opaque, found.focal_px) == ((WIDTH, HEIGHT), None, None)
    jpeg = read_picture(_save(tmp_path / "a.jpg", Image.fromarray(COLOURS), quality=95))
    assert np.abs(jpeg.pixels - SHOWN).mean() < 0.01


def test_grey_palettes_and_inks_become_colours(tmp_path: Path) -> None:
    image = Image.fromarray(COLOURS)
    grey = np.asarray(image.convert("L"))[..., None] / 255.0
    for name, mode, expected, off in (
        ("grey.png", "L", grey, 0.003),
        ("grey.jpg", "L", grey, 0.02),
        ("bits.png", "1", np.asarray(image.convert("1"))[..., None], 0.003),
        ("palette.png", "P", SHOWN, 0.1),
        ("inks.jpg", "CMYK", SHOWN, 0.02),
    ):
        found = read_picture(_save(tmp_path / name, image.convert(mode))).pixels
        assert found.shape == (HEIGHT, WIDTH, 3)
        assert np.abs(found - expected).mean() < off, name


def test_sixteen_bits_are_not_clipped(tmp_path: Path) -> None:
    deep = (COLOURS[..., 0].astype(np.uint16) << 8) + 77
    found = read_picture(_save(tmp_path / "grey.png", Image.fromarray(deep))).pixels
    np.testing.assert_allclose(found[..., 1], deep / 65535.0, atol=1e-6)
    colours = (COLOURS.astype(np.uint16) << 8).astype(">u2").tobytes()
    stride = 6 * WIDTH
    rows = b"".join(b"\0" + colours[i * stride : (i + 1) * stride] for i in range(HEIGHT))
    path = tmp_path / "deep.png"
    path.write_bytes(_png(WIDTH, HEIGHT, rows, depth=16))
    np.testing.assert_allclose(read_picture(path).pixels, SHOWN, atol=0.005)


def test_what_is_transparent_does_not_count(tmp_path: Path) -> None:
    alpha = np.where(np.arange(WIDTH) < 40, 0, 255).astype(np.uint8)
    alpha = np.tile(alpha, (HEIGHT, 1))
    four = np.dstack([COLOURS, alpha])
    found = read_picture(_save(tmp_path / "a.png", Image.fromarray(four)))
    assert found.opaque is not None
    np.testing.assert_array_equal(found.opaque, alpha > 0)
    np.testing.assert_allclose(found.pixels, SHOWN, atol=1e-6)
    two = Image.fromarray(np.dstack([COLOURS[..., 0], alpha]))
    found = read_picture(_save(tmp_path / "grey.png", two))
    np.testing.assert_allclose(found.pixels[..., 2], SHOWN[..., 0], atol=1e-6)
    assert found.opaque is not None
    assert (
        read_picture(_save(tmp_path / "o.png", Image.fromarray(COLOURS).convert("RGBA"))).opaque
        is None
    )


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_picture_is_turned_upright(tmp_path: Path, orientation: int) -> None:
    """A camera's picture lies; what EXIF says brings it to what was seen."""
    lying = {1: lambda a: a, 2: lambda a: a[:, ::-1], 3: lambda a: a[::-1, ::-1],
             4: lambda a: a[::-1], 5: lambda a: a.swapaxes(0, 1),
             6: lambda a: np.rot90(a, 1), 7: lambda a: a[::-1, ::-1].swapaxes(0, 1),
             8: lambda a: np.rot90(a, -1)}[orientation](COLOURS)  # fmt: skip
    exif = Image.Exif()
    exif[module.ORIENTATION] = orientation
    path = _save(tmp_path / "a.png", Image.fromarray(np.ascontiguousarray(lying)), exif=exif)
    found = read_picture(path)
    np.testing.assert_allclose(found.pixels, SHOWN, atol=1e-6)
    assert found.is_turned == (orientation > 4)


def test_a_colour_profile_is_applied(tmp_path: Path) -> None:
    """A file in another space of colours shows what it would in sRGB."""
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    plain = read_picture(_save(tmp_path / "a.png", Image.fromarray(COLOURS), icc_profile=profile))
    np.testing.assert_allclose(plain.pixels, SHOWN, atol=1e-6)
    lab = ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB")).tobytes()
    for wrong in (b"no profile", lab):
        found = read_picture(_save(tmp_path / "b.png", Image.fromarray(COLOURS), icc_profile=wrong))
        np.testing.assert_allclose(found.pixels, SHOWN, atol=1e-6)
    red = profile.index(b"rXYZ")
    green = profile.index(b"gXYZ")
    other = bytearray(profile.replace(b"\0s\0R\0G\0B", b"\0t\0R\0G\0B"))
    other[red : red + 4] = b"gXYZ"
    other[green : green + 4] = b"rXYZ"
    path = _save(tmp_path / "c.png", Image.fromarray(COLOURS), icc_profile=bytes(other))
    np.testing.assert_allclose(read_picture(path).pixels, SHOWN[..., [1, 0, 2]], atol=0.02)


def _exif(**tags: object) -> Image.Exif:
    found = Image.Exif()
    found[module.DETAILS] = {getattr(module, name): value for name, value in tags.items()}
    return found


def test_only_a_whole_frame_tells_its_focal_length(tmp_path: Path) -> None:
    """Film's equivalent is by the diagonal; cropped pictures and nonsense tell nothing."""

    def focal(exif: Image.Exif, size: tuple[int, int] = (1200, 800)) -> float | None:
        path = _save(tmp_path / "a.jpg", Image.new("RGB", size), exif=exif)
        return read_picture(path).focal_px

    whole = {"WIDTH": 1200, "HEIGHT": 800}
    assert focal(_exif(FOCAL_FILM_MM=50, **whole)) == pytest.approx(1200 * 50 / 36, rel=1e-4)
    by_plane = {"FOCAL_MM": 24.0, "PLANE_RESOLUTION": 500.0, "PLANE_UNIT": 3}
    assert focal(_exif(**by_plane, **whole)) == pytest.approx(24 * 50, rel=1e-4)
    assert focal(_exif(FOCAL_FILM_MM=50)) is None  # of a frame of any size
    assert focal(_exif(FOCAL_FILM_MM=50, WIDTH=2400, HEIGHT=1600)) is None  # reduced or cropped
    assert focal(_exif(FOCAL_FILM_MM=0, **whole)) is None
    assert focal(_exif(FOCAL_FILM_MM=60000, **whole)) is None
    cropped = _exif(FOCAL_FILM_MM=50, WIDTH=1200, HEIGHT=1000)
    assert focal(cropped, (1200, 1000)) is None  # no sensor's shape


def test_photographs_of_the_world() -> None:
    """Official portraits were cropped by a program that wrote the new size into EXIF, too."""
    folder = data_folder("photos")
    for name, size in (("obama.jpg", (910, 1137)), ("obama2.jpg", (626, 1200))):
        found = read_picture(folder / name)
        assert (found.size, found.focal_px) == (size, None)


def _jpeg(**more: object) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(COLOURS).save(stream, "JPEG", **more)
    return stream.getvalue()


def _png(width: int, height: int, rows: bytes, depth: int = 8) -> bytes:
    def chunk(kind: bytes, content: bytes) -> bytes:
        check = struct.pack(">I", zlib.crc32(kind + content))
        return struct.pack(">I", len(content)) + kind + content + check

    header = struct.pack(">2I5B", width, height, depth, 2, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    return module.PNG + body


def _zip() -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("a.txt", "hello")
    return stream.getvalue()


HEIC = b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + bytes(200)


@pytest.mark.parametrize(
    ("content", "code", "found"),
    [
        (b"", "photo.unreadable", None),
        (b"v 0 0 0\n", "photo.unreadable", None),
        (module.JPEG + bytes(100), "photo.unreadable", None),
        (module.PNG + bytes(100), "photo.unreadable", None),
        (HEIC, "photo.format", "HEIC"),
        (b"GIF89a" + bytes(100), "photo.format", "GIF"),
        (b"RIFF\0\0\0\0WEBPVP8 ", "photo.format", "WebP"),
        (b"II*\0" + bytes(100), "photo.format", "TIFF or a camera's raw format"),
        (b"<svg xmlns='http://www.w3.org/2000/svg'/>", "photo.format", "SVG"),
        (_jpeg() + _zip(), "photo.polyglot", None),
        (_jpeg() + b"x" * 100 + _zip(), "photo.polyglot", None),
        (_jpeg() + b"\n<html><script>alert(1)</script>", "photo.polyglot", None),
        (_jpeg() + b"MZ\x90\0", "photo.polyglot", None),
        (_jpeg(comment=b"%PDF-1.7 hello"), "photo.polyglot", None),
        (_png(96, 72, bytes(72 * 289)) + b"%PDF-1.7", "photo.polyglot", None),
        (_png(96, 72, bytes(100)), "photo.unreadable", None),
        (_png(20_000, 20_000, b""), "photo.too_large", None),
        (_png(9000, 9000, b""), "photo.too_large", None),
        (_png(2**31 - 1, 2**31 - 1, b""), "photo.too_large", None),
        (_png(300, 30, bytes(30 * 901)), "photo.too_small", None),
    ],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning")
def test_what_is_no_picture_is_refused(
    tmp_path: Path, content: bytes, code: str, found: str | None
) -> None:
    path = tmp_path / "face.jpg"
    path.write_bytes(content)
    error = _refused(path, code)
    if found is not None:
        assert error.context["found"] == found


@pytest.mark.parametrize("share", [0.2, 0.5, 0.9, 0.999])
@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_a_file_that_was_cut_short_is_refused(tmp_path: Path, suffix: str, share: float) -> None:
    path = _save(tmp_path / f"a{suffix}", Image.fromarray(COLOURS))
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    _refused(path, "photo.unreadable")


def test_what_cameras_append_is_left_alone(tmp_path: Path) -> None:
    """Second pictures, films of a moment, notes and padding."""
    path = tmp_path / "a.jpg"
    for more in (
        _jpeg(),
        b"\0\0\0\x18ftypmp42" + bytes(50),
        b"\0\0\x01\x0aImage_UTC_Data",
        bytes(99),
    ):
        path.write_bytes(_jpeg(quality=95) + more)
        assert np.abs(read_picture(path).pixels - SHOWN).mean() < 0.01
    other = Image.new("RGB", (WIDTH, HEIGHT))
    _save(path, Image.fromarray(COLOURS), format="MPO", save_all=True, append_images=[other])
    found = read_picture(path)
    assert found.format == "MPO"
    assert np.abs(found.pixels - SHOWN).mean() < 0.03


def test_an_animation_is_refused(tmp_path: Path) -> None:
    frames = [Image.fromarray(COLOURS), Image.fromarray(255 - COLOURS)]
    path = _save(tmp_path / "a.png", frames[0], save_all=True, append_images=frames[1:])
    _refused(path, "photo.animated")


def test_endless_passes_are_refused(tmp_path: Path) -> None:
    """Each pass of a progressive JPEG costs as much as the picture."""
    content = _jpeg(progressive=True)
    start = content.index(b"\xff\xda")
    path = tmp_path / "a.jpg"
    path.write_bytes(content[:-2] + 200 * content[start : start + 40] + b"\xff\xd9")
    _refused(path, "photo.unreadable")


def test_endless_filling_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    path.write_bytes(_jpeg()[:-2] + b"\xff" * 2000 + b"\xff\xd9")
    _refused(path, "photo.unreadable")


def _mask(path: Path, values: NDArray[np.uint8]) -> Path:
    return _save(path, Image.fromarray(values))


def test_masks(tmp_path: Path) -> None:
    picture = read_picture(_save(tmp_path / "a.png", Image.fromarray(COLOURS)))
    white = np.zeros((HEIGHT, WIDTH), np.uint8)
    white[10:20, 30:50] = 255
    np.testing.assert_array_equal(read_mask(_mask(tmp_path / "m.png", white), picture), white > 0)
    for values, code in (
        (white[:-1], "photo.mask_size"),
        (white.T.copy(), "photo.mask_size"),
        (white // 255, "photo.mask_empty"),
    ):
        with pytest.raises(InputError) as caught:
            read_mask(_mask(tmp_path / "m.png", values), picture)
        assert (caught.value.code, caught.value.context["file"]) == (code, "m.png")
    with pytest.raises(InputError, match="a mask is a PNG"):
        read_mask(_mask(tmp_path / "m.jpg", white), picture)
