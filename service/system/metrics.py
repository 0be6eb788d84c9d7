"""Metrics in Prometheus' format: is the service healthy, what is slow, what is stuck.

The state is read from the tables when somebody asks: every API process shows the same.
"""

from __future__ import annotations

import math
import shutil
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from datetime import datetime, timedelta
from functools import cache, partial

import structlog
from fastapi import FastAPI
from prometheus_client import CollectorRegistry, Histogram
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector
from sqlalchemy import func, select
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import InstrumentedAttribute, Session
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.queue.outbox import PENDING
from service.queue.states import FINAL, HELD, State
from service.queue.sweep import SWEEPER
from service.queue.wakeups import QUEUES, WEBHOOKS
from service.settings import Settings
from service.store.database import Store, clock
from service.store.integrity import faults
from service.store.models import Artifact, Attempt, Capture, Delivery, Job, Lease
from service.system.service import readiness
from solver.kinds import KINDS

BUCKETS = (0.005, 0.01, 0.025, 0.05, 0.1, 0.15, 0.25, 0.5, 1, 2.5, 5, 10, 30)
METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
OTHER = "other"
# Seconds for which an answer is good: scrapers that come together ask once
KEPT = 5.0
RECENT = timedelta(hours=1)
MOST_JOBS = 5000
QUANTILES = (0.5, 0.95)
# Jobs of a kind by which its usual time is known, and seconds that nothing is overdue before
LEAST_KNOWN = 5
MOST_KNOWN = 100
LEAST_USUAL = 30.0

log = structlog.get_logger()


def install(app: FastAPI, store: Store, settings: Settings) -> None:
    """Measure ``app``'s requests, and let its ``GET /metrics`` show the service's state."""
    registry = CollectorRegistry()
    registry.register(StateCollector(store, settings))
    app.state.metrics = registry
    app.add_middleware(Latency, registry=registry)


class Latency:
    """Measures the time until an answer begins: events and downloads last as long as they last."""

    def __init__(self, app: ASGIApp, registry: CollectorRegistry) -> None:
        self._app = app
        self._seconds = Histogram(
            "http_request_seconds",
            "Time until the answer began",
            ["route", "method", "status"],
            buckets=BUCKETS,
            registry=registry,
        )

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        started = time.perf_counter()

        async def send_and_measure(message: Message) -> None:
            if message["type"] == "http.response.start":
                self._seconds.labels(route_of(scope), method_of(scope), message["status"]).observe(
                    time.perf_counter() - started
                )
            await send(message)

        await self._app(scope, receive, send_and_measure)


def route_of(scope: Scope) -> str:
    """Return the route's template, never the address: that may name what nobody should count."""
    return getattr(scope.get("route"), "path", OTHER)


def method_of(scope: Scope) -> str:
    """Return the method if it is one of HTTP's own: any word may come."""
    method: str = scope["method"]
    return method if method in METHODS else OTHER


class StateCollector(Collector):
    """Health of the parts, the queues, and how long jobs lately took."""

    def __init__(self, store: Store, settings: Settings) -> None:
        self._store = store
        self._settings = settings
        self._lock = threading.Lock()
        self._collected = -KEPT
        self._metrics: list[Metric] = []

    def describe(self) -> Iterable[Metric]:
        """Name nothing ahead, so that registering asks no database."""
        return ()

    def collect(self) -> Iterable[Metric]:
        """Return the metrics, at most ``KEPT`` seconds old."""
        with self._lock:
            if time.monotonic() - self._collected > KEPT:
                self._metrics = [*self._health(), *self._tables(), *self._disks()]
                self._collected = time.monotonic()
            return self._metrics

    def _health(self) -> Iterator[Metric]:
        state = readiness(self._store, self._settings)
        yield GaugeMetricFamily("myoface_up", "Whether all parts answer", value=state.ready)
        parts = {name: verdict == "ok" for name, verdict in state.checks.items()}
        yield _gauge("myoface_part_ready", "Whether a part answers", "part", parts)
        workers = dict.fromkeys((*QUEUES, WEBHOOKS), 0) | state.workers
        yield _gauge("myoface_workers", "Living workers", "queue", workers)

    def _tables(self) -> Iterator[Metric]:
        try:
            with self._store.read() as session:
                moment = clock(session)
                yield from _queues(session, moment)
                yield from _stuck(session, moment, self._settings)
                yield from _overdue(session, moment)
                yield from _recent(session, moment)
                yield from _sizes(session)
                yield from _faults(session)
        except SQLAlchemyError as error:
            log.warning("database.unreachable", error=str(error))

    def _disks(self) -> Iterator[Metric]:
        places = {"data": self._settings.data_dir, "uploads": self._settings.uploads}
        if not isinstance(self._settings.files, str):
            places["files"] = self._settings.files
        free = {
            name: shutil.disk_usage(folder).free
            for name, folder in places.items()
            if folder.is_dir()
        }
        yield _gauge("myoface_disk_free_bytes", "Room left", "place", free)


