"""Digests of files as they were sent, where others are stored."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0017"
down_revision = "0016"


def upgrade() -> None:
    """Apply."""
    for table in ("uploads", "captures"):
        op.add_column(table, sa.Column("sent_sha256", sa.String(length=64)))


def downgrade() -> None:
    """Take back."""
    for table in ("uploads", "captures"):
        op.drop_column(table, "sent_sha256")
