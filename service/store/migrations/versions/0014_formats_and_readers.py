"""Formats of artifacts, and the jobs that had read what a deletion took."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0014"
down_revision = "0013"


def upgrade() -> None:
    """Apply."""
    op.add_column("artifacts", sa.Column("format", sa.Integer()))
    read_by: sa.Column = sa.Column("read_by", sa.JSON(), nullable=False, server_default="[]")
    op.add_column("deletions", read_by)


def downgrade() -> None:
    """Take back."""
    op.drop_column("deletions", "read_by")
    op.drop_column("artifacts", "format")
