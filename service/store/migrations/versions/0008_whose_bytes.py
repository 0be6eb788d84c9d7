"""Sizes of landmarks and frames, what an upload was used for, and tenants' own retention."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"

# Of two uses of the same bytes either will do: the file stays until both are gone. A query for
# each column, so that its index serves; `|| ''` keeps SQLite from that of the tenants.
WHAT_IT_BECAME = """
    UPDATE uploads SET used_by = COALESCE(
        (SELECT min(id) FROM captures WHERE captures.sha256 = uploads.sha256
            AND captures.tenant_id || '' = uploads.tenant_id),
        (SELECT min(id) FROM captures WHERE captures.landmarks_sha256 = uploads.sha256
            AND captures.tenant_id || '' = uploads.tenant_id),
        (SELECT min(id) FROM templates WHERE templates.tenant_id = uploads.tenant_id
            AND uploads.sha256 = templates.sha256)
    ) WHERE complete
"""
RETENTION = ("retain_subjects", "retain_scans", "retain_jobs", "retain_rigs")


def upgrade() -> None:
    """Apply."""
    # empty for what is there: only the file store knows them, and the sweeper asks it
    op.add_column("captures", sa.Column("landmarks_size", sa.BigInteger()))
    op.add_column("job_frames", sa.Column("size", sa.BigInteger()))
    op.add_column("uploads", sa.Column("used_by", sa.String(length=36)))
    op.execute(sa.text(WHAT_IT_BECAME))
    op.create_index("ix_uploads_used_by", "uploads", ["used_by"])
    for name in RETENTION:
        op.add_column("tenants", sa.Column(name, sa.Integer()))


def downgrade() -> None:
    """Take back."""
    for name in RETENTION:
        op.drop_column("tenants", name)
    op.drop_index("ix_uploads_used_by", "uploads")
    op.drop_column("uploads", "used_by")
    op.drop_column("job_frames", "size")
    op.drop_column("captures", "landmarks_size")
