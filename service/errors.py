"""Errors as problem documents (RFC 9457): a stable code, one plain sentence, what locates it."""

from __future__ import annotations

import errno
import json
import sqlite3
from collections.abc import Sequence
from http import HTTPStatus
from typing import Any

import structlog
from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy.exc import OperationalError
from starlette.exceptions import HTTPException

from service.bounds import DocumentBounds, fit, shorten
from service.schemas import IN_WORDS
from service.store.files import UnreachableError

CHECKSUM_MISMATCH = 460  # tus 1.0, checksum extension
LONGEST_QUOTE = 64
# A full disk fails at the write, or at making the write-ahead log larger
FULL_OF_SQLITE = frozenset(
    {
        sqlite3.SQLITE_FULL,
        sqlite3.SQLITE_READONLY,
        sqlite3.SQLITE_IOERR_WRITE,
        sqlite3.SQLITE_IOERR_SHMSIZE,
    }
)
FULL_OF_POSTGRESQL = "53100"
LOCKED_OF_POSTGRESQL = "55P03"
# Faults of a request that are told
MOST_FAULTS = 20
# What pydantic calls a fault -> words
SENTENCES = {
    "missing": "this is needed, and it is not there",
    "extra_forbidden": "there is no such member",
}
# Ids of a thousand captures fit
ANSWER = DocumentBounds(text=1000, items=1000)

log = structlog.get_logger()


class Problem(Exception):  # noqa: N818 (the term of RFC 9457)
    """A request that cannot be served; ``context`` names what it is about."""

    def __init__(self, status: int, code: str, detail: str, **context: Any) -> None:
        super().__init__(detail)
        self.status = status
        self.code = code
        self.detail = detail
        self.context = context
        self.headers: dict[str, str] = {}


def not_found(what: str, identifier: str) -> Problem:
    """Return the problem of an id that nothing has."""
    return Problem(
        404, f"{what}.unknown", f"there is no {what} {identifier}", **{f"{what}_id": identifier}
    )


def faulty(
    status: int, code: str, faults: Sequence[tuple[str, str]], *, at_least: bool = False
) -> Problem:
    """Return the problem of a document with ``faults``, each its place and what is wrong there.

    The first are told, the others counted; ``at_least`` says that there may be still more.
    """
    first = faults[:MOST_FAULTS]
    errors = [{"where": shorten(where), "message": shorten(message)} for where, message in first]
    detail = ": ".join(filter(None, errors[0].values())) if errors else "invalid request"
    if left_out := len(faults) - len(first):
        count = f"at least {left_out}" if at_least else str(left_out)
        errors.append({"where": "", "message": f"and {count} more"})
    return Problem(status, code, detail, errors=errors)


def lost(what: str, fault: str, **context: Any) -> Problem:
    """Return the problem of a stored file that the service has ``lost`` or ``damaged``."""
    return Problem(410, "files.lost", f"{what} is {fault} in the file store", **context)


def busy() -> Problem:
    """Return the problem of a request that came to no write in time, because of others' writes."""
    problem = Problem(503, "database.busy", "others are writing to the database; try again")
    problem.headers = {"Retry-After": "5"}
    return problem


class ProblemDocument(BaseModel):
    """Body of an error; further members name the fault (`file`, `line`, `found` ...)."""

    model_config = ConfigDict(extra="allow")

    type: str = Field(examples=["urn:myoface:problem:subject.unknown"])
    title: str = Field(examples=["Not Found"])
    status: int = Field(examples=[404])
    detail: str = Field(examples=["there is no subject 4d8e0f9a-..."])
    code: str = Field(examples=["subject.unknown"])
    request_id: str


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI description of a route's errors."""
    schema = {"$ref": "#/components/schemas/ProblemDocument"}
    return {
        status: {
            "description": _title(status),
            "content": {"application/problem+json": {"schema": schema}},
        }
        for status in statuses
    }


