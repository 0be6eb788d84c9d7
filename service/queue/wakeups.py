"""Celery as the project uses it: the job table is the truth.

A message says that there is work in its queue; it names a job only for workers of earlier releases.
"""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from typing import Any

import redis
import structlog
from celery import Celery
from kombu.exceptions import OperationalError
from redis.backoff import NoBackoff
from redis.exceptions import RedisError
from redis.retry import Retry
from sqlalchemy.orm import Session

RUN_JOB = "myoface.run_job"
# `ingest` is apart: a check's verdict is wanted while the person is in the chair
INGEST = "ingest"
LIVE = "live"  # sessions, in which a lost worker is missed at once
QUEUES = (INGEST, "short", "long", LIVE)
# The worker of `service.queue.outbox`: its queue is the table of deliveries, not the broker's
WEBHOOKS = "webhooks"

IMPATIENT = {"socket_timeout": 1, "socket_connect_timeout": 1, "max_retries": 0}
# Seconds without a call after a failure of the broker
REST = 5.0
# Seconds that `close` waits for calls still to be sent
FAREWELL = 2.0
# Calls that wait to be sent, here and in a queue of the broker
MOST_CALLS = 1000
# Key of a session's list of calls, sent after its commit
WAKE = "wake"
ONCE: dict[str, Any] = {
    "socket_timeout": 1,
    "socket_connect_timeout": 1,
    "retry": Retry(NoBackoff(), 0),
}

# What a client of the broker raises that gets no answer
AWAY = (RedisError, OSError)

log = structlog.get_logger()


def celery_app(broker_url: str, **transport_options: Any) -> Celery:
    """Return a Celery application with the settings that survived the kill tests.

    ``acks_late`` and the restore intervals bring a dead worker's message back within seconds;
    nothing is lost if they do not, because the sweeper sends again.
    """
    app = Celery("myoface", broker=broker_url)
    app.conf.update(
        accept_content=["json"],
        task_serializer="json",
        task_ignore_result=True,
        task_acks_late=True,
        task_default_queue="short",
        worker_prefetch_multiplier=1,
        worker_hijack_root_logger=False,
        worker_send_task_events=False,
        worker_enable_remote_control=False,  # whoever reaches the broker could stop workers
        broker_connection_retry_on_startup=True,
        broker_connection_max_retries=None,
        broker_transport_options={
            "visibility_timeout": 60,
            "unacked_restore_interval": 5,
            "unacked_restore_throttle": 1,
            "unacked_restore_limit": 100,
            "socket_keepalive": True,
            "socket_connect_timeout": 2,
            "health_check_interval": 25,
            "socket_timeout": 30,
            **transport_options,
        },
    )
    return app


class WakeUps:
    """Sends the messages that wake workers up, from a thread of its own.

    Nobody waits for the broker: one that is frozen, away or slow costs wake-up calls, which the
    sweeper repeats, and after a failure it is left alone for `REST` seconds.
    """

    def __init__(self, broker_url: str) -> None:
        self._app = celery_app(broker_url, **IMPATIENT)
        self._client = connect(broker_url)
        self._calls: queue.Queue[tuple[str, str] | None] = queue.Queue(MOST_CALLS)
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._rests_until = 0.0

    def send(self, job_id: str, queue_name: str) -> None:
        """Wake the workers of a queue for a job, best effort and without waiting."""
        with self._lock:
            if self._thread is None:
                self._thread = threading.Thread(target=self._work, name="wake-ups", daemon=True)
                self._thread.start()
        with contextlib.suppress(queue.Full):
            self._calls.put_nowait((job_id, queue_name))

    def close(self) -> None:
        """Give what was asked for a moment to be sent."""
        with self._lock:
            thread = self._thread
        if thread is not None:
            with contextlib.suppress(queue.Full):
                self._calls.put_nowait(None)
            thread.join(FAREWELL)
        self._client.close()

    def _work(self) -> None:
        while (call := self._calls.get()) is not None:
            if time.monotonic() < self._rests_until:
                continue
            try:
                self._send(*call)
            except (OperationalError, RedisError, OSError) as error:
                self._rests_until = time.monotonic() + REST
                log.warning("queue.unreachable", error=str(error))

    def _send(self, job_id: str, queue_name: str) -> None:
        if int(self._client.llen(queue_name)) < MOST_CALLS:  # else all are awake already
            self._app.send_task(RUN_JOB, args=[job_id], queue=queue_name, retry=False)


def wake(session: Session, job_id: str, queue_name: str) -> None:
    """Ask for a wake-up call for a job after this session's commit."""
    session.info.setdefault(WAKE, []).append((job_id, queue_name))


def connect(broker_url: str, **patience: float) -> redis.Redis:
    """Return a client of the broker itself that asks once; ``patience`` are its own time-outs."""
    return redis.Redis.from_url(client_url(broker_url), **{**ONCE, **patience})


def client_url(broker_url: str) -> str:
    """Return the broker's address as its own clients write it, where it is a socket's path."""
    return broker_url.replace("redis+socket://", "unix://", 1)
