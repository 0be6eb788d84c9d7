"""Celery as the project uses it: a message only wakes a worker up, the job table is the truth."""

from __future__ import annotations

from typing import Any

import redis
import structlog
from celery import Celery
from kombu.exceptions import OperationalError
from redis.backoff import NoBackoff
from redis.exceptions import RedisError
from redis.retry import Retry

RUN_JOB = "myoface.run_job"
QUEUES = ("ingest", "short", "long")
"""Checks wait for no fit: their verdict is wanted while the person is in the chair."""
WEBHOOKS = "webhooks"
"""The worker of `service.store.outbox`: its queue is the table of deliveries, not the broker's."""

ONCE: dict[str, Any] = {
    "socket_timeout": 2,
    "socket_connect_timeout": 2,
    "retry": Retry(NoBackoff(), 0),
}

log = structlog.get_logger()


def celery_app(broker_url: str) -> Celery:
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
        },
    )
    return app


class WakeUps:
    """Sends the messages that wake workers up."""

    def __init__(self, broker_url: str) -> None:
        self._app = celery_app(broker_url)

    def send(self, job_id: str, queue: str) -> bool:
        """Tell the workers of ``queue`` about a job; best effort, the sweeper repeats it."""
        try:
            self._app.send_task(
                RUN_JOB,
                args=[job_id],
                queue=queue,
                retry=True,
                retry_policy={"max_retries": 1, "interval_start": 0},
            )
        except (OperationalError, RedisError, OSError) as error:
            log.warning("queue.unreachable", job_id=job_id, error=str(error))
            return False
        return True


def connect(broker_url: str) -> redis.Redis:
    """Return a client of the broker itself that fails at once, for asking whether it answers."""
    url = broker_url.replace("redis+socket://", "unix://", 1)
    return redis.Redis.from_url(url, **ONCE)
