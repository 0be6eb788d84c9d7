"""Metrics in Prometheus' format: is the service healthy, what is slow, what is stuck."""

from __future__ import annotations

from fastapi import FastAPI
from prometheus_client import CollectorRegistry

from service.metrics.latency import Latency
from service.metrics.state import StateCollector
from service.settings import Settings
from service.store.store import Store


def install(app: FastAPI, store: Store, settings: Settings) -> None:
    """Measure ``app``'s requests, and let its ``GET /metrics`` tell the service's state."""
    registry = CollectorRegistry()
    registry.register(StateCollector(store, settings))
    app.state.metrics = registry
    app.add_middleware(Latency, registry=registry)
