"""Read answers, and refuse those that are not this API's: redirects, login pages, other servers."""

from __future__ import annotations

import json
from typing import Any, NoReturn

import httpx

from myoface.errors import ApiError
from myoface.resources import Artifact
from myoface.values import NOT_OF_THE_API

CHANGED = "client.changed"
EXCERPT = 80  # characters of a strange answer that are told


def require_success(response: httpx.Response) -> httpx.Response:
    """Return a response that has been read, or raise its problem as :class:`ApiError`."""
    if response.is_success:
        return response
    if not response.is_error:
        to = response.headers.get("Location", "nowhere")
        _refuse(response, f"{response.status_code}, to {to}: give the service's own address")
    error = ApiError.from_response(response)
    if "Retry-After" in response.headers:
        error.problem.setdefault("retry_after", response.headers["Retry-After"])
    raise error


def read_json(response: httpx.Response) -> Any:
    """Return the document that an answer holds."""
    try:
        return response.json()
    except (ValueError, RecursionError):
        kind = response.headers.get("Content-Type", "no type")
        _refuse(response, f"{kind} and not JSON: {response.text[:EXCERPT]!r}")


def read_data(text: str) -> dict[str, Any]:
    """Return the object that an event holds."""
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict):
        detail = f"the service's answer is not this API's: the event {text[:EXCERPT]!r}"
        raise ApiError({"code": NOT_OF_THE_API, "detail": detail})
    return found


def read_location(response: httpx.Response) -> str:
    """Return the id at the end of the address that an answer names."""
    place = response.headers.get("Location", "").rstrip("/").rpartition("/")[2]
    if not place:
        _refuse(response, f"{response.status_code} without a Location")
    return str(place)


def read_offset(response: httpx.Response, size: int) -> int:
    """Return how many of a file's ``size`` bytes the service has."""
    text = response.headers.get("Upload-Offset", "")
    if not (text.isascii() and text.isdigit()) or int(text) > size:
        _refuse(response, f"the offset {text[:EXCERPT]!r} of {size} bytes")
    return int(text)


def read_tag(response: httpx.Response) -> str:
    """Return the tag of the file that an answer is of; empty if it has none."""
    return str(response.headers.get("ETag", "")).removeprefix("W/").strip('"')


def require_tag(response: httpx.Response, file: Artifact) -> None:
    """Refuse the bytes of what has become another file since it was asked about."""
    tag = read_tag(response)
    if tag and tag != file.sha256:
        detail = f"{file.name} has changed while it was fetched"
        raise ApiError({"code": CHANGED, "detail": detail, "file": file.name})


def read_tag_and_size(response: httpx.Response) -> tuple[str, int]:
    """Return the tag of a file, and its bytes, of the answer to a HEAD."""
    tag = read_tag(response)
    size = response.headers.get("Content-Length", "")
    if not (tag and size.isascii() and size.isdigit()):
        _refuse(response, f"{response.status_code} without a file's tag and size")
    return tag, int(size)


def _refuse(response: httpx.Response, found: str) -> NoReturn:
    request = response.request
    detail = f"the answer to {request.method} {request.url} is not this API's: {found}"
    raise ApiError({"code": NOT_OF_THE_API, "status": response.status_code, "detail": detail})
