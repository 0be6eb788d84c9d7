"""Disks without room: that of the results, and the database's."""

from __future__ import annotations

from sqlalchemy import select

from service.store.models import Attempt
from tests.campaigns.chaos.stage import SETTINGS, Stage

LEASE = SETTINGS["lease"]


def fill_disk(stage: Stage) -> bool:
    """Leave no room for results until a job was put off for it."""
    if stage.places.results is None:
        return stage.leave_out("fill-disk", "no mount is allowed here")
    stage.submit(len(stage.good) + 2)
    before = _put_off(stage)
    stage.places.results.fill()
    try:
        return stage.until(lambda: _put_off(stage) > before, seconds=15)
    finally:
        stage.places.results.clear()


def fill_database(stage: Stage) -> bool:
    """Leave the database no room until writing is refused, and for longer than a lease."""
    disk = stage.places.tables
    if disk is None:
        return stage.leave_out("fill-database", "no mount is allowed here")
    if not stage.nobody_is_on_the_last_try():
        return False

    def refuses() -> bool:
        disk.fill()  # anew: a checkpoint makes room
        return not _write(stage)

    try:
        full = stage.until(refuses, seconds=20)
        refused = _refusals_until(stage, LEASE * stage.dice.uniform(0.5, 2.0))
    finally:
        disk.clear()
    return full and refused > 0 and stage.until(lambda: _write(stage), seconds=20)


def _write(stage: Stage) -> bool:
    """Try to write a row; what refuses it must be the full disk."""
    answer = stage.studio.http.post("/v1/subjects", json={"name": "x" * 200})
    if not answer.is_success:
        found = (answer.status_code, answer.json()["code"])
        assert found == (507, "storage.full"), found
    return answer.is_success


def _refusals_until(stage: Stage, seconds: float) -> int:
    """Write for some seconds; returns how many times it was refused."""
    refused = 0

    def count() -> bool:
        nonlocal refused
        refused += not _write(stage)
        return False

    stage.until(count, seconds)
    return refused


def _put_off(stage: Stage) -> int:
    with stage.store.read() as session:
        return len(session.scalars(select(Attempt).where(Attempt.outcome == "postponed")).all())
