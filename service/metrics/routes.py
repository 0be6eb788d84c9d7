"""The route that Prometheus asks."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Response
from prometheus_client import CONTENT_TYPE_PLAIN_0_0_4, CollectorRegistry, generate_latest

from service.access.principal import Scope, need
from service.dependencies import part

router = APIRouter(tags=["system"])


@router.get(
    "/metrics",
    response_class=Response,
    summary="Metrics for Prometheus",
    dependencies=[Depends(need(Scope.METRICS))],
    responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}}},
)
def metrics(registry: Annotated[CollectorRegistry, Depends(part("metrics"))]) -> Response:
    """Tell health, latencies and queues in Prometheus' text format."""
    return Response(generate_latest(registry), media_type=CONTENT_TYPE_PLAIN_0_0_4)