def install(app: FastAPI) -> None:
    """Make ``app`` answer every error with a problem document."""
    app.add_exception_handler(Problem, _on_problem)
    app.add_exception_handler(HTTPException, _on_http)
    app.add_exception_handler(RequestValidationError, _on_invalid)
    app.add_exception_handler(OSError, _on_os_error)
    app.add_exception_handler(OperationalError, _on_database_error)


def render(request_id: str, problem: Problem) -> Response:
    """Return the response for a problem; in ASCII, since it may quote what is not even Unicode."""
    body = {
        "type": f"urn:myoface:problem:{problem.code}",
        "title": _title(problem.status),
        "status": problem.status,
        "detail": problem.detail,
        "code": problem.code,
        "request_id": request_id,
    }
    return Response(
        json.dumps(fit({**body, **problem.context, **body}, ANSWER)),
        problem.status,
        headers=problem.headers,
        media_type="application/problem+json",
    )


def is_full(error: Exception) -> bool:
    """Return whether a database's error is that of a disk without room, or that is read only."""
    sqlite, postgresql = _codes(error)
    return sqlite in FULL_OF_SQLITE or postgresql == FULL_OF_POSTGRESQL


def is_locked(error: Exception) -> bool:
    """Return whether a database's error is that others had a lock for too long."""
    sqlite, postgresql = _codes(error)
    return sqlite == sqlite3.SQLITE_BUSY or postgresql == LOCKED_OF_POSTGRESQL


def _codes(error: Exception) -> tuple[int | None, str | None]:
    cause = getattr(error, "orig", None)
    return getattr(cause, "sqlite_errorcode", None), getattr(cause, "sqlstate", None)


def _title(status: int) -> str:
    return "Checksum Mismatch" if status == CHECKSUM_MISMATCH else HTTPStatus(status).phrase


async def _on_problem(request: Request, error: Exception) -> Response:
    assert isinstance(error, Problem)
    return render(request.state.request_id, error)


async def _on_http(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    code = "http." + _title(error.status_code).lower().replace(" ", "_")
    problem = Problem(error.status_code, code, str(error.detail))
    problem.headers = dict(error.headers or {})
    return render(request.state.request_id, problem)


async def _on_invalid(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    faults = [(_place(each["loc"]), _message(each)) for each in error.errors()]
    return render(request.state.request_id, faulty(422, "request.invalid", faults))


def _place(parts: Sequence[str | int]) -> str:
    """Return the name of a parameter or member, such as captures[0].name; "" is all of the body."""
    named = [f"[{part}]" if isinstance(part, int) else f".{part}" for part in parts[1:]]
    return "".join(named).removeprefix(".")


def _message(fault: dict[str, Any]) -> str:
    """Return what a field should be and, where that is a short text, what it was."""
    kind = fault["type"]
    found = fault.get("input")
    if kind in SENTENCES:
        return SENTENCES[kind]
    quoted = isinstance(found, str) and len(found) <= LONGEST_QUOTE
    told = str(fault["msg"]).removeprefix("Value error, ")
    words = IN_WORDS.get(fault.get("ctx", {}).get("pattern"), told)
    return f"{words}, not {found!r}" if quoted else words


async def _on_os_error(request: Request, error: Exception) -> Response:
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        problem = Problem(507, "storage.full", "there is no room left for files")
        return render(request.state.request_id, problem)
    if isinstance(error, UnreachableError):
        log.warning("files.unreachable", error=str(error))
        problem = Problem(503, "files.unreachable", "the file store does not answer; try again")
        problem.headers = {"Retry-After": "5"}
        return render(request.state.request_id, problem)
    raise error


async def _on_database_error(request: Request, error: Exception) -> Response:
    if is_full(error):
        log.warning("database.full", error=str(error))
        problem = Problem(507, "storage.full", "there is no room left for the database")
        return render(request.state.request_id, problem)
    if is_locked(error):
        log.warning("database.busy", error=str(error))
        return render(request.state.request_id, busy())
    log.warning("database.unreachable", error=str(error))
    problem = Problem(503, "database.unreachable", "the database does not answer; try again")
    problem.headers = {"Retry-After": "5"}
    return render(request.state.request_id, problem)
