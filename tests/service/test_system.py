"""Routes of the service itself, without workers and broker."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import update

from service.queue import sweep
from service.settings import Settings
from service.store.models import Lease, now
from service.system import service
from service.system.schemas import Readiness
from service.system.service import ReadinessCache
from tests.service_client import Studio, served


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    with served(Settings(data_dir=tmp_path_factory.mktemp("system"))) as studio:
        yield studio


def test_the_old_path_of_the_kinds_answers_and_names_the_new_one(studio: Studio) -> None:
    kinds = studio.http.get("/v1/kinds")
    solvers = studio.http.get("/v1/solvers")
    assert kinds.status_code == solvers.status_code == 200
    assert kinds.json()["items"]
    assert solvers.json() == kinds.json()
    assert solvers.headers["Deprecation"].startswith("@")
    assert solvers.headers["Link"] == '</v1/kinds>; rel="successor-version"'
    assert "Deprecation" not in kinds.headers


def test_only_the_new_path_is_described(studio: Studio) -> None:
    paths = studio.get("/openapi.json")["paths"]
    assert "/v1/kinds" in paths
    assert "/v1/solvers" not in paths


@pytest.mark.parametrize("path", ["/v1/kinds", "/v1/solvers"])
def test_both_paths_need_a_key(path: str, studio: Studio) -> None:
    assert studio.http.get(path, headers={"Authorization": ""}).status_code == 401


READY = Readiness(ready=True, checks={}, workers={}, sweeper="ok")


class Parts:
    """Parts that are asked for their readiness, and hang while told to."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.asked = 0
        self.begun = threading.Event()
        self.answering = threading.Event()
        self.answering.set()
        monkeypatch.setattr(service, "readiness", self._ask)

    def _ask(self, *_: Any) -> Readiness:
        self.asked += 1
        self.begun.set()
        assert self.answering.wait(20)
        return READY.model_copy(update={"workers": {"short": self.asked}})


def _cache(tmp_path: Path) -> ReadinessCache:
    nothing: Any = None
    return ReadinessCache(nothing, Settings(data_dir=tmp_path))


def test_everybody_may_ask_and_the_parts_are_asked_now_and_then(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert service.KEPT == 2
    parts = Parts(monkeypatch)
    cache = _cache(tmp_path)
    assert {cache.ask().workers["short"] for _ in range(50)} == {1}
    cache._asked -= service.KEPT
    assert {cache.ask().workers["short"] for _ in range(50)} == {2}
    assert parts.asked == 2


@pytest.mark.parametrize("known", [False, True], ids=["first", "later"])
def test_nobody_waits_for_a_part_that_hangs_but_the_one_who_asks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, known: bool
) -> None:
    parts = Parts(monkeypatch)
    cache = _cache(tmp_path)
    if known:
        assert cache.ask().ready
        cache._asked -= service.KEPT
    parts.answering.clear()
    parts.begun.clear()
    first = threading.Thread(target=cache.ask)
    first.start()
    assert parts.begun.wait(20)
    told: list[Readiness] = []
    others = [threading.Thread(target=lambda: told.append(cache.ask())) for _ in range(5)]
    for other in others:
        other.start()
    for other in others:
        other.join(10)
    assert [answer.ready for answer in told] == [known] * 5
    parts.answering.set()
    first.join()
    assert cache.ask().ready
    assert parts.asked == 1 + int(known)


def test_a_silent_sweeper_is_told_beside_readiness(studio: Studio) -> None:
    app: Any = studio.http.app  # type: ignore[attr-defined]

    def sweeper() -> str:
        app.state.readiness._asked -= service.KEPT
        return str(studio.http.get("/readyz").json()["sweeper"])

    assert sweeper() == "silent"  # there was none yet
    with app.state.store.write() as session:
        assert sweep.hold_office(session, sweep.SWEEPER, "worker", 15)
    assert sweeper() == "ok"
    with app.state.store.write() as session:
        ago = now() - timedelta(minutes=2)
        session.execute(update(Lease).where(Lease.office == sweep.SWEEPER).values(until=ago))
    assert sweeper() == "silent"
    answer = studio.http.get("/readyz").json()
    assert answer["checks"]["database"] == "ok"
    assert "sweeper" not in answer["checks"]
