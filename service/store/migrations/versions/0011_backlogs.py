"""Indexes by which a claim, a place and a delivery are found without reading the whole backlog."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"

BEFORE = ["queue", "state", "tenant_id", "priority", "created_at"]


def upgrade() -> None:
    """Apply."""
    op.drop_index("ix_jobs_claim", "jobs")
    first = ("queue", "state", "tenant_id", sa.text("priority DESC"), "created_at", "id")
    op.create_index("ix_jobs_claim", "jobs", list(first))
    op.drop_index("ix_deliveries_webhook_id", "deliveries")
    op.create_index("ix_deliveries_turn", "deliveries", ["webhook_id", "state", "next_at"])
    op.create_index("ix_deliveries_under_way", "deliveries", ["state", "lease_until"])


def downgrade() -> None:
    """Take back."""
    op.drop_index("ix_deliveries_under_way", "deliveries")
    op.create_index("ix_deliveries_webhook_id", "deliveries", ["webhook_id"])
    op.drop_index("ix_deliveries_turn", "deliveries")
    op.drop_index("ix_jobs_claim", "jobs")
    op.create_index("ix_jobs_claim", "jobs", BEFORE)
