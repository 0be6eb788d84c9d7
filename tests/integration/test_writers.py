"""Requests that wait for the right to write keep nobody from reading, and are told to come back."""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import anyio
import httpx
import pytest
from fastapi.routing import APIRoute
from sqlalchemy import text

from service import writers
from service.app import create_app
from service.dependencies import READING, _for_receiving, _take_turn
from service.errors import Problem
from service.jobs.service import frames_busy
from service.settings import Settings
from service.store.database import Store
from tests.service_client import Studio, served

pytestmark = pytest.mark.telling

CALLERS = 45


@contextmanager
def _locked(studio: Studio) -> Iterator[None]:
    """Hold what writers need: SQLite's right to write, or tables of PostgreSQL's."""
    store: Store = studio.http.app.state.store  # type: ignore[attr-defined]
    with store.database.engine.connect() as connection:
        if store.database.is_sqlite:
            connection.rollback()
            connection.connection.driver_connection.execute("BEGIN IMMEDIATE")  # type: ignore[union-attr]
        else:
            connection.execute(text("LOCK TABLE subjects, jobs, uploads IN SHARE MODE"))
        try:
            yield
        finally:
            connection.connection.driver_connection.rollback()  # type: ignore[union-attr]


def test_writers_that_wait_leave_readers_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writers, "PATIENCE", 600.0)
    with served(Settings(data_dir=tmp_path)) as studio, ThreadPoolExecutor(CALLERS) as callers:
        with _locked(studio):
            asked = [
                callers.submit(studio.http.post, "/v1/subjects", json={"name": "Alex"})
                for _ in range(CALLERS)
            ]
            for path in ("/v1/me", "/v1/subjects", "/v1/jobs", "/v1/webhooks", "/v1/keys"):
                for _ in range(5):
                    assert studio.http.get(path).status_code == 200
            assert not any(each.done() for each in asked)
        assert {each.result().status_code for each in asked} == {201}
        assert len(studio.get("/v1/subjects")["items"]) == CALLERS


def test_writers_are_told_when_to_come_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those with a place that get no lock, as well as those without a place."""
    monkeypatch.setattr(writers, "PATIENCE", 1.0)
    monkeypatch.setattr(writers, "PLACES", 2)
    with served(Settings(data_dir=tmp_path)) as studio, ThreadPoolExecutor(6) as callers:
        location = studio.start_upload("smile.obj", 10)
        subject = studio.subject()
        job = {"kind": "build_model", "subject_id": subject}
        orders = [
            *[("POST", "/v1/subjects", {"name": "Alex"})] * 4,
            ("PUT", f"/v1/jobs/{uuid.uuid4()}", job),
            ("DELETE", location, None),
        ]

        def send(order: tuple[str, str, Any]) -> httpx.Response:
            method, path, body = order
            return studio.http.request(method, path, json=body)

        with _locked(studio):
            answers = list(callers.map(send, orders))
    for answer in answers:
        assert (answer.status_code, answer.json()["code"]) == (503, "database.busy")
        assert answer.headers["Retry-After"] == "5"


def test_every_route_that_writes_takes_its_turn(tmp_path: Path) -> None:
    included: Any = create_app(Settings(data_dir=tmp_path)).routes
    writing = [
        route
        for each in included
        if hasattr(each, "original_router")
        for route in each.original_router.routes
        if isinstance(route, APIRoute) and set(route.methods or ()) - READING - {"OPTIONS"}
    ]
    assert len(writing) > 20
    for route in writing:
        calls = set()
        left = [route.dependant]
        while left:
            dependant = left.pop()
            calls.add(dependant.call)
            left += dependant.dependencies
        assert calls & {_take_turn, _for_receiving}, route.path


def test_readers_of_frames_wait_for_their_turn_without_a_thread(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(writers, "PATIENCE", 0.05)

    async def read() -> None:
        places = writers.Places(1, frames_busy)
        async with places.place():
            with pytest.raises(Problem) as refused:
                async with places.place():
                    pass
        assert (refused.value.status, refused.value.code) == (503, "frames.busy")
        async with places.place():
            pass

    anyio.run(read)
