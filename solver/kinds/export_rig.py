"""Export a rig.

Writes the rig in the format of another program, by an exporter and its settings.
"""

from pathlib import Path
from pkgutil import iter_modules
from typing import Any, Literal

from pydantic import Field

from solver.kinds.kind import JobOptions, Kind

# Names of the exporters: each module of solver/rig/exporters is one, and is not imported here.
FORMATS = tuple(
    each.name for each in iter_modules([str(Path(__file__).parents[1] / "rig" / "exporters")])
)


class ExportRig(JobOptions):
    """Options of an export."""

    format: Literal[FORMATS] = Field(  # type: ignore[valid-type]
        default="glb", description="exporter, see docs/develop/add-an-exporter.md"
    )
    file: str | None = Field(
        default=None,
        max_length=100,
        pattern=r"^\w[\w.-]*$",
        description="name of the file; null: the exporter's own",
    )
    settings: dict[str, Any] = Field(default={}, description="the exporter's options, by name")


KIND = Kind(queue="short", reads=("rig",), leaves="export", options=ExportRig)
