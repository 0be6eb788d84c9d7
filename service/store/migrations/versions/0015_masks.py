"""Masks of photographs."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0015"
down_revision = "0014"


def upgrade() -> None:
    """Apply."""
    op.add_column("captures", sa.Column("mask_filename", sa.String(length=255)))
    op.add_column("captures", sa.Column("mask_size", sa.BigInteger()))
    op.add_column("captures", sa.Column("mask_sha256", sa.String(length=64)))
    op.create_index("ix_captures_mask_sha256", "captures", ["mask_sha256"])


def downgrade() -> None:
    """Take back."""
    op.drop_index("ix_captures_mask_sha256", "captures")
    for name in ("mask_sha256", "mask_size", "mask_filename"):
        op.drop_column("captures", name)
