"""Quotas of tenants, the audit log, answered requests and receipts of deletions."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"

QUOTAS = {"max_bytes": sa.BigInteger(), "max_queued": sa.Integer(), "max_running": sa.Integer()}
MOMENT = sa.DateTime(timezone=True)


def upgrade() -> None:
    """Apply."""
    for name, kind in QUOTAS.items():
        op.add_column("tenants", sa.Column(name, kind))
    op.create_table(
        "audit",
        sa.Column("id", sa.String(length=36), nullable=False),
        _tenant(),
        sa.Column("created_at", MOMENT, nullable=False),
        sa.Column("key_id", sa.String(length=12), nullable=False),
        sa.Column("request_id", sa.String(length=64), nullable=False),
        sa.Column("action", sa.String(length=64), nullable=False),
        sa.Column("object_id", sa.String(length=36), nullable=False),
        sa.ForeignKeyConstraint(["tenant_id"], ["tenants.id"]),
        sa.PrimaryKeyConstraint("id"),
    )
    for column in ("tenant_id", "created_at", "object_id"):
        op.create_index(f"ix_audit_{column}", "audit", [column])
    op.create_table(
        "answered_requests",
        _tenant(),
        sa.Column("key", sa.String(length=255), nullable=False),
        sa.Column("fingerprint", sa.String(length=64), nullable=False),
        sa.Column("object_id", sa.String(length=36), nullable=False),
        sa.Column("created_at", MOMENT, nullable=False),
        sa.ForeignKeyConstraint(["tenant_id"], ["tenants.id"]),
        sa.PrimaryKeyConstraint("tenant_id", "key"),
    )
    op.create_index("ix_answered_requests_created_at", "answered_requests", ["created_at"])
    op.create_table(
        "deletions",
        sa.Column("id", sa.String(length=36), nullable=False),
        _tenant(),
        sa.Column("kind", sa.String(length=16), nullable=False),
        sa.Column("object_id", sa.String(length=36), nullable=False),
        sa.Column("reason", sa.String(length=16), nullable=False),
        sa.Column("files", sa.JSON(), nullable=False),
        sa.Column("created_at", MOMENT, nullable=False),
        sa.Column("rows_at", MOMENT),
        sa.Column("files_at", MOMENT),
        sa.ForeignKeyConstraint(["tenant_id"], ["tenants.id"]),
        sa.PrimaryKeyConstraint("id"),
    )
    for column in ("tenant_id", "files_at"):
        op.create_index(f"ix_deletions_{column}", "deletions", [column])


def downgrade() -> None:
    """Take back."""
    for table in ("deletions", "answered_requests", "audit"):
        op.drop_table(table)
    with op.batch_alter_table("tenants") as batch:
        for name in QUOTAS:
            batch.drop_column(name)


def _tenant() -> sa.Column[str]:
    return sa.Column("tenant_id", sa.String(length=36), nullable=False)
