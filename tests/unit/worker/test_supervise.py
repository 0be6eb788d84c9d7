"""What a supervisor does when the database does not answer."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
from sqlalchemy import select
from sqlalchemy.exc import OperationalError

from service.settings import Settings
from service.store import jobs
from service.store.models import DEFAULT_TENANT, Job, LogLine, Subject
from service.store.store import Store
from worker.abilities import abilities
from worker.attempt import FRAMES, AttemptFolder
from worker.supervise import Supervisor


class Talking:
    """A solver process that says one more line and phase each time it is asked."""

    def __init__(self) -> None:
        self.said = 0

    def steps(self) -> list[dict[str, object]]:
        self.said += 1
        return [{"phase": f"phase {self.said}", "fraction": 0.1 * self.said}]

    def lines(self) -> list[str]:
        return [f"line {self.said}"]


def test_what_was_said_during_an_outage_is_written_down_after_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = Settings(data_dir=tmp_path)
    store = Store(settings.database, settings.files, settings.broker)
    store.database.migrate()
    with store.write() as session:
        session.add(subject := Subject(tenant_id=DEFAULT_TENANT, name="Alex"))
        session.flush()
        request = {"options": {}, "rig_id": None}
        job = Job(
            tenant_id=DEFAULT_TENANT,
            subject_id=subject.id,
            kind="build_model",
            queue="short",
            request=request,
            inputs=[],
            max_attempts=3,
        )
        jobs.create(session, job)
        claim = jobs.claim(session, job.id, "me", 30)
    assert claim is not None
    supervisor = Supervisor(store, settings, abilities(settings), threading.Event())
    supervisor._renewed = float("inf")
    process, folder = Talking(), AttemptFolder(settings.work, claim)
    frames = folder.path / "out" / FRAMES
    frames.mkdir(parents=True)
    (frames / "000000-000029.json").write_text("{}")

    def away() -> None:
        raise OperationalError("BEGIN", None, Exception("gone"))

    with monkeypatch.context() as outage:
        outage.setattr(store, "write", away)
        supervisor._beat(claim, process, folder)
        supervisor._beat(claim, process, folder)
    supervisor._beat(claim, process, folder)
    supervisor._beat(claim, process, folder)
    with store.write() as session:  # told once more, as after a commit whose answer was lost
        (kept,) = jobs.frames(session, job.id)
        chunk = {"first": kept.first, "last": kept.last, "sha256": kept.sha256}
        jobs.beat(session, job.id, claim.attempt, 30, chunks=[chunk])
    with store.read() as session:
        said = session.scalars(select(LogLine.text).order_by(LogLine.number)).all()
        assert said == ["line 1", "line 2", "line 3", "line 4"]
        assert [(chunk.first, chunk.last) for chunk in jobs.frames(session, job.id)] == [(0, 29)]
        assert session.get(Job, job.id).progress["phase"] == "phase 4"
    store.close()
