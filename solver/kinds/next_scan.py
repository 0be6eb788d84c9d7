"""Propose the next scan.

Which muscles the rig's training scans determine, and which expressions of the template would add
most to them, while the person is still in the chair.
"""

from pydantic import Field

from solver.kinds.document import Whole
from solver.kinds.kind import JobOptions, Kind


class NextScan(JobOptions):
    """Options of a proposal."""

    count: Whole = Field(
        default=3, ge=1, le=10, description="expressions to propose, each beside those before it"
    )
    noise_mm: float = Field(
        default=0.5, ge=0.01, le=10, description="error of a coordinate of a scan's point"
    )


KIND = Kind(
    queue="short",
    reads=("rig", "template", "expression_basis"),
    leaves="proposal",
    report="next_scan.json",
    folder="next-scan",
    options=NextScan,
)
