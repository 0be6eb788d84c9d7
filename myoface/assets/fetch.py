"""Fetching an asset: resumed where it broke off, kept only if it is the right file.

The catalogue has the hash of an archive. Where it has none, the first copy that arrives is trusted
and its hash is written to ``fetched.json`` beside it: every later copy must be the same.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import time
import zlib
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from zipfile import BadZipFile, ZipFile

import httpx

from myoface.assets.catalogue import PublicAsset
from myoface.client.answers import require_success
from myoface.client.files import Transferred, ignore_transfer, sha256_of
from myoface.client.retry import Backoff, transport_errors
from myoface.errors import ApiError
from solver.errors import InputError

RECORD = "fetched.json"


@dataclass(frozen=True)
class FetchRecord:
    """Record of a fetched file.

    ``expected`` says where its hash came from: ``catalogue``, ``option`` (the user gave it) or
    ``first use``.
    """

    source: str
    size: int
    sha256: str
    expected: str
    at: str


def fetch(
    http: httpx.Client,
    asset: PublicAsset,
    folder: Path,
    *,
    mirror: str | None = None,
    file: Path | None = None,
    sha256: str | None = None,
    progress: Transferred = ignore_transfer,
) -> Path:
    """Return the asset's archive in ``folder``, fetching it if it is not there.

    Parameters
    ----------
    mirror
        Address of a folder that holds the archive under its name, instead of the owner's.
    file
        A copy at hand, instead of any address.
    sha256
        What the archive must be, instead of what the catalogue knows.

    Raises
    ------
    InputError
        ``assets.hash`` or ``assets.content`` for another file than expected (it is not kept),
        ``assets.file`` if ``file`` cannot be read.
    ApiError
        If the address does not answer or refuses.
    """
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / asset.file
    expected = _find_expectation(asset, folder, sha256)
    if target.exists():
        found = sha256_of(target)
        if found != expected.sha256 and expected.sha256 is not None:
            raise _another_file(target, expected, found, "delete it and try again")
        _check_content(asset, target, expected)
        _record(folder, target, str(target), expected, found)
        return target
    part = folder / f"{asset.file}.part"
    if file is not None:
        source = str(file)
        _copy(file, part)
    else:
        source = asset.url if mirror is None else f"{mirror.rstrip('/')}/{asset.file}"
        size = asset.size if expected.sha256 == asset.sha256 else None
        known = expected.sha256 is not None
        _download(http, source, part, size=size, resumable=known, progress=progress)
    found = sha256_of(part)
    try:
        if found != expected.sha256 and expected.sha256 is not None:
            raise _another_file(part.with_suffix(""), expected, found, "it was not kept")
        _check_content(asset, part, expected)
    except InputError:
        part.unlink()
        raise
    os.replace(part, target)
    (folder / "LICENCE.txt").write_text(asset.licence, encoding="utf-8")
    _record(folder, target, source, expected, found)
    return target


def unpack(asset: PublicAsset, archive: Path, folder: Path) -> Path:
    """Return the file of the asset's archive that is laid into ``folder``, which it is without."""
    if asset.unpacked is None:
        return folder
    target = folder / PurePosixPath(asset.unpacked).name
    part = target.with_name(f"{target.name}.part")
    with ZipFile(archive) as packed:
        member = next(name for name in packed.namelist() if name.endswith(asset.unpacked))
        part.write_bytes(packed.read(member))
    os.replace(part, target)
    return target.resolve()


@dataclass(frozen=True)
class _Expectation:
    sha256: str | None
    known_from: str


def _find_expectation(asset: PublicAsset, folder: Path, sha256: str | None) -> _Expectation:
    if sha256 is not None:
        return _Expectation(sha256.lower(), "option")
    if asset.sha256 is not None:
        return _Expectation(asset.sha256, "catalogue")
    before = _records(folder).get(asset.file)
    return _Expectation(None if before is None else before["sha256"], "first use")


def _another_file(path: Path, expected: _Expectation, found: str, what_now: str) -> InputError:
    known_from = {
        "option": "you gave",
        "catalogue": "is known of it",
        "first use": f"the first copy had ({RECORD})",
    }[expected.known_from]
    return InputError(
        "assets.hash",
        f"{path.name} has sha256 {found}, not {expected.sha256}, which {known_from}; {what_now}",
        file=str(path),
        expected=expected.sha256,
        found=found,
    )


def _copy(file: Path, part: Path) -> None:
    try:
        shutil.copyfile(file, part)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise InputError(
            "assets.file", f"{file} cannot be copied: {error.strerror}", file=str(file)
        ) from error


