"""Titles of scans, names of rigs, labels of both and of subjects, vertices of templates."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0013"
down_revision = "0012"

LABELLED = ("subjects", "captures", "rigs")


def upgrade() -> None:
    """Apply."""
    for table in LABELLED:
        labels: sa.Column = sa.Column("labels", sa.JSON(), nullable=False, server_default="{}")
        op.add_column(table, labels)
    op.add_column("captures", sa.Column("title", sa.String(length=200)))
    op.add_column(
        "rigs", sa.Column("name", sa.String(length=200), nullable=False, server_default="")
    )
    op.add_column("templates", sa.Column("vertices", sa.Integer()))


def downgrade() -> None:
    """Take back."""
    op.drop_column("templates", "vertices")
    op.drop_column("rigs", "name")
    op.drop_column("captures", "title")
    for table in reversed(LABELLED):
        op.drop_column(table, "labels")
