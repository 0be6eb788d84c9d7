"""Priorities, abilities, tries that do not count, jobs made again, batches."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"

COUNT_LOST = """
    UPDATE jobs SET lost = (
        SELECT count(*) FROM attempts WHERE attempts.job_id = jobs.id AND outcome = 'lost'
    )
"""
CLAIM_ORDER = ["queue", "state", "tenant_id", "priority", "created_at"]


def upgrade() -> None:
    """Apply."""
    added: list[sa.Column] = [
        sa.Column("parent_id", sa.String(length=36)),
        sa.Column("batch_id", sa.String(length=36)),
        sa.Column("priority", sa.SmallInteger(), nullable=False, server_default="0"),
        sa.Column("memory_mb", sa.Integer()),
        sa.Column("lost", sa.Integer(), nullable=False, server_default="0"),
        sa.Column("not_before", sa.DateTime(timezone=True)),
        sa.Column("no_room_since", sa.DateTime(timezone=True)),
    ]
    for column in added:
        op.add_column("jobs", column)
    op.execute(sa.text(COUNT_LOST))
    op.create_index("ix_jobs_parent_id", "jobs", ["parent_id"])
    op.create_index("ix_jobs_batch_id", "jobs", ["batch_id"])
    op.create_index("ix_jobs_claim", "jobs", CLAIM_ORDER)
    op.drop_index("ix_jobs_state_queue", "jobs")
    op.drop_index("ix_job_events_job_id", "job_events")
    op.create_index("ix_job_events_job_id", "job_events", ["job_id", "id"])
    declared: list[sa.Column] = [
        sa.Column("host", sa.String(length=255), nullable=False, server_default=""),
        sa.Column("version", sa.String(length=32), nullable=False, server_default=""),
        sa.Column("kinds", sa.JSON(), nullable=False, server_default="[]"),
        sa.Column("memory_mb", sa.Integer(), nullable=False, server_default="0"),
        sa.Column("threads", sa.Integer(), nullable=False, server_default="0"),
        sa.Column("slots", sa.Integer(), nullable=False, server_default="0"),
    ]
    for column in declared:
        op.add_column("workers", column)
    op.create_table(
        "batches",
        sa.Column("id", sa.String(length=36), nullable=False),
        sa.Column("tenant_id", sa.String(length=36), nullable=False),
        sa.Column("subject_id", sa.String(length=36), nullable=False),
        sa.Column("name", sa.String(length=200), nullable=False),
        sa.Column("capture_ids", sa.JSON(), nullable=False),
        sa.Column("steps", sa.JSON(), nullable=False),
        sa.Column("options", sa.JSON(), nullable=False),
        sa.Column("priority", sa.Integer(), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("error", sa.JSON()),
        sa.Column("cancel", sa.JSON()),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("finished_at", sa.DateTime(timezone=True)),
        sa.ForeignKeyConstraint(["tenant_id"], ["tenants.id"]),
        sa.ForeignKeyConstraint(["subject_id"], ["subjects.id"], ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("id"),
    )
    for column_name in ("tenant_id", "subject_id", "state"):
        op.create_index(f"ix_batches_{column_name}", "batches", [column_name])


def downgrade() -> None:
    """Take back."""
    op.drop_table("batches")
    for name in ("slots", "threads", "memory_mb", "kinds", "version", "host"):
        op.drop_column("workers", name)
    op.drop_index("ix_job_events_job_id", "job_events")
    op.create_index("ix_job_events_job_id", "job_events", ["job_id"])
    op.create_index("ix_jobs_state_queue", "jobs", ["state", "queue", "created_at"])
    for name in ("claim", "batch_id", "parent_id"):
        op.drop_index(f"ix_jobs_{name}", "jobs")
    for name in (
        "no_room_since",
        "not_before",
        "lost",
        "memory_mb",
        "priority",
        "batch_id",
        "parent_id",
    ):
        op.drop_column("jobs", name)