def _check_content(asset: PublicAsset, path: Path, expected: _Expectation) -> None:
    """Raise ``assets.content`` if an archive lacks a file or holds another version of it.

    Versions are of no account where the user says what the archive must be.
    """
    try:
        with ZipFile(path) as archive:
            names = archive.namelist()
            for ending, sha256 in asset.members.items():
                member = next((name for name in names if name.endswith(ending)), None)
                if member is None:
                    raise _wrong_content(asset, f"holds no {ending}")
                found = hashlib.sha256(archive.read(member)).hexdigest()
                if sha256 not in (None, found) and expected.known_from != "option":
                    raise _wrong_content(asset, f"holds another version of {ending}")
    except (OSError, EOFError, BadZipFile, RuntimeError, zlib.error) as error:
        raise _wrong_content(asset, f"is no ZIP archive ({error})") from error


def _wrong_content(asset: PublicAsset, reason: str) -> InputError:
    return InputError("assets.content", f"{asset.file} {reason}", file=asset.file)


def _records(folder: Path) -> dict[str, dict[str, str]]:
    path = folder / RECORD
    if not path.exists():
        return {}
    try:
        records: dict[str, dict[str, str]] = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(
            "assets.record", f"{path} cannot be read: {error}", file=str(path)
        ) from error
    return records


def _record(folder: Path, target: Path, source: str, expected: _Expectation, sha256: str) -> None:
    records = _records(folder)
    if records.get(target.name, {}).get("sha256") == sha256:
        return
    moment = datetime.now(UTC).isoformat(timespec="seconds")
    entry = FetchRecord(source, target.stat().st_size, sha256, expected.known_from, moment)
    text = json.dumps({**records, target.name: asdict(entry)}, indent=2)
    (folder / RECORD).write_text(text + "\n", encoding="utf-8")


def _download(
    http: httpx.Client,
    url: str,
    part: Path,
    *,
    size: int | None = None,
    resumable: bool = False,
    progress: Transferred = ignore_transfer,
) -> None:
    """Fetch ``url`` into ``part``, which may hold the beginning already.

    A part is continued where the server says that the file is still the same (its ETag is kept in
    ``<part>.etag``) or where the caller will check the whole (``resumable``); otherwise it begins
    anew. ``size`` is the file's, where it is known: a connection that ends early is then noticed
    even if the server does not say how much it sends.

    Raises :class:`ApiError` (``client.unreachable``, ``http.404`` ...) after several attempts.
    """
    tag = part.with_name(f"{part.name}.etag")
    backoff = Backoff()
    complete = False
    furthest = 0
    while not complete:
        have = _usable_bytes(part, tag, resumable, size)
        if have == size:
            break
        try:
            with (
                transport_errors(),
                http.stream("GET", url, headers=_range_headers(have, tag)) as response,
            ):
                if response.status_code == httpx.codes.REQUESTED_RANGE_NOT_SATISFIABLE and have:
                    part.unlink()  # it is not longer than the part: begin anew
                    continue
                if response.is_error:
                    response.read()
                partial = require_success(response).status_code == httpx.codes.PARTIAL_CONTENT
                _keep_tag(response, tag)
                total = size or _expected_bytes(response, have if partial else 0)
                with part.open("ab" if partial else "wb") as stream:
                    for block in response.iter_raw():
                        stream.write(block)
                        progress(stream.tell(), total or stream.tell())
                        if stream.tell() > furthest:  # else a server could cut us off for ever
                            furthest = stream.tell()
                            backoff.reset()
        except ApiError as error:
            time.sleep(backoff.pause_if_transient(error))
            continue
        arrived = part.stat().st_size
        complete = size is None or arrived >= size
        if not complete:
            detail = f"{url} ended after {arrived} of {size} bytes"
            truncated = ApiError({"code": "client.truncated", "detail": detail})
            time.sleep(backoff.pause_after(truncated))
    tag.unlink(missing_ok=True)


def _usable_bytes(part: Path, tag: Path, resumable: bool, size: int | None) -> int:
    """Return how many bytes of the part are of use; a part of no use is deleted."""
    have = part.stat().st_size if part.exists() else 0
    if have and ((size is not None and have > size) or not (resumable or tag.exists())):
        part.unlink()
        return 0
    return have


def _range_headers(have: int, tag: Path) -> dict[str, str]:
    # What is stored is the file itself, not a compressed form of it: ranges count its bytes.
    headers = {"Accept-Encoding": "identity"}
    if have:
        headers["Range"] = f"bytes={have}-"
        if tag.exists():
            headers["If-Range"] = tag.read_text(encoding="utf-8")
    return headers


def _keep_tag(response: httpx.Response, tag: Path) -> None:
    etag = response.headers.get("ETag", "")
    if etag.startswith('"'):  # a weak one (W/"...") does not promise the same bytes
        tag.write_text(etag, encoding="utf-8")
    else:
        tag.unlink(missing_ok=True)


def _expected_bytes(response: httpx.Response, before: int) -> int | None:
    length = response.headers.get("Content-Length", "")
    return before + int(length) if length.isdigit() else None
