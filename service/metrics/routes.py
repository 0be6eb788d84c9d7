"""The route that Prometheus asks."""

from __future__ import annotations

from fastapi import APIRouter, Depends, Request, Response
from prometheus_client import CONTENT_TYPE_PLAIN_0_0_4, generate_latest

from service.access.principal import Scope, need

router = APIRouter(tags=["system"])


@router.get(
    "/metrics",
    response_class=Response,
    summary="Metrics for Prometheus",
    dependencies=[Depends(need(Scope.METRICS))],
    responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}}},
)
def metrics(request: Request) -> Response:
    """Tell health, latencies and queues in Prometheus' text format."""
    return Response(generate_latest(request.app.state.metrics), media_type=CONTENT_TYPE_PLAIN_0_0_4)
