"""Routes of the service itself."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Response
from prometheus_client import CONTENT_TYPE_PLAIN_0_0_4, CollectorRegistry, generate_latest

from service.access.principal import Scope, need_scope
from service.dependencies import ReadSession, SettingsDep, WholeStore, part
from service.errors import problems
from service.schemas import Page
from service.store.retention import own_days
from service.system.schemas import KindView, Limits, Readiness, Retention, RoleView, WorkerView
from service.system.service import ReadinessCache, living_workers
from solver.kinds import BUILTIN_VERTICES, KINDS, LANDMARKS, ROLES

# RFC 9745: since when, in seconds of the epoch (2026-11-22)
SOLVERS_DEPRECATED = "@1795305600"

router = APIRouter(tags=["system"])


@router.get("/v1/limits", summary="Limits")
def limits(session: ReadSession, settings: SettingsDep) -> Limits:
    """Show what this service accepts, and how long it keeps what is the tenant's."""
    kept = own_days(session, settings)
    return Limits(
        max_upload_bytes=settings.max_upload_bytes,
        upload_ttl=settings.upload_ttl,
        rate_per_minute=settings.rate_per_minute,
        retention=Retention(
            subjects=kept.subjects,
            scans=kept.scans,
            jobs=kept.jobs,
            rigs=kept.rigs,
            audit=settings.retain_audit,
        ),
        scan_formats=list(ROLES["neutral"].registered),
        raw_scan_formats=list(ROLES["neutral"].formats),
        landmark_formats=list(LANDMARKS),
        roles=[RoleView.of(name, role) for name, role in ROLES.items()],
        builtin_vertices=BUILTIN_VERTICES,
        max_attempts=settings.max_attempts,
    )


@router.get(
    "/v1/kinds",
    response_model=Page[KindView],
    summary="Kinds of job",
    dependencies=[Depends(need_scope(Scope.READ))],
)
def kinds(settings: SettingsDep) -> Any:
    """List the kinds of job with their options as JSON Schema."""
    return {"items": [KindView.of(kind, settings.max_seconds(kind)) for kind in KINDS.values()]}


@router.get(
    "/v1/solvers",
    response_model=Page[KindView],
    dependencies=[Depends(need_scope(Scope.READ))],
    include_in_schema=False,
)
def solvers(response: Response, settings: SettingsDep) -> Any:
    """Answer at the path that `/v1/kinds` had before it, for one release."""
    response.headers["Deprecation"] = SOLVERS_DEPRECATED
    response.headers["Link"] = '</v1/kinds>; rel="successor-version"'
    return kinds(settings)


@router.get(
    "/v1/workers",
    response_model=Page[WorkerView],
    summary="The living workers",
    responses=problems(503),
    dependencies=[Depends(need_scope(Scope.METRICS))],
)
def workers(store: WholeStore, settings: SettingsDep) -> Any:
    """List the workers seen lately, by name; a key needs the scope `metrics`."""
    return {"items": living_workers(store, settings)}


@router.get("/healthz", summary="Is the process alive?")
def health() -> dict[str, str]:
    """Answer."""
    return {"status": "ok"}


@router.get(
    "/readyz",
    summary="Do its parts answer?",
    responses={503: {"model": Readiness, "description": "A part does not answer"}},
)
def ready(
    cache: Annotated[ReadinessCache, Depends(part("readiness"))], response: Response
) -> Readiness:
    """Ask database, broker and files, count each queue's living workers, look for the sweeper.

    503 while a part does not answer. The answer is at most two seconds old, unless a part hangs.
    """
    state = cache.ask()
    response.status_code = 200 if state.ready else 503
    return state


@router.get(
    "/metrics",
    response_class=Response,
    summary="Metrics for Prometheus",
    dependencies=[Depends(need_scope(Scope.METRICS))],
    responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}}},
)
def metrics(registry: Annotated[CollectorRegistry, Depends(part("metrics"))]) -> Response:
    """Show health, latencies and queues in Prometheus' text format."""
    return Response(generate_latest(registry), media_type=CONTENT_TYPE_PLAIN_0_0_4)
