"""What workers lack to find faces in pictures."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0016"
down_revision = "0015"


def upgrade() -> None:
    """Apply."""
    op.add_column("workers", sa.Column("lacks", sa.JSON()))


def downgrade() -> None:
    """Take back."""
    op.drop_column("workers", "lacks")
