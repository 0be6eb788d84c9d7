"""Build muscle tracks.

Carries the template's expressions into the flesh of a subject's model, once: scenes and recordings
then drive the face by the weights of these shapes, without a rig's expressions solved first.
Registered scans that are chosen become shapes of the subject's own: what the best sum of the
template's shapes leaves of each.
"""

from typing import Annotated, Literal

from pydantic import Field

from solver.kinds.kind import JobOptions, Kind


class BuildTracks(JobOptions):
    """Options of muscle tracks."""

    bones: Literal["free", "held"] = Field(
        default="free",
        description="free: shapes run on into the bones, as published; held: they end there",
    )
    length_mm: float = Field(
        default=1.0,
        ge=0.1,
        le=20,
        description="how far from where its shape wants it a muscle is held as stiffly as by its "
        "own flesh: less follows shapes more closely, more keeps the lips' volume better",
    )
    stiffness: dict[str, Annotated[float, Field(ge=0, le=1000)]] = Field(
        default={},
        max_length=256,
        description="factors on how firmly muscles are held, by name; a whole muscle's is that of "
        "all its compartments",
    )
    law: Literal["corotated_trace", "corotated_det", "neo_hookean", "mooney_rivlin"] = Field(
        default="corotated_det",
        description="of the flesh between tracks: corotated_det keeps volumes, corotated_trace is "
        "what rigs are fitted with",
    )


KIND = Kind(
    queue="short",
    reads=("model", "template", "own_scans"),
    leaves="tracks",
    result="tracks.npz",
    hands_on=("tracks.npz",),
    options=BuildTracks,
)
