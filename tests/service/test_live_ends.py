"""A session that is told to end is given the time to store its takes."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import anyio
import pytest
from sqlalchemy import update

from service.live import service
from service.queue.states import State
from service.settings import Settings
from service.store.models import Job
from solver.kinds.live_session import ENDING
from tests.service.test_handed_on import Session
from tests.service_client import served


class Deaf:
    """A broker that passes a word on to nobody."""

    async def tell(self, *_: object) -> None:
        pass


@pytest.fixture
def session(tmp_path: Path) -> Iterator[Session]:
    with served(Settings(data_dir=tmp_path)) as studio:
        yield Session(studio)


@pytest.mark.parametrize("says_so", [True, False])
def test_a_session_that_stores_takes_is_waited_for_and_never_canceled(
    session: Session, monkeypatch: pytest.MonkeyPatch, says_so: bool
) -> None:
    monkeypatch.setattr(service, "ENDS_WITHIN", 0.3)
    monkeypatch.setattr(service, "PAUSE", 0.02)
    opened = session.studio.post("/v1/live", rig_id=session.rig, source="weights")
    job = opened["id"]
    store = session.store

    def note(**values: object) -> None:
        with store.write() as opened:
            opened.execute(update(Job).where(Job.id == job).values(**values))

    progress = {"phase": ENDING if says_so else "live", "fraction": 0.96}
    note(state=State.RUNNING, progress=progress)

    def store_takes() -> None:
        time.sleep(0.8)
        if says_so:
            note(state=State.SUCCEEDED)

    storing = threading.Thread(target=store_takes)
    storing.start()
    anyio.run(service.end, store, Deaf(), job)
    storing.join()
    found = session.studio.job(job)["state"]
    assert (found == "succeeded") is says_so
