"""Migrations and models say the same on both databases, upwards and back."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from alembic import command
from alembic.util import CommandError
from sqlalchemy import func, select, text

from service.settings import Settings
from service.store.database import Database, NewerDatabaseError, known_revisions, revision_of
from service.store.models import DEFAULT_TENANT, Subject, Tenant, Upload
from tests.schema import differences

pytestmark = pytest.mark.telling


@pytest.fixture
def database(tmp_path: Path) -> Database:
    return Database(Settings(data_dir=tmp_path).database)


def test_the_tables_are_those_of_the_models_after_going_back_and_forth(database: Database) -> None:
    for move, revision in (
        (command.upgrade, "head"),
        (command.downgrade, "0003"),
        (command.upgrade, "head"),
    ):
        database.migrate(move, revision)
        with database.engine.begin() as connection:
            if revision == "head" and move is command.upgrade:
                assert differences(connection) == []
    with database.write(DEFAULT_TENANT) as session:
        session.add(Subject(name="Alex"))
    database.close()


def test_a_database_of_a_newer_release_is_refused_with_a_sentence(database: Database) -> None:
    database.migrate()
    with database.engine.begin() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    with pytest.raises(NewerDatabaseError, match="newer release"):
        database.migrate()
    database.close()


def test_going_back_to_before_tenants_merges_nobody(database: Database) -> None:
    database.migrate()
    with database.write() as session:
        session.add(Tenant(id="north", name="North"))
    for tenant in (DEFAULT_TENANT, "north"):
        with database.write(tenant) as session:
            session.add(Subject(name=f"of {tenant}"))
    with pytest.raises(CommandError, match="2, whose people would become one tenant's"):
        database.migrate(command.downgrade, "0003")
    with database.engine.connect() as connection:
        assert revision_of(connection) == known_revisions()[0]  # no step was taken
    with database.read() as session:
        assert len(set(session.scalars(select(Subject.tenant_id)))) == 2
        session.execute(text("DELETE FROM subjects WHERE tenant_id = 'north'"))
        session.execute(text("DELETE FROM tenants WHERE id = 'north'"))
        session.commit()
    database.migrate(command.downgrade, "0003")
    database.close()


def test_uploads_from_before_know_what_they_were_used_for(database: Database) -> None:
    database.migrate(command.upgrade, "0007")
    at = "'2026-01-01 00:00:00'"
    of_file = "tenant_id, filename, size, created_at"
    file = f"'{DEFAULT_TENANT}', 'x', 1, {at}"
    rows = [
        f"subjects (id, tenant_id, name, created_at) VALUES ('s', '{DEFAULT_TENANT}', 'x', {at})",
        f"captures (id, subject_id, name, role, registered, sha256, landmarks_sha256, {of_file}) "
        f"VALUES ('c', 's', 'x', 'neutral', true, 'a', 'b', {file})",
        f"templates (id, name, sha256, {of_file}) VALUES ('t', 'x', 'd', {file})",
    ]
    for upload, sha256, complete in (
        ("scan", "a", "true"),
        ("marks", "b", "true"),
        ("template", "d", "true"),
        ("new", "e", "true"),
        ("announced", "a", "false"),
    ):
        rows.append(
            f'uploads (id, sha256, complete, "offset", expires_at, {of_file}) '
            f"VALUES ('{upload}', '{sha256}', {complete}, 1, {at}, {file})"
        )
    with database.engine.begin() as connection:
        for row in rows:
            connection.execute(text(f"INSERT INTO {row}"))
    for move, revision in ((command.upgrade, "head"), (command.downgrade, "0007")):
        database.migrate(move, revision)
    database.migrate()
    with database.read() as session:
        used = {row.id: row.used_by for row in session.execute(select(Upload.id, Upload.used_by))}
    assert used == {"scan": "c", "marks": "c", "template": "t", "new": None, "announced": None}
    database.close()


def test_many_uploads_from_before_are_soon_known(database: Database) -> None:
    database.migrate(command.upgrade, "0007")
    of_file = f"'{DEFAULT_TENANT}', 'x', 1, '2026-01-01 00:00:00'"
    numbers = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n WHERE i < 8000)"
    rows = (
        "subjects (id, tenant_id, name, created_at) "
        f"VALUES ('s', '{DEFAULT_TENANT}', 'x', '2026-01-01 00:00:00')",
        "captures (id, subject_id, name, role, registered, sha256, landmarks_sha256, tenant_id, "
        f"filename, size, created_at) {numbers} "
        f"SELECT i, 's', i, 'expression', true, 'a' || i, 'b' || i, {of_file} FROM n",
        'uploads (id, sha256, complete, "offset", expires_at, tenant_id, filename, size, '
        f"created_at) {numbers} "
        f"SELECT i, 'b' || i, true, 1, '2026-01-01 00:00:00', {of_file} FROM n",
    )
    with database.engine.begin() as connection:
        for row in rows:
            connection.execute(text(f"INSERT INTO {row}"))
    started = time.monotonic()
    database.migrate()
    assert time.monotonic() - started < 10
    with database.read() as session:
        assert session.scalar(select(func.count()).where(Upload.used_by == Upload.id)) == 8000
    database.close()
