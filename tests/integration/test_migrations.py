"""Migrations and models say the same on both databases, upwards and back."""

from __future__ import annotations

from pathlib import Path

import pytest
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext

from service.settings import Settings
from service.store.database import Database
from service.store.models import DEFAULT_TENANT, Base, Subject


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
                context = MigrationContext.configure(connection)
                assert compare_metadata(context, Base.metadata) == []
    with database.write(DEFAULT_TENANT) as session:
        session.add(Subject(name="Alex"))
    database.close()
