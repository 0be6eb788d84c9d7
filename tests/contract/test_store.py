"""The tables, their migrations and the docs say the same."""

from __future__ import annotations

import re
from pathlib import Path

from alembic import command
from alembic.script import ScriptDirectory
from sqlalchemy import delete, select, text, update

from service.queue.states import ALLOWED
from service.store.database import REVISIONS, Database, known_revisions
from service.store.models import DEFAULT_TENANT, Event, Job, Subject
from tests.schema import differences

DOCS = Path(__file__).parents[2] / "docs" / "reference" / "api.md"


def test_migrations_make_the_tables_that_the_models_describe(tmp_path: Path) -> None:
    database = Database(f"sqlite:///{tmp_path / 'db'}")
    database.migrate()
    database.migrate()
    with database.engine.connect() as connection:
        assert differences(connection) == []
    database.close()


def test_revisions_are_known_by_the_names_of_their_files() -> None:
    scripts = ScriptDirectory(str(REVISIONS.parent)).walk_revisions()
    assert [script.revision for script in scripts] == known_revisions()


def test_a_studios_work_survives_the_upgrade_to_tenants_and_back(tmp_path: Path) -> None:
    database = Database(f"sqlite:///{tmp_path / 'db'}")
    database.migrate(command.upgrade, "0003")
    moment = "2026-01-01 00:00:00"
    with database.engine.begin() as connection:
        for row in (
            f"subjects VALUES ('s', 'Alex', NULL, '{moment}')",
            "jobs (id, subject_id, kind, queue, request, inputs, state, attempt, max_attempts, "
            f"sends, created_at) VALUES ('j', 's', 'x', 'short', '{{}}', '[]', 'queued', 0, 3, 0, "
            f"'{moment}')",
            f"job_events VALUES (1, 'j', 'state', '{{}}', '{moment}')",
        ):
            connection.execute(text(f"INSERT INTO {row}"))
    for move, revision in (
        (command.upgrade, "head"),
        (command.downgrade, "0003"),
        (command.upgrade, "head"),
    ):
        database.migrate(move, revision)
    with database.read(DEFAULT_TENANT) as session:
        assert [job.id for job in session.scalars(select(Job))] == ["j"]
        assert len(session.scalars(select(Event)).all()) == 1
        subject = session.get_one(Subject, "s")
        session.execute(delete(Subject))
        assert session.scalars(select(Event)).all() == []
    assert subject.tenant_id == DEFAULT_TENANT
    with database.read("another") as session:
        assert session.scalars(select(Job)).all() == []
        assert session.execute(delete(Subject).returning(Subject.id)).all() == []
        assert session.execute(update(Job).values(kind="y").returning(Job.id)).all() == []
        assert session.get(Subject, "s") is None
    database.close()


def test_the_documented_transitions_are_the_allowed_ones() -> None:
    table = DOCS.read_text().partition("| from | to |")[2].partition("\n\n")[0]
    rows = re.findall(r"^\| `(\w+)` \| (`.*) \|$", table, re.MULTILINE)
    documented = {origin: set(re.findall(r"`(\w+)`", to)) for origin, to in rows}
    allowed = {state.value: {to.value for to in following} for state, following in ALLOWED.items()}
    assert documented == {state: following for state, following in allowed.items() if following}
