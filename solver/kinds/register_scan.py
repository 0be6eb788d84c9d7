"""Register a raw scan.

The template's vertices on a raw scan, with a confidence each; an expression is registered from the
subject's registered neutral. Of a scan with colours, an image of them by the template's texture
coordinates; of one that is finer than the template, a normal map and a map of displacement, and of
an expression the wrinkles that the neutral does not have.
"""

from typing import Literal

from pydantic import Field

from solver.kinds.kind import FrameOptions, Kind


class RegisterScan(FrameOptions):
    """Options of a registration."""

    texture_size: Literal[1024, 2048, 4096] = Field(
        default=2048,
        description="pixels of a side of texture.png, where the scan has colours, and of "
        "normals.png, where it is finer than the template",
    )
    colours: Literal["srgb", "linear"] = Field(
        default="srgb",
        description="how an OBJ or PLY has the colours of its vertices: as images have them, or in "
        "linear light; a GLB's are linear always, and images sRGB",
    )
    detail_width_mm: float = Field(
        default=25.0,
        ge=5,
        le=100,
        description="waves of this length count half as detail, shorter ones whole: longer ones "
        "are the mesh's own shape, or what registration is off",
    )
    detail_most_mm: float = Field(
        default=1.0,
        ge=0.1,
        le=5,
        description="the highest and the deepest that displacement.png may be",
    )


KIND = Kind(
    queue="short",
    reads=("capture", "template", "neutral", "normals"),
    leaves="registration",
    result="registered.ply",
    folder="registered",
    hands_on=("texture.png", "normals.png", "wrinkle_normals.png"),
    options=RegisterScan,
)
