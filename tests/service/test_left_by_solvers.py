"""What a solver leaves is bounded where it is stored and read: it may have been taken over."""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import event, func, select

from service.bounds import PROGRESS, fit_progress
from service.jobs import service as work
from service.queue import table
from service.settings import Settings
from service.store.database import Store
from service.store.models import DEFAULT_TENANT, Artifact, Event, FrameChunk, Job, new_id
from tests.service_client import Studio, served


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[Studio]:
    with served(Settings(data_dir=tmp_path)) as studio:
        yield studio


@pytest.fixture
def store(studio: Studio) -> Store:
    store: Store = studio.http.app.state.store  # type: ignore[attr-defined]
    return store


@pytest.fixture
def job_id(studio: Studio) -> str:
    return studio.submit("build_model", studio.subject())


def _steps(store: Store, job_id: str) -> list[dict[str, Any]]:
    with store.read() as session:
        reports = select(Event).where(Event.job_id == job_id, Event.kind == "progress")
        return [each.data for each in session.scalars(reports.order_by(Event.id))]


@pytest.mark.long
def test_progress_without_end_fills_no_table(
    studio: Studio, store: Store, job_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(table, "MOST_STEPS", 100)
    with store.write() as session:
        claim = table.take(session, job_id, "test", 60)
    assert claim
    written = 0
    for beat in range(10):
        flood = [{"phase": f"{beat} {n}", "fraction": 0.5, "x": "x" * 9000} for n in range(500)]
        with store.write() as session:
            before = session.scalar(select(func.max(Event.id))) or 0
            table.beat(session, job_id, claim.attempt, 60, steps=flood)
            written = (session.scalar(select(func.max(Event.id))) or 0) - before
        assert written <= table.MOST_STEPS_OF_BEAT
        kept = _steps(store, job_id)
        assert len(kept) <= 100
        assert kept[-1]["phase"] == f"{beat} 499"  # the newest is told
        assert studio.job(job_id)["progress"]["phase"] == f"{beat} 499"
    assert max(len(json.dumps(each)) for each in kept) <= PROGRESS.size + 100


@pytest.mark.long
@pytest.mark.parametrize(
    ("fraction", "shown"),
    [(10**400, 1.0), (math.inf, 1.0), (-3, 0.0), (math.nan, 0.0), (0.5, 0.5)],
    ids=["huge", "infinite", "below", "nan", "plain"],
)
def test_progress_is_a_share_of_the_whole(
    fraction: float, shown: float, studio: Studio, store: Store, job_id: str
) -> None:
    with store.write() as session:
        claim = table.take(session, job_id, "test", 60)
        assert claim
        step = {"phase": "x", "fraction": fraction, "residual": math.inf}
        table.beat(session, job_id, claim.attempt, 60, steps=[step])
    answer = studio.http.get(f"/v1/jobs/{job_id}")
    assert answer.status_code == 200, answer.text
    assert answer.json()["progress"]["fraction"] == shown
    [kept] = _steps(store, job_id)
    assert json.dumps(kept, allow_nan=False)
    assert list(fit_progress({"x": 1, **step}))[:2] == ["phase", "fraction"]


def test_files_take_the_place_of_their_names_in_one_statement(store: Store, job_id: str) -> None:
    def left(size: int) -> list[Artifact]:
        mine: dict[str, Any] = {"tenant_id": DEFAULT_TENANT, "job_id": job_id, "media_type": "x"}
        return [
            Artifact(name=f"{number}.png", size=size, sha256=f"{number:064}", **mine)
            for number in range(200)
        ]

    with store.write() as session:
        claim = table.take(session, job_id, "test", 60)
        assert claim
        table.beat(session, job_id, claim.attempt, 60, kept=left(1))
    deletions: list[str] = []

    def count(_connection: Any, _cursor: Any, statement: str, *_: Any) -> None:
        deletions.extend([statement] if statement.startswith("DELETE FROM artifacts") else [])

    event.listen(store.database.engine, "before_cursor_execute", count)
    with store.write() as session:
        assert table.succeed(session, job_id, claim.attempt, left(2))
    assert len(deletions) == 1
    with store.read() as session:
        sizes = session.scalars(select(Artifact.size).where(Artifact.job_id == job_id)).all()
    assert sizes == [2] * 200


class Simulation:
    """A job with frames, whose files are whatever a solver left."""

    def __init__(self, studio: Studio, store: Store, folder: Path) -> None:
        self._studio = studio
        self._store = store
        self._folder = folder
        self._job_id = new_id()
        request = {"options": {}, "rig_id": None, "captures": [], "kind": "simulate"}
        row: dict[str, Any] = {"id": self._job_id, "kind": "simulate", "queue": "long"}
        row |= {"subject_id": studio.subject(), "inputs": [], "max_attempts": 3}
        with store.of(DEFAULT_TENANT).write() as session:
            session.add(Job(**row, request=request))

    def leave(self, first: int, content: str, last: int | None = None) -> None:
        file = self._folder / f"{first}.json"
        file.write_text(content)
        blob = vars(self._store.files.put(file))
        last = first if last is None else last
        with self._store.write() as session:
            session.add(FrameChunk(job_id=self._job_id, first=first, last=last, attempt=1, **blob))

    def ask(self, path: str = "") -> tuple[int, Any]:
        answer = self._studio.http.get(f"/v1/jobs/{self._job_id}/frames{path}")
        return answer.status_code, answer.json().get("code") if answer.content else None

    def frames(self) -> list[dict[str, Any]]:
        answer = self._studio.http.get(f"/v1/jobs/{self._job_id}/frames")
        assert answer.status_code == 200, answer.text
        found: list[dict[str, Any]] = answer.json()["frames"]
        return found


@pytest.fixture
def simulation(studio: Studio, store: Store, tmp_path: Path) -> Simulation:
    return Simulation(studio, store, tmp_path)


BAD = {
    "too large": '{"frames": [], "state": "' + "x" * 3000 + '"}',
    "too many values": '{"frames": [' + "0," * 500 + "0]}",
    "deep": "[" * 2000,
    "no JSON": "frames",
    "a list": "[]",
    "no frames": '{"frames": 3}',
    "other frames": '{"frames": [{"frame": "x"}]}',
}


@pytest.mark.long
@pytest.mark.parametrize("fault", BAD)
def test_a_file_of_frames_is_read_as_far_as_it_may_go(
    fault: str, simulation: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(work, "LARGEST_CHUNK", 2500)
    monkeypatch.setattr(work, "MOST_VALUES", 400)
    simulation.leave(0, BAD[fault])
    assert simulation.ask() == (409, "job.bad_frames")


RELAXED = [1.0, 0.0, 0.0, 1.0, 0.0, 1.0]
FITTED = dict.fromkeys(("mean_mm", "p95_mm", "max_mm", "coverage"), 0)
MOVED = {"eyes": [], **dict.fromkeys(("time", "penetration_mm", "behind_teeth"), 0)}
OF_KINDS = {
    "predicted": {"status": "predicted", **FITTED},
    "smoothed": {"status": "smoothed", **FITTED},
    "of a scene": {**MOVED, "halvings": 0, "residual": 0},
}


@pytest.mark.long
@pytest.mark.parametrize(
    ("stored", "rows"), [([0.5, 0.0], [[0.5], [0.0]]), ([RELAXED], [RELAXED])], ids=["fibres", "S"]
)
@pytest.mark.parametrize("kind", OF_KINDS)
def test_activations_are_answered_in_rows(
    kind: str, stored: list[Any], rows: list[list[float]], simulation: Simulation
) -> None:
    """Files of fibre muscles hold one number each, those of other muscles six."""
    plain = {"jaw": [0.0] * 5, "head": [0.0] * 6, "inverted": 0, "iterations": 0, "seconds": 0}
    frame = {"frame": 7, "activations": stored, **plain, **OF_KINDS[kind]}
    simulation.leave(0, json.dumps({"frames": [frame]}))
    [answered] = simulation.frames()
    assert answered["activations"] == rows
    assert answered.get("status") == OF_KINDS[kind].get("status")


@pytest.mark.parametrize("picture", ["3", '"?"', '"A"'])
def test_a_picture_is_base_64(picture: str, simulation: Simulation) -> None:
    simulation.leave(0, f'{{"frames": [], "picture": {picture}}}')
    assert simulation.ask("/picture")[0] in (200, 409)


@pytest.mark.long
def test_an_answer_reads_so_many_files_at_most(
    simulation: Simulation, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []
    real = store.files.open

    def note(sha256: str, *span: int) -> Iterator[bytes]:
        opened.append(sha256)
        return real(sha256, *span)

    monkeypatch.setattr(work, "MOST_READ", 50)
    for first in range(20):  # each says that it has them all
        simulation.leave(first, json.dumps({"frames": [], "n": first}), last=1_000_000)
    monkeypatch.setattr(type(store.files), "open", lambda _self, *given: note(*given))
    assert simulation.ask("?start=30")[0] == 200
    assert 1 <= len(opened) <= 3
    opened.clear()
    assert simulation.ask("/picture")[0] == 204
    assert len(opened) == work.MOST_LOOKED_AT


@pytest.mark.long
def test_two_requests_at_a_time_hold_files_of_frames(
    simulation: Simulation, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulation.leave(0, '{"frames": []}')
    together = set[int]()
    most = 0
    real = work._parse_chunk

    def parse(*given: Any) -> dict[str, Any]:
        nonlocal most
        together.add(threading.get_ident())
        most = max(most, len(together))
        with suppress(threading.BrokenBarrierError):
            barrier.wait(0.5)
        found = real(*given)
        together.discard(threading.get_ident())
        return found

    barrier = threading.Barrier(3)  # which nobody passes where two are together at most
    monkeypatch.setattr(work, "_parse_chunk", parse)
    answers: list[tuple[int, Any]] = []
    threads = [threading.Thread(target=lambda: answers.append(simulation.ask())) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [status for status, _ in answers] == [200] * 4
    assert most <= 2
