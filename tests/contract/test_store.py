"""The tables, their migrations and the docs say the same."""

from __future__ import annotations

import re
from pathlib import Path

from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext

from service.store.database import Database
from service.store.models import Base
from service.store.transitions import ALLOWED

DOCS = Path(__file__).parents[2] / "docs" / "api.md"


def test_migrations_make_the_tables_that_the_models_describe(tmp_path: Path) -> None:
    database = Database(f"sqlite:///{tmp_path / 'db'}")
    database.migrate()
    database.migrate()
    with database.engine.connect() as connection:
        differences = compare_metadata(MigrationContext.configure(connection), Base.metadata)
    database.close()
    assert differences == []


def test_the_documented_transitions_are_the_allowed_ones() -> None:
    table = DOCS.read_text().partition("| from | to |")[2].partition("\n\n")[0]
    rows = re.findall(r"^\| `(\w+)` \| (`.*) \|$", table, re.MULTILINE)
    documented = {origin: set(re.findall(r"`(\w+)`", to)) for origin, to in rows}
    allowed = {state.value: {to.value for to in following} for state, following in ALLOWED.items()}
    assert documented == {state: following for state, following in allowed.items() if following}
