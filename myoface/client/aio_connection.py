"""Requests to one service, repeated where that does no harm; files that go on where they broke."""

from __future__ import annotations

import uuid
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

import anyio
import httpx

from myoface.client.answers import (
    read_json,
    read_location,
    read_offset,
    require_success,
    require_tag,
)
from myoface.client.credentials import DEFAULT_URL, authority, headers_for, read_address
from myoface.client.files import (
    GONE,
    OUT_OF_STEP,
    TUS,
    TUS_CONTENT,
    Transferred,
    UploadNote,
    async_sha256_of,
    ignore_transfer,
    metadata,
    part_path,
    put_in_place,
    require_more,
)
from myoface.client.proxies import proxy_for
from myoface.client.retry import (
    DEFAULT_OPTIONS,
    Backoff,
    ClientOptions,
    came_to_nothing,
    is_never_reached,
    transport_errors,
)
from myoface.errors import ApiError
from myoface.resources import Artifact, Page, Upload
from myoface.values import Resource

R = TypeVar("R", bound=Resource)


class AsyncConnection:
    """The requests that the calls of a client are made of, and its transfers of files."""

    def __init__(
        self,
        url: str = DEFAULT_URL,
        key: str | None = None,
        *,
        ca: Path | str | None = None,
        proxy: str | None = None,
        options: ClientOptions = DEFAULT_OPTIONS,
    ) -> None:
        """Speak to the service at ``url``.

        ``key`` is by default what `myoface.client.credentials` has; ``ca`` is the PEM file of the
        authority that its certificate is of, where that is no public one. ``proxy`` is the address
        of a proxy; without it that of the environment or the system, for a service elsewhere.
        """
        self._url = url = read_address(url)
        self._proxy = proxy_for(url, proxy)
        self._authority = authority(ca)
        self.http = httpx.AsyncClient(
            base_url=url,
            headers=headers_for(url, key),
            timeout=httpx.Timeout(options.timeout_s, connect=options.connect_s),
            proxy=self._proxy,
            trust_env=False,
            verify=self._authority,
        )
        self._options = options

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self,
        _kind: type[BaseException] | None,
        _error: BaseException | None,
        _trace: TracebackType | None,
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the connections."""
        await self.http.aclose()

    # Files

    async def upload(self, path: Path, *, progress: Transferred = ignore_transfer) -> Upload:
        """Send a file by tus 1.0; returns the complete upload.

        An upload of the same file that was interrupted goes on, in a later run too: its id is
        noted in the user's cache until it is complete.
        """
        size = path.stat().st_size
        digest = await async_sha256_of(path)
        note = UploadNote(self._url, path.name, digest)
        upload_id = await self._find_upload(note)
        if upload_id is None:
            upload_id = await self._start_upload(path.name, size, digest)
        note.write(upload_id)
        await self._send_file(f"/v1/uploads/{upload_id}", path, progress)
        note.remove()
        return await self._get(f"/v1/uploads/{upload_id}", Upload)

    async def _find_upload(self, note: UploadNote) -> str | None:
        """Return the upload that an earlier run began, if the service has it still."""
        upload_id = note.read()
        if upload_id is None:
            return None
        try:
            await self._get(f"/v1/uploads/{upload_id}", Upload)
        except ApiError as error:
            if error.status not in GONE:
                raise
            return None
        return upload_id

    async def _start_upload(self, name: str, size: int, digest: str) -> str:
        headers = TUS | {"Upload-Length": str(size), "Upload-Metadata": metadata(name, digest)}
        response = await self._request_once("POST", "/v1/uploads", headers=headers)
        return read_location(response)

    async def _send_file(self, url: str, path: Path, progress: Transferred) -> None:
        size = path.stat().st_size
        backoff = Backoff(self._options)
        most = -1  # that the service has had: what brings no more counts as a failure
        offset: int | None = None  # None: ask the service how much it has
        with path.open("rb") as stream:
            while offset != size:
                try:
                    if offset is None:
                        response = await self._answer("HEAD", url, headers=TUS)
                    else:
                        stream.seek(offset)
                        headers = TUS | {"Upload-Offset": str(offset), "Content-Type": TUS_CONTENT}
                        offset = None
                        content = stream.read(self._options.chunk_bytes)
                        response = await self._answer(
                            "PATCH", url, content=content, headers=headers
                        )
                    offset = read_offset(require_success(response), size)
                    if offset > most:
                        most = offset
                        backoff.reset()
                    progress(offset, size)
                except ApiError as error:
                    if error.status in OUT_OF_STEP:
                        await anyio.sleep(backoff.pause_after(error))
                    else:
                        await anyio.sleep(backoff.pause_if_transient(error))

    async def download(
        self, artifact: Artifact, path: Path, *, progress: Transferred = ignore_transfer
    ) -> None:
        """Fetch an artifact into ``path``, checked against its sha256.

        A file that is there already and right is left as it is, and a part of the same artifact is
        continued; ``path`` itself appears only when the whole file is right. Raises
        :class:`ApiError` (``client.checksum``) if it is not.
        """
        path.parent.mkdir(parents=True, exist_ok=True)
        is_there = path.is_file() and path.stat().st_size == artifact.size
        if is_there and await async_sha256_of(path) == artifact.sha256:
            return
        part = part_path(path, artifact)
        await self._fetch(f"/v1/artifacts/{artifact.id}", part, artifact, progress)
        put_in_place(part, path, artifact, await async_sha256_of(part))

    async def _fetch(
        self, url: str, part: Path, file: Artifact, progress: Transferred = ignore_transfer
    ) -> None:
        """Fetch what ``part`` does not have yet of a file, whose ``sha256`` is its tag.

        Raises :class:`ApiError` (``client.changed``) if it is another file by now.
        """
        backoff = Backoff(self._options)
        part.touch()
        while (have := part.stat().st_size) < file.size:
            headers = {"Range": f"bytes={have}-", "If-Range": f'"{file.sha256}"'}
            try:
                async with self._stream(url, headers=headers) as response:
                    require_tag(response, file)
                    is_part = response.status_code == httpx.codes.PARTIAL_CONTENT
                    with part.open("ab" if is_part else "wb") as stream:
                        async for block in response.aiter_bytes():
                            stream.write(block)
                            progress(stream.tell(), file.size)
                            backoff.reset()
                require_more(part, have, file)
            except ApiError as error:
                await anyio.sleep(backoff.pause_if_transient(error))

    # Requests

    async def _answer(self, method: str, url: str, **request: Any) -> httpx.Response:
        """Send a request and return its answer, be it an error."""
        with transport_errors(self._proxy):
            return await self.http.request(method, url, **request)

    @asynccontextmanager
    async def _stream(self, url: str, **request: Any) -> AsyncIterator[httpx.Response]:
        """Yield an answer whose content is read in the block."""
        with transport_errors(self._proxy):
            async with self.http.stream("GET", url, **request) as response:
                if not response.is_success:
                    await response.aread()
                yield require_success(response)

    async def _request_once(self, method: str, url: str, **request: Any) -> httpx.Response:
        """Send a request that must not do its work twice; one that came to nothing has not."""
        backoff = Backoff(self._options)
        while True:
            try:
                return require_success(await self._answer(method, url, **request))
            except ApiError as error:
                if not came_to_nothing(error):
                    raise
                await anyio.sleep(backoff.pause_after(error))

    async def _request(
        self,
        method: str,
        url: str,
        *,
        through: bool = False,
        patience_s: float = 0.0,
        **request: Any,
    ) -> httpx.Response:
        """Send a request that may be repeated without harm, as often as the line breaks.

        A service that is not there at the first try is an error at once, unless ``through``: it
        was there just now. Failures are waited out for ``patience_s`` at least.
        """
        backoff = Backoff(self._options, patience_s)
        while True:
            try:
                return require_success(await self._answer(method, url, **request))
            except ApiError as error:
                if backoff.failures == 0 and not through and is_never_reached(error):
                    raise
                await anyio.sleep(backoff.pause_if_transient(error))

    async def _get(self, url: str, kind: type[R], **request: Any) -> R:
        response = await self._request("GET", url, **request)
        return kind.read(read_json(response))

    async def _watch(self, url: str, kind: type[R], **request: Any) -> R:
        """Read what is waited for: a service that is restarted meanwhile ends no wait."""
        patience = self._options.wait_s
        return await self._get(url, kind, through=True, patience_s=patience, **request)

    async def _create(self, url: str, kind: type[R], /, **body: Any) -> R:
        """Make something once, however often the line breaks."""
        given = {key: value for key, value in body.items() if value is not None}
        headers = {"Idempotency-Key": str(uuid.uuid4())}
        response = await self._request("POST", url, json=given, headers=headers)
        return kind.read(read_json(response))

    async def _change(self, url: str, kind: type[R], /, **body: Any) -> R:
        """Change something; what is None stays."""
        given = {key: value for key, value in body.items() if value is not None}
        response = await self._request("PATCH", url, json=given)
        return kind.read(read_json(response))

    async def _delete(self, url: str, **query: Any) -> str:
        """Delete something; returns the id of the receipt."""
        response = await self._request_once("DELETE", url, params=query)
        return read_location(response)

    async def _list(self, url: str, kind: type[R], /, **query: Any) -> list[R]:
        given = {key: value for key, value in query.items() if value is not None}
        found: list[R] = []
        while True:
            params = {"limit": self._options.page_items, **given}
            page = await self._get(url, Page, params=params)
            found += map(kind.read, page.items)
            if page.next is None:
                return found
            given["cursor"] = page.next
