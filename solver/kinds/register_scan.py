"""Register a raw scan.

The template's vertices on a raw scan, with a confidence each; an expression is registered from the
subject's registered neutral. Of a scan with colours, an image of them by the template's texture
coordinates.
"""

from typing import Literal

from pydantic import Field

from solver.kinds.kind import FrameOptions, Kind


class RegisterScan(FrameOptions):
    """Options of a registration."""

    texture_size: Literal[1024, 2048, 4096] = Field(
        default=2048, description="pixels of a side of texture.png, where the scan has colours"
    )


KIND = Kind(
    queue="short",
    reads=("capture", "template", "neutral"),
    leaves="registration",
    result="registered.ply",
    folder="registered",
    hands_on=("texture.png",),
    options=RegisterScan,
)
