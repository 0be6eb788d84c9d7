"""What photographs tell beside their pixels is not stored, and nothing else of them changes."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import ExifTags, Image, PngImagePlugin
from PIL.TiffImagePlugin import IFDRational

from service.settings import Settings
from service.store.database import Store
from service.store.models import DEFAULT_TENANT, Upload
from service.uploads.pictures import without_metadata
from solver.photo.picture import read_picture
from tests.service_client import Studio, served

SIZE = (120, 90)
SECRETS = (b"Canon", b"Ada", b"SN-4711", b"Marker Street", b"a film", b"48.8584")
XMP = (
    b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF><rdf:Description tiff:Orientation="6" '
    b'exif:GPSLatitude="48.8584"/></rdf:RDF></x:xmpmeta>'
)


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[Studio]:
    with served(Settings(data_dir=tmp_path)) as studio:
        yield studio


def _picture() -> Image.Image:
    pixels = np.random.default_rng(0).integers(0, 255, (SIZE[1], SIZE[0], 3), np.uint8)
    return Image.fromarray(pixels)


def _exif(orientation: int | None = 6) -> Image.Exif:
    exif = Image.Exif()
    if orientation is not None:
        exif[ExifTags.Base.Orientation] = orientation
    exif[ExifTags.Base.Make] = "Canon"
    exif[ExifTags.Base.Artist] = "Ada"
    details = exif.get_ifd(ExifTags.IFD.Exif)
    details[ExifTags.Base.BodySerialNumber] = "SN-4711"
    details[ExifTags.Base.ExifImageWidth] = SIZE[0]
    details[ExifTags.Base.ExifImageHeight] = SIZE[1]
    details[ExifTags.Base.FocalLengthIn35mmFilm] = 85
    details[ExifTags.Base.FocalLength] = IFDRational(101, 2)
    places = exif.get_ifd(ExifTags.IFD.GPSInfo)
    places[ExifTags.GPS.GPSLatitudeRef] = "N"
    places[ExifTags.GPS.GPSLatitude] = (48.0, 51.0, 30.24)
    return exif


def _jpeg(**more: Any) -> bytes:
    """A photograph as phones make them: EXIF with GPS, XMP, a comment, and a film behind it."""
    stream = BytesIO()
    given = {"exif": _exif(), "xmp": XMP, "comment": b"Marker Street", "progressive": True}
    _picture().save(stream, "JPEG", quality=90, **{**given, **more})
    return stream.getvalue() + b"a film"


def _png() -> bytes:
    stream = BytesIO()
    texts = PngImagePlugin.PngInfo()
    texts.add_text("Author", "Ada")
    texts.add_itxt("XML:com.adobe.xmp", XMP.decode())
    texts.add_text("Comment", "Marker Street", zip=True)
    exif = _exif()
    exif.endian = ">"
    _picture().save(stream, "PNG", exif=exif, pnginfo=texts, dpi=(300, 300))
    return stream.getvalue()


PHOTOS = {"face.JPG": _jpeg(), "turned_by_xmp.jpeg": _jpeg(exif=_exif(None)), "face.png": _png()}


def _stored(studio: Studio, upload_id: str) -> bytes:
    store: Store = studio.http.app.state.store  # type: ignore[attr-defined]
    with store.of(DEFAULT_TENANT).read() as session:
        sha256 = session.get_one(Upload, upload_id).sha256
    assert sha256 is not None
    return b"".join(store.files.open(sha256))


@pytest.mark.parametrize("name", PHOTOS)
def test_where_and_by_whom_it_was_taken_is_not_stored(
    studio: Studio, tmp_path: Path, name: str
) -> None:
    sent = PHOTOS[name]
    assert sum(secret in sent for secret in SECRETS) >= 4
    digest = hashlib.sha256(sent).hexdigest()
    upload = studio.upload(name, sent)
    kept = _stored(studio, upload)
    assert len(kept) == len(sent)
    assert [secret for secret in SECRETS if secret in kept] == []
    exif = Image.open(BytesIO(kept)).getexif()
    assert exif.get_ifd(ExifTags.IFD.GPSInfo) == {}
    assert set(exif) == {ExifTags.Base.Orientation, ExifTags.IFD.Exif}
    assert exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLength] == 50.5
    # a fit sees what it saw before: pixels, upright, and the focal length
    before, after = tmp_path / f"before{name}", tmp_path / f"after{name}"
    before.write_bytes(sent)
    after.write_bytes(kept)
    was, now = read_picture(before), read_picture(after)
    assert was.size == now.size == SIZE[::-1]
    np.testing.assert_array_equal(was.pixels, now.pixels)
    assert was.focal_px == now.focal_px is not None
    with without_metadata(after, name) as again:  # nothing is left to be taken out
        assert again == after
    # who sent it knows it again by its own digest
    assert studio.get(f"/v1/uploads/{upload}")["sha256"] == digest
    subject = studio.post("/v1/subjects", name="Ada")["id"]
    path = f"/v1/subjects/{subject}/captures"
    seen = studio.post(path, name="face", role="photo", upload_id=upload)
    assert (seen["sha256"], seen["size"]) == (digest, len(sent))
    assert list((studio.http.app.state.settings.uploads).iterdir()) == []  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    "content",
    [
        b"GIF89a with Ada",
        b"\xff\xd8\xff\xe1\xff\xffExif\0\0MM\0*\0\0\0\x08\xff\xff",
        b"\xff\xd8\xff\xe1\0\0" + b"\xff\xe1\0\0" * 9,
        b"\x89PNG\r\n\x1a\n\xff\xff\xff\xffeXIfMM",
        b"\x89PNG\r\n\x1a\n\0\0\0\0eXIf",
    ],
)
def test_what_is_no_whole_picture_keeps_its_size(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "face.jpg"
    path.write_bytes(content)
    with without_metadata(path, path.name) as found:
        assert len(found.read_bytes()) == len(content)
    assert path.read_bytes() == content
    assert [*tmp_path.iterdir()] == [path]


def test_other_files_are_stored_as_they_were_sent(studio: Studio) -> None:
    sent = PHOTOS["face.JPG"]
    assert _stored(studio, studio.upload("face.bin", sent)) == sent
