"""Routes of the service itself."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Response

from service.captures.service import FORMATS, LANDMARK_FORMATS, RAW_FORMATS
from service.dependencies import SettingsDep, StoreDep
from service.kinds import KINDS
from service.schemas import Page
from service.system.schemas import KindView, Limits, Readiness
from service.system.service import readiness

router = APIRouter(tags=["system"])


@router.get("/v1/limits", summary="Limits")
def limits(settings: SettingsDep) -> Limits:
    """Tell what this service accepts."""
    return Limits(
        max_upload_bytes=settings.max_upload_bytes,
        upload_ttl=settings.upload_ttl,
        scan_formats=list(FORMATS),
        raw_scan_formats=list(RAW_FORMATS),
        landmark_formats=list(LANDMARK_FORMATS),
        max_attempts=settings.max_attempts,
    )


@router.get("/v1/solvers", response_model=Page[KindView], summary="Kinds of job")
def solvers() -> Any:
    """List the kinds of job with their options as JSON Schema."""
    return {"items": list(KINDS.values())}


@router.get("/healthz", summary="Is the process alive?")
def health() -> dict[str, str]:
    """Answer."""
    return {"status": "ok"}


@router.get(
    "/readyz",
    summary="Do its parts answer?",
    responses={503: {"model": Readiness, "description": "A part does not answer"}},
)
def ready(store: StoreDep, settings: SettingsDep, response: Response) -> Readiness:
    """Ask database, broker and files, and list the living workers."""
    state = readiness(store, settings)
    response.status_code = 200 if state.ready else 503
    return state
