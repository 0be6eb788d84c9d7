"""Sequences: the frames that are ready while a job runs."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"


def upgrade() -> None:
    """Apply."""
    op.create_table(
        "job_frames",
        sa.Column("job_id", sa.String(length=36), nullable=False),
        sa.Column("first", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("last", sa.Integer(), nullable=False),
        sa.Column("attempt", sa.Integer(), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.ForeignKeyConstraint(["job_id"], ["jobs.id"], ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("job_id", "first"),
    )
    op.create_index("ix_job_frames_sha256", "job_frames", ["sha256"])


def downgrade() -> None:
    """Take back."""
    op.drop_index("ix_job_frames_sha256", "job_frames")
    op.drop_table("job_frames")
