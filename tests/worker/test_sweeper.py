"""A worker that cleans up for long still shows that it lives, and frees what others lost."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path

import pytest
from sqlalchemy import select

from service.settings import Settings
from service.store.database import Store
from service.store.models import Worker
from tests.service_client import eventually
from tests.stores import open_store
from worker import sweeper
from worker.abilities import abilities


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with open_store(tmp_path) as store:
        yield store


def test_long_removals_hold_no_round_up(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = Settings(data_dir=tmp_path, sweep=0.02)
    begun, ended, stopping = threading.Event(), threading.Event(), threading.Event()

    def trim(_settings: Settings) -> None:
        begun.set()
        ended.wait(30)

    monkeypatch.setattr(sweeper, "trim_all", trim)

    def seen() -> datetime | None:
        with store.read() as session:
            return session.scalar(select(Worker.seen_at))

    thread = sweeper.Sweeper(store, settings, "short", abilities(settings), 1, stopping)
    thread.start()
    try:
        assert begun.wait(30)
        before = seen()
        assert before
        eventually(lambda: (seen() or before) > before)
    finally:
        ended.set()
        stopping.set()
        thread.join()
    assert seen() is None