def _queues(session: Session, moment: datetime) -> Iterator[Metric]:
    """Count jobs by queue and state, the finished ones aside, which only ever grow."""
    jobs = GaugeMetricFamily("myoface_jobs", "Unfinished jobs", labels=["queue", "state"])
    active = [state for state in State if state not in FINAL]
    counts = Counter(
        {
            (queue, state): count
            for queue, state, count in session.execute(
                select(Job.queue, Job.state, func.count())
                .where(Job.state.in_(active))
                .group_by(Job.queue, Job.state)
            )
        }
    )
    for queue in QUEUES:
        for state in active:
            jobs.add_metric([queue, state.value], counts[queue, state])
    yield jobs
    oldest = session.execute(
        select(Job.queue, func.min(Job.created_at))
        .where(Job.state == State.QUEUED)
        .group_by(Job.queue)
    )
    waits = dict.fromkeys(QUEUES, 0.0) | {
        queue: (moment - created).total_seconds() for queue, created in oldest
    }
    text = "How long the job that waits longest has waited"
    yield _gauge("myoface_oldest_queued_seconds", text, "queue", waits)


def _stuck(session: Session, moment: datetime, settings: Settings) -> Iterator[Metric]:
    expired = session.scalar(
        select(func.count()).where(Job.state.in_(HELD), Job.lease_until < moment)
    )
    text = "Jobs whose worker is lost and which nobody has taken back yet"
    yield GaugeMetricFamily("myoface_leases_expired", text, value=expired or 0)
    canceling = session.scalars(select(Job).where(Job.state == State.CANCELING)).all()
    asked = [datetime.fromisoformat(job.cancel["requested_at"]) for job in canceling if job.cancel]
    longest = max(((moment - at).total_seconds() for at in asked), default=0.0)
    text = "How long the oldest cancel has waited for its solver to stop"
    yield GaugeMetricFamily("myoface_canceling_oldest_seconds", text, value=longest)
    pending = session.scalar(select(func.count()).where(Delivery.state == PENDING))
    text = "Webhook deliveries that no receiver has taken yet"
    yield GaugeMetricFamily("myoface_deliveries_pending", text, value=pending or 0)
    until = session.scalar(select(Lease.until).where(Lease.office == SWEEPER))
    term = timedelta(seconds=settings.sweeper_term)
    ago = math.inf if until is None else (moment - (until - term)).total_seconds()
    text = "Time since the sweeper's last round, infinite if there was none"
    yield GaugeMetricFamily("myoface_sweeper_last_round_seconds", text, value=ago)


def _overdue(session: Session, moment: datetime) -> Iterator[Metric]:
    """Count the jobs whose attempt lasts much longer than those of their kind lately did."""
    usual = cache(partial(_usual_seconds, session))
    running = select(Job.kind, Attempt.started_at).join(
        Job, (Job.id == Attempt.job_id) & (Job.attempt == Attempt.number)
    )
    counts = Counter(
        kind
        for kind, started in session.execute(running.where(Job.state.in_(HELD)))
        if (moment - started).total_seconds() > usual(kind)
    )
    text = "Jobs that run for longer than twice what 95 of 100 of their kind took"
    yield _gauge("myoface_jobs_overdue", text, "kind", dict.fromkeys(KINDS, 0) | counts)


