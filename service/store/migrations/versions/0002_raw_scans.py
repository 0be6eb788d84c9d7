"""Raw scans: captures say what they are, jobs may be about one capture and leave figures."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"


def upgrade() -> None:
    """Apply; the captures there are were all taken as registered."""
    op.add_column(
        "captures", sa.Column("registered", sa.Boolean(), nullable=False, server_default=sa.true())
    )
    op.add_column("captures", sa.Column("landmarks_filename", sa.String(length=255)))
    op.add_column("captures", sa.Column("landmarks_sha256", sa.String(length=64)))
    op.create_index("ix_captures_landmarks_sha256", "captures", ["landmarks_sha256"])
    op.add_column("jobs", sa.Column("summary", sa.JSON()))
    op.add_column("jobs", sa.Column("capture_id", sa.String(length=36)))
    op.create_index("ix_jobs_capture_id", "jobs", ["capture_id"])


def downgrade() -> None:
    """Take back."""
    op.drop_index("ix_jobs_capture_id", "jobs")
    op.drop_column("jobs", "capture_id")
    op.drop_column("jobs", "summary")
    op.drop_index("ix_captures_landmarks_sha256", "captures")
    op.drop_column("captures", "landmarks_sha256")
    op.drop_column("captures", "landmarks_filename")
    op.drop_column("captures", "registered")
