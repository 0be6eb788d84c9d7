"""Traces: from a request through the queue to the worker's attempt, with ids and nothing else."""

from __future__ import annotations

import http.server
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.service_client import ROOT, eventually, running

pytest.importorskip("opentelemetry.exporter.otlp.proto.http")
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest

TRACE = "0af7651916cd43dd8448eb211c80319c"
CALLER = "b7ad6b7169203331"


class Collector:
    """An OTLP collector over HTTP, which keeps what it is sent."""

    def __init__(self) -> None:
        self.bodies: list[bytes] = []

    def spans(self, name: str) -> list[Any]:
        """Return the spans of a name, of all services."""
        return [
            span
            for body in list(self.bodies)
            for resource in ExportTraceServiceRequest.FromString(body).resource_spans
            for scope in resource.scope_spans
            for span in scope.spans
            if span.name == name
        ]

    def services(self) -> set[str]:
        return {
            each.value.string_value
            for body in list(self.bodies)
            for resource in ExportTraceServiceRequest.FromString(body).resource_spans
            for each in resource.resource.attributes
            if each.key == "service.name"
        }


@pytest.fixture
def collector(monkeypatch: pytest.MonkeyPatch) -> Iterator[Collector]:
    kept = Collector()

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            kept.bodies.append(self.rfile.read(int(self.headers["Content-Length"])))
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_: Any) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, args=(0.02,))
    thread.start()
    address = f"http://127.0.0.1:{server.server_address[1]}"
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", address)
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_COMPRESSION", "none")
    monkeypatch.setenv("OTEL_BSP_SCHEDULE_DELAY", "100")
    yield kept
    server.shutdown()
    thread.join()
    server.server_close()


def _facts(span: Any) -> dict[str, Any]:
    return {each.key: each.value.string_value or each.value.int_value for each in span.attributes}


def test_a_trace_goes_from_the_request_to_the_workers_attempt(
    collector: Collector, tmp_path: Path
) -> None:
    with running(tmp_path) as (_, studio):
        subject = studio.subject()
        body = {"kind": "build_model", "subject_id": subject}
        # its caller's is not kept; that is not for the caller to say of this one
        headers = {"traceparent": f"00-{TRACE}-{CALLER}-00", "X-Request-Id": "shoot-17"}
        job = studio.http.post("/v1/jobs", json=body, headers=headers).json()["id"]
        studio.finished(job)
        studio.get(f"/v1/jobs?subject_id={subject}&limit=17")
        studio.http.get("/v1/nothing/Alex")
        eventually(lambda: bool(collector.spans("attempt build_model")))
        eventually(lambda: bool(collector.spans("GET other")))
    [submitted] = collector.spans("POST /v1/jobs")
    [attempt] = collector.spans("attempt build_model")
    assert attempt.trace_id == submitted.trace_id
    assert submitted.trace_id.hex() != TRACE
    assert not submitted.parent_span_id
    assert [(link.trace_id.hex(), link.span_id.hex()) for link in submitted.links] == [
        (TRACE, CALLER)
    ]
    assert attempt.parent_span_id == submitted.span_id
    assert _facts(submitted) == {
        "http.request.method": "POST",
        "http.route": "/v1/jobs",
        "http.response.status_code": 201,
        "myoface.request.id": "shoot-17",
        "myoface.job.id": job,
    }
    assert _facts(attempt) == {
        "myoface.job.id": job,
        "myoface.attempt": 1,
        "myoface.queue": "short",
        "myoface.outcome": "succeeded",
    }
    assert {"myoface-api", "myoface-short"} <= collector.services()
    told = b"".join(collector.bodies)
    for secret in (b"Alex", b".obj", b"limit", b"127.0.0.1", str(tmp_path).encode()):
        assert secret not in told


def test_without_a_collector_nothing_is_imported() -> None:
    program = """
import sys
from service import tracing
from service.app import create_app
from worker import app, deliver
tracing.start("myoface-api")
with tracing.trace_work("attempt", None, job_id="1"):
    tracing.note(outcome="succeeded")
    assert tracing.traceparent() is None
ours = ("opentelemetry.sdk.trace", "opentelemetry.exporter")  # others import the rest by themselves
print([name for name in sys.modules if name.startswith(ours)])
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert done.stdout.strip() == "[]"