def _usual_seconds(session: Session, kind: str) -> float:
    """Return the longest that a job usually takes; half of its limit while few are known."""
    ended = session.execute(
        select(Attempt.started_at, Attempt.finished_at)
        .join(Job, (Job.id == Attempt.job_id) & (Job.attempt == Attempt.number))
        .where(Job.kind == kind, Job.state == State.SUCCEEDED)
        .order_by(Job.finished_at.desc())
        .limit(MOST_KNOWN)
    )
    seconds = sorted(
        (finished - started).total_seconds() for started, finished in ended if finished is not None
    )
    if len(seconds) < LEAST_KNOWN:
        return KINDS[kind].max_seconds / 2 if kind in KINDS else math.inf
    return max(2 * seconds[math.ceil(0.95 * len(seconds)) - 1], LEAST_USUAL)


def _recent(session: Session, moment: datetime) -> Iterator[Metric]:
    """Measure the last hour: durations, waits, attempts that were lost."""
    rows = session.execute(
        select(Job.kind, Job.state, Job.queue, Job.created_at, Job.started_at, Job.finished_at)
        .where(Job.finished_at > moment - RECENT)
        .order_by(Job.finished_at.desc())
        .limit(MOST_JOBS)
    )
    durations: dict[tuple[str, ...], list[float]] = defaultdict(list)
    waits: dict[tuple[str, ...], list[float]] = defaultdict(list)
    for kind, state, queue, created, started, finished in rows:
        if started is not None and finished is not None:
            durations[kind, state.value].append((finished - started).total_seconds())
            waits[(queue,)].append((started - created).total_seconds())
    labels = ["kind", "outcome"]
    yield _quantiles("myoface_job_seconds", "Jobs that ended in the last hour", labels, durations)
    text = "How long they had waited for a worker"
    yield _quantiles("myoface_queue_wait_seconds", text, ["queue"], waits)
    ended = GaugeMetricFamily("myoface_jobs_ended", "How many they are", labels=labels)
    for key, seconds in durations.items():
        ended.add_metric(key, len(seconds))
    yield ended
    lost = session.scalar(
        select(func.count()).where(Attempt.outcome == "lost", Attempt.finished_at > moment - RECENT)
    )
    text = "Attempts that were lost in the last hour"
    yield GaugeMetricFamily("myoface_attempts_lost", text, value=lost or 0)


def _sizes(session: Session) -> Iterator[Metric]:
    def total(column: InstrumentedAttribute[int]) -> int:
        return int(session.scalar(select(func.sum(column))) or 0)

    sizes = {"scans": total(Capture.size), "results": total(Artifact.size)}
    text = "What captures and results refer to, before equal files are stored once"
    yield _gauge("myoface_stored_bytes", text, "what", sizes)


def _faults(session: Session) -> Iterator[Metric]:
    counts = dict.fromkeys(("lost", "damaged"), 0) | Counter(faults(session).values())
    text = "Stored files that were found lost or damaged"
    yield _gauge("myoface_file_faults", text, "fault", counts)


def _gauge(name: str, text: str, label: str, values: Mapping[str, float]) -> Metric:
    gauge = GaugeMetricFamily(name, text, labels=[label])
    for key, value in values.items():
        gauge.add_metric([key], value)
    return gauge


def _quantiles(
    name: str, text: str, labels: list[str], values: dict[tuple[str, ...], list[float]]
) -> Metric:
    gauge = GaugeMetricFamily(name, text, labels=[*labels, "quantile"])
    for key, seconds in values.items():
        ordered = sorted(seconds)
        for quantile in QUANTILES:
            rank = math.ceil(quantile * len(ordered)) - 1
            gauge.add_metric([*key, str(quantile)], ordered[rank])
    return gauge
