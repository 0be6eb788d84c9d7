"""Traces by OpenTelemetry, for an operator who has a collector; without one, nothing is imported.

They are on where the extra ``otel`` is installed and the environment names a collector as
OpenTelemetry has it (``OTEL_EXPORTER_OTLP_ENDPOINT``). A trace begins with a request, with a link
to its caller's if that sends a ``traceparent``: who calls, perhaps without a key, says neither
which trace a span belongs to nor whether it is kept. A job's row carries the trace through the
queue, so that each attempt of a worker is a part of it. What instrumentation for frameworks adds
of its own is not wanted here: paths, queries and addresses of clients. Spans hold ids, kinds and
states, never a name, a path or a query; the id of a request may be its caller's ``X-Request-Id``.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import structlog

if TYPE_CHECKING:
    from opentelemetry.context import Context
    from opentelemetry.trace import Span, Tracer

ENDPOINTS = ("OTEL_EXPORTER_OTLP_ENDPOINT", "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT")
# Characters of a `traceparent` (W3C Trace Context, version 00)
LONGEST = 55

log = structlog.get_logger()
_tracer: Tracer | None = None


def start(name: str) -> None:
    """Send the spans of this process, by default as the service ``name``, if that is asked for."""
    global _tracer
    off = os.environ.get("OTEL_SDK_DISABLED", "").lower() == "true"
    if off or not any(map(os.environ.get, ENDPOINTS)):
        return
    try:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor
    except ImportError:
        log.warning("tracing.missing", advice="install myoface[otel]")
        return
    os.environ.setdefault("OTEL_SERVICE_NAME", name)
    provider = TracerProvider()  # not the global one: no library shall add spans of its own
    provider.add_span_processor(BatchSpanProcessor(OTLPSpanExporter()))
    _tracer = provider.get_tracer("myoface")


@contextmanager
def serving(headers: Mapping[str, str], request_id: str) -> Iterator[Span | None]:
    """Trace a request, with a link to its caller's span if that sends a ``traceparent``."""
    caller = headers.get("traceparent")
    attributes = {"myoface.request.id": request_id}
    with _span("request", "SERVER", None, attributes, caller) as span:
        yield span


@contextmanager
def trace_work(name: str, parent: str | None, **ids: str | int) -> Iterator[None]:
    """Trace a piece of work that ``parent``, a ``traceparent``, has led to."""
    attributes = {f"myoface.{key.replace('_', '.')}": value for key, value in ids.items()}
    with _span(name, "CONSUMER", parent, attributes):
        yield


def note_answer(span: Span, method: str, route: str, status: int) -> None:
    """Write down on a request's span which route answered, and how; ``status`` 0 is not at all."""
    span.update_name(f"{method} {route}")
    span.set_attributes(
        {"http.request.method": method, "http.route": route, "http.response.status_code": status}
    )
    if status >= 500 or not status:
        _spoil(span)


def note(failed: bool = False, **facts: str | int) -> None:
    """Write something down on the present span, if there is one."""
    if _tracer is None:
        return
    from opentelemetry import trace

    span = trace.get_current_span()
    span.set_attributes({f"myoface.{key.replace('_', '.')}": it for key, it in facts.items()})
    if failed:
        _spoil(span)


def traceparent() -> str | None:
    """Return the present span as what is sent on; None: there is none."""
    if _tracer is None:
        return None
    from opentelemetry.trace.propagation import tracecontext

    carrier: dict[str, str] = {}
    tracecontext.TraceContextTextMapPropagator().inject(carrier)
    return carrier.get("traceparent")


@contextmanager
def _span(
    name: str,
    kind: str,
    parent: str | None,
    attributes: Mapping[str, Any],
    linked: str | None = None,
) -> Iterator[Span | None]:
    if _tracer is None:
        yield None
        return
    from opentelemetry.trace import Link, SpanKind, get_current_span

    other = get_current_span(_context(linked)).get_span_context()
    with _tracer.start_as_current_span(
        name,
        _context(parent),
        SpanKind[kind],
        attributes,
        links=[Link(other)] if other.is_valid else [],
        record_exception=False,  # what exceptions say may name a file
        set_status_on_exception=False,
    ) as span:
        trace_id = format(span.get_span_context().trace_id, "032x")
        with structlog.contextvars.bound_contextvars(trace_id=trace_id):
            yield span


def _context(traceparent: str | None) -> Context:
    from opentelemetry.context import Context
    from opentelemetry.trace.propagation import tracecontext

    carrier = {} if traceparent is None else {"traceparent": traceparent}
    return tracecontext.TraceContextTextMapPropagator().extract(carrier, Context())


def _spoil(span: Span) -> None:
    from opentelemetry.trace import StatusCode

    span.set_status(StatusCode.ERROR)
