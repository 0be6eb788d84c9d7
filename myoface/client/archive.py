"""Read the ZIP file of a rig, and refuse what is none: it comes from a service."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import anyio
import httpx

from myoface.client.answers import read_tag_and_size
from myoface.client.files import sha256_of
from myoface.errors import ApiError
from myoface.resources import Artifact, WholeRig

RIG_NOTE = "rig.json"  # written when all files of a rig's folder are there
BLOCK = 1024 * 1024
PACKED = ".rig.zip"  # while it is unpacked; no file of a rig has a name like this

# What zipfile raises of a file that is none, or not as it says
FAULTS = (zipfile.BadZipFile, LookupError, ValueError, NotImplementedError, RuntimeError, EOFError)


def read_archive(response: httpx.Response, rig_id: str) -> Artifact:
    """Return size and tag, which is the sha256 of ``rig.json``, of an archive asked about."""
    tag, size = read_tag_and_size(response)
    values = {"id": rig_id, "name": "rig.zip", "media_type": "application/zip"}
    return Artifact.read({**values, "size": size, "sha256": tag})


def check_archive(path: Path, archive: Artifact) -> None:
    """Refuse what is not this archive, each file in it being as ``rig.json`` says.

    Raises :class:`ApiError`: ``client.checksum``, or ``client.answer`` for names that are none.
    """
    with _open(path, archive) as (packed, rig):
        for each in rig.artifacts:
            digest = hashlib.sha256()
            with packed.open(each.name) as stream:
                while block := stream.read(BLOCK):
                    digest.update(block)
            if digest.hexdigest() != each.sha256:
                raise _damaged_error(archive)


def is_unpacked(folder: Path, archive: Artifact) -> bool:
    """Return True if a folder has all files of an archive.

    Raises :class:`ApiError`: ``client.folder`` if it has another rig, which would be lost.
    """
    note = folder / RIG_NOTE
    if note.is_file() and (found := _rig_of(note)) != archive.id.lower():
        detail = (
            f"{folder} has another rig, {found}: give another folder"
            if found
            else f"{note} is of no rig, and would be lost: give another folder"
        )
        raise _occupied_error(note, detail)
    if not (note.is_file() and sha256_of(note) == archive.sha256):
        return False
    return all(_is_there(folder, each) for each in read_note(folder).artifacts)


def unpack(path: Path, folder: Path, archive: Artifact) -> None:
    """Write the files of an archive that a folder does not have, ``rig.json`` the last.

    Raises :class:`ApiError`: ``client.folder`` if a folder of no rig has another file of a name.
    """
    with _open(path, archive) as (packed, rig):
        missing = [each.name for each in rig.artifacts if not _is_there(folder, each)]
        if not (folder / RIG_NOTE).exists():
            for name in missing:
                _require_free(folder / name)
        for name in (*missing, RIG_NOTE):
            part = folder / f".{name}.part"
            with packed.open(name) as source, part.open("wb") as target:
                shutil.copyfileobj(source, target)
            os.replace(part, folder / name)


def read_note(folder: Path) -> WholeRig:
    """Return what the ``rig.json`` of a folder says."""
    return WholeRig.read(json.loads((folder / RIG_NOTE).read_bytes()))


@contextmanager
def _open(path: Path, archive: Artifact) -> Iterator[tuple[zipfile.ZipFile, WholeRig]]:
    """Give an archive whose files are stored as they are, in the sizes that ``rig.json`` says."""
    try:
        with zipfile.ZipFile(path) as packed:
            _stored_size(packed, RIG_NOTE)
            note = packed.read(RIG_NOTE)
            if hashlib.sha256(note).hexdigest() != archive.sha256:
                raise _damaged_error(archive)
            rig = WholeRig.read(json.loads(note))
            if any(_stored_size(packed, each.name) != each.size for each in rig.artifacts):
                raise _damaged_error(archive)
            yield packed, rig
    except FAULTS as error:
        raise _damaged_error(archive) from error


def _stored_size(packed: zipfile.ZipFile, name: str) -> int:
    """Return the size of a file that is stored as it is: one that was packed may be endless."""
    info = packed.getinfo(name)
    if info.compress_type != zipfile.ZIP_STORED:
        raise zipfile.BadZipFile(f"{name} is compressed")
    return info.file_size


def _rig_of(note: Path) -> str:
    """Return the id of the rig that a note is of; empty if it is of none."""
    try:
        return WholeRig.read(json.loads(note.read_bytes())).id
    except (ApiError, ValueError, RecursionError):
        return ""


def _is_there(folder: Path, file: Artifact) -> bool:
    path = folder / file.name
    is_there = path.is_file() and path.stat().st_size == file.size
    return is_there and sha256_of(path) == file.sha256


def _require_free(path: Path) -> None:
    if path.exists():
        raise _occupied_error(
            path, f"{path} is another file, and would be lost: give another folder"
        )


def _occupied_error(path: Path, detail: str) -> ApiError:
    return ApiError({"code": "client.folder", "detail": detail, "file": str(path)})


def _damaged_error(archive: Artifact) -> ApiError:
    detail = f"{archive.name} arrived damaged"
    return ApiError({"code": "client.checksum", "detail": detail, "file": archive.name})


async def async_check_archive(path: Path, archive: Artifact) -> None:
    """Do as :func:`check_archive`, in a thread."""
    await anyio.to_thread.run_sync(check_archive, path, archive)


async def async_is_unpacked(folder: Path, archive: Artifact) -> bool:
    """Do as :func:`is_unpacked`, in a thread."""
    return await anyio.to_thread.run_sync(is_unpacked, folder, archive)


async def async_unpack(path: Path, folder: Path, archive: Artifact) -> None:
    """Do as :func:`unpack`, in a thread."""
    await anyio.to_thread.run_sync(unpack, path, folder, archive)
