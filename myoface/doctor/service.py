"""Checks of the service as it is configured here: its stores, its workers, what is stuck."""

from __future__ import annotations

import os
import tempfile
from collections import Counter
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import redis
from sqlalchemy import func, select
from sqlalchemy.exc import SQLAlchemyError

from myoface.doctor.machine import OTHERS, Diagnosis
from service.access.keys import Keyring
from service.errors import Problem
from service.queue.states import HELD, State
from service.queue.wakeups import LIVE, QUEUES, connect
from service.secret import secret as secret_of
from service.settings import Settings
from service.store import deletion
from service.store.broker import BrokerNotFoundError, find_server
from service.store.database import Database, Store, clock, known_revisions, revision_of
from service.store.files import Files
from service.store.integrity import faults, holders
from service.store.models import ApiKey, Job, now
from service.system.service import living_workers

MOST_SKEW = timedelta(seconds=2)
LONG_QUEUED = timedelta(minutes=10)
LONG_LOST = timedelta(minutes=1)
# Lost files that are named
MOST_LISTED = 50


def broker(settings: Settings) -> Diagnosis:
    """Check that the broker answers, or that there is one to start."""
    if settings.broker_url is None:
        try:
            return Diagnosis("broker", "ok", f"{find_server()}; it keeps nothing on the disk")
        except BrokerNotFoundError as error:
            return Diagnosis("broker", "fault", "none", str(error))
    try:
        with connect(settings.broker) as client:
            client.ping()
    except (redis.RedisError, OSError) as error:
        advice = "is the server at MYOFACE_BROKER_URL up, and the password right?"
        return Diagnosis("broker", "fault", str(error), advice)
    return Diagnosis("broker", "ok", "it answers")


def secret(settings: Settings) -> Diagnosis:
    """Check that the secret is there and nobody else can read it."""
    if settings.secret_key is not None:
        place = os.environ.get("MYOFACE_SECRET_KEY_FILE") or "MYOFACE_SECRET_KEY"
        return Diagnosis("secret", "ok", f"in {place}")
    path = settings.data_dir / "secret"
    if not path.exists():
        return Diagnosis("secret", "ok", "the first start makes one")
    if path.stat().st_mode & OTHERS:
        return Diagnosis("secret", "fault", f"others can read {path}", f"chmod 600 {path}")
    return Diagnosis("secret", "ok", str(path))


def stores(settings: Settings) -> Iterator[Diagnosis]:
    """Check files and database, and if there is one, what is in it."""
    try:
        store = Store(settings.database, settings.files, settings.broker)
    except (OSError, ImportError, ValueError) as error:
        yield Diagnosis(
            "files", "fault", str(error), "see MYOFACE_FILES_URL in docs/operate/service.md"
        )
        return
    yield files(store.files)
    database = store.database
    if database.is_sqlite and not Path(str(database.url.database)).exists():
        yield Diagnosis("database", "ok", "the first start makes one")
        return
    try:
        yield tables(database)
        with store.read() as session:
            skew = abs(clock(session) - now())
        yield _clock(skew)
        yield keys(store, settings)
        yield workers(store, settings)
        yield stuck(store)
        yield lost_files(store)
    except SQLAlchemyError as error:
        line = str(error).partition("\n")[0]
        yield Diagnosis(
            "database", "fault", line, "is MYOFACE_DATABASE_URL right and the server up?"
        )
    finally:
        store.close()


