"""Delivering webhooks: a worker of its own, so that no receiver ever holds up a job.

It needs no broker, for the deliveries in the table are its queue, and it is the only part of the
service that calls other hosts. Several can run, on one host or on several.
"""

from __future__ import annotations

import json
import random
import signal
import sys
import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor

import structlog
from sqlalchemy.exc import SQLAlchemyError

from service import tracing
from service.outbound import Answer, Refused, Sender, Unreachable
from service.queue import outbox
from service.queue.claims import Abilities
from service.queue.outbox import ClaimedDelivery, DeliveryOutcome
from service.queue.wakeups import WEBHOOKS
from service.secret import wait_for_secret
from service.settings import Settings
from service.store.database import Store
from service.webhooks import signing
from worker.sweeper import Heartbeat

# Seconds between two looks into the table: when there was nothing, and when there was
POLL = 0.5
BUSY = 0.02
# Seconds of a lease beyond the time limit of a request
MARGIN = 20.0
EXCERPT = 500
SECRET_SECONDS = 20.0
FORGET_EVERY = 3600.0

log = structlog.get_logger()


def main(store: Store, settings: Settings, can: Abilities) -> None:
    """Deliver until told to stop."""
    if not settings.webhook_workers:
        sys.exit("MYOFACE_WEBHOOK_WORKERS is 0: nobody would deliver")
    stopping = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopping.set())
    try:
        master = wait_for_secret(settings, SECRET_SECONDS)
    except TimeoutError as error:
        sys.exit(str(error))
    store.database.migrate()
    # no sweeper: neither the files nor the broker need be in its reach
    Heartbeat(store, settings, WEBHOOKS, can, settings.webhook_workers, stopping).start()
    sender = Sender(settings.webhook_timeout, settings.webhook_allow)
    Deliverer(store, settings, master, sender, stopping).run()


class Deliverer:
    """Sends what is due, by ``settings.webhook_workers`` threads, until ``stopping`` is set.

    At most half of the threads wait for receivers that did not answer the last time, and no more
    for the receivers of one tenant while another has something due.
    """

    def __init__(
        self,
        store: Store,
        settings: Settings,
        master: bytes,
        sender: Sender,
        stopping: threading.Event,
    ) -> None:
        self._store = store
        self._settings = settings
        self._master = master
        self._sender = sender
        self._stopping = stopping
        self._under_way: dict[Future[None], ClaimedDelivery] = {}

    def run(self) -> None:
        """Deliver; what is under way at the end is finished."""
        forgotten = 0.0
        pause = POLL
        with ThreadPoolExecutor(self._settings.webhook_workers) as pool:
            while not self._stopping.wait(pause):
                pause = POLL
                try:
                    for delivery in self._take():
                        pause = BUSY
                        self._under_way[pool.submit(self._deliver, delivery)] = delivery
                    if not forgotten or time.monotonic() - forgotten > FORGET_EVERY:
                        forgotten = time.monotonic()
                        with self._store.write() as session:
                            outbox.forget(session)
                except SQLAlchemyError as error:
                    log.warning("webhooks.failed", error=str(error))

    def _take(self) -> list[ClaimedDelivery]:
        self._under_way = {
            future: delivery for future, delivery in self._under_way.items() if not future.done()
        }
        threads = self._settings.webhook_workers
        deliveries = self._under_way.values()
        with self._store.read() as session:
            if len(deliveries) == threads or not outbox.is_due(session):
                return []
        with self._store.write() as session:
            lease = self._settings.webhook_timeout + MARGIN
            return outbox.take(session, deliveries, threads, lease)

    def _deliver(self, delivery: ClaimedDelivery) -> None:
        with tracing.trace_work(
            "delivery",
            None,
            delivery_id=delivery.delivery_id,
            webhook_id=delivery.webhook_id,
            attempt=delivery.attempt,
        ):
            outcome = self._send(delivery)
            tracing.note(not outcome.is_delivered, outcome=outcome.error or "delivered")
        log.info(
            "webhook.delivered" if outcome.is_delivered else "webhook.not_delivered",
            delivery_id=delivery.delivery_id,
            webhook_id=delivery.webhook_id,
            attempt=delivery.attempt,
            status=outcome.status,
            error=outcome.error,
        )
        pauses = [pause * random.uniform(1, 1.1) for pause in self._settings.webhook_schedule]
        try:
            with self._store.write() as session:
                outbox.settle(session, delivery, outcome, pauses)
        except SQLAlchemyError as error:  # the lease runs out, and it is sent once more
            log.warning("webhooks.failed", error=str(error))

    def _send(self, delivery: ClaimedDelivery) -> DeliveryOutcome:
        body = _body(delivery)
        secrets = [
            signing.secret(self._master, delivery.webhook_id, generation)
            for generation in delivery.generations
        ]
        headers = {
            **signing.headers(delivery.event_id, int(time.time()), body, secrets),
            "content-type": "application/json",
            "user-agent": "Myoface",
        }
        try:
            answer = self._sender.post(delivery.url, body, headers)
        except (Refused, Unreachable) as error:
            return DeliveryOutcome(error=error.code, excerpt=str(error)[:EXCERPT])
        return _judge_answer(answer)


def _body(delivery: ClaimedDelivery) -> bytes:
    """Return the body of an event: the same bytes at every try."""
    told = {
        "type": delivery.type,
        "timestamp": delivery.created_at.isoformat(),
        "data": delivery.data,
    }
    return json.dumps(told, separators=(",", ":")).encode()


def _judge_answer(answer: Answer) -> DeliveryOutcome:
    text = answer.body[: 4 * EXCERPT].decode("utf-8", "replace").replace("\0", "\ufffd")
    outcome = DeliveryOutcome(answer.status, answer.ms, None, text[:EXCERPT])
    if outcome.is_delivered:
        return outcome
    wish = answer.retry_after if answer.status in (429, 503) else None
    return DeliveryOutcome(answer.status, answer.ms, "answer.status", text[:EXCERPT], wish or 0.0)
