"""Raw scans, takes of markers and performances: what they hold, and what is wrong with them."""

from __future__ import annotations

from solver.anatomy.data import read_table


def read_advice(about: str) -> dict[str, str]:
    """Return code -> advice of the findings about a ``scan``, a ``take`` or its ``markers``."""
    rows = read_table("advice", package=__name__)
    return {row["code"]: row["advice"] for row in rows if row["about"] == about}