def files(place: Files) -> Diagnosis:
    """Check that a file can be stored, read and removed."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "file"
        path.write_bytes(os.urandom(1000))
        try:
            sha256 = place.put(path).sha256
            place.fetch(sha256, path)
            place.put_aside(sha256)
            place.remove(sha256)
        except OSError as error:
            advice = "see MYOFACE_FILES_DIR and MYOFACE_FILES_URL in docs/operate/service.md"
            return Diagnosis("files", "fault", str(error), advice)
    return Diagnosis("files", "ok", "stored, read and removed one")


def tables(database: Database) -> Diagnosis:
    """Check that the tables are those of this version."""
    wanted = known_revisions()[0]
    with database.engine.connect() as connection:
        found = revision_of(connection)
    if found == wanted:
        return Diagnosis("database", "ok", f"at revision {found}")
    advice = "the next start brings older tables up to date; newer ones need the newer version"
    return Diagnosis("database", "warning", f"at revision {found}, not {wanted}", advice)


def _clock(skew: timedelta) -> Diagnosis:
    """Check that this machine's clock is the database's: leases and expiry go by that."""
    seconds = f"{skew.total_seconds():.1f} s from the database's"
    if skew <= MOST_SKEW:
        return Diagnosis("clock", "ok", seconds)
    return Diagnosis("clock", "fault", seconds, "run an NTP client on every host")


def keys(store: Store, settings: Settings) -> Diagnosis:
    """Check that there is a key, and that this machine's secret is the one it was made with."""
    with store.read() as session:
        count = session.scalar(select(func.count()).select_from(ApiKey)) or 0
    if not count:
        return Diagnosis("keys", "warning", "none yet", "myoface admin-key makes one")
    try:
        text = settings.admin_key.read_text()
    except OSError:
        return Diagnosis("keys", "ok", f"{count} in the table; the first is not kept here")
    try:
        Keyring(store, secret_of(settings)).verify(text)
    except Problem as problem:
        advice = "every API host needs the same MYOFACE_SECRET_KEY; else: myoface admin-key"
        return Diagnosis("keys", "fault", f"{settings.admin_key}: {problem.detail}", advice)
    return Diagnosis("keys", "ok", f"{count}; the one in {settings.admin_key} opens")


def workers(store: Store, settings: Settings) -> Diagnosis:
    """Check that every queue has a worker."""
    living = Counter(worker.queue for worker in living_workers(store, settings))
    wanted = [queue for queue in QUEUES if queue != LIVE or settings.live_workers]
    found = ", ".join(f"{queue} {living[queue]}" for queue in wanted)
    if all(living[queue] for queue in wanted):
        return Diagnosis("workers", "ok", found)
    advice = "jobs of a queue without one wait; start it: python -m worker QUEUE"
    return Diagnosis("workers", "warning", found, advice)


def stuck(store: Store) -> Diagnosis:
    """Look for jobs that should have moved on."""
    with store.read() as session:
        moment = clock(session)
        jobs = select(func.count()).select_from(Job)
        counts = {
            "without their worker": jobs.where(
                Job.state.in_(HELD), Job.lease_until < moment - LONG_LOST
            ),
            f"queued for more than {LONG_QUEUED.seconds // 60} minutes": jobs.where(
                Job.state == State.QUEUED, Job.created_at < moment - LONG_QUEUED
            ),
        }
        found = {what: session.scalar(query) or 0 for what, query in counts.items()}
    words = ", ".join(f"{count} {what}" for what, count in found.items() if count)
    if not words:
        return Diagnosis("jobs", "ok", "none is stuck")
    advice = "is a worker up for each queue? its log, and myoface_* in /metrics, say more"
    return Diagnosis("jobs", "warning", words, advice)


def lost_files(store: Store) -> Diagnosis:
    """List the files that rows refer to and the store has not, or not whole.

    A file counts as damaged if its last reader found it so: the scrubber reads all in turn.
    """
    there = {stored.sha256 for stored in (*store.files.list_stored(), *store.files.list_aside())}
    with store.read() as session:
        wanted = deletion.references(session)
        found = dict.fromkeys(wanted - there, "lost")
        found |= {name: fault for name, fault in faults(session).items() if name in wanted & there}
        owners = holders(session, found)
    if not found:
        return Diagnosis("stored files", "ok", f"{len(wanted)}, none known as lost or damaged")
    words = [
        f"{fault}: {', '.join(owners.get(sha256, ['an input of a job']))} ({sha256})"
        for sha256, fault in sorted(found.items())
    ]
    left_out = len(words) - MOST_LISTED
    words[MOST_LISTED:] = [f"and {left_out} more"] if left_out > 0 else []
    advice = "copy them out of a backup's files/, or delete what they belong to and send it again"
    return Diagnosis("stored files", "fault", "; ".join(words), advice)
