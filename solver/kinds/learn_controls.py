"""Learn a rig's controls.

Mixtures of the template's shapes are fitted exactly, and what makes them is learned, so that
recordings play by what the face would do instead of by a blend of single shapes. Later animations
of the rig use it.
"""

from typing import Literal

from pydantic import Field

from solver.kinds.document import Whole
from solver.kinds.kind import JobOptions, Kind


class LearnControls(JobOptions):
    """Options of learned controls."""

    seed: Whole = Field(
        default=0,
        ge=0,
        le=2**32 - 1,
        description="of the mixtures and the network: the same seed gives the same controls",
    )
    pairs: Whole = Field(
        default=6000,
        ge=500,
        le=100_000,
        description="mixtures that are fitted; those of an earlier job of the rig count",
    )
    max_seconds: float = Field(
        default=900.0,
        ge=10,
        le=86_400,
        description="after about so long they are learned from the mixtures that are fitted",
    )
    map: Literal["quadratic+network", "quadratic", "network", "published"] = Field(
        default="quadratic+network",
        description="quadratic+network: between a polynomial and a network, where held-out walks "
        "say; quadratic, network: one alone; published: to compare with, four layers of 100 ReLU, "
        "trained as published",
    )
    modes: Whole = Field(
        default=128, ge=16, le=512, description="directions of muscles and jaw that are learned"
    )


KIND = Kind(
    queue="long",
    reads=("rig", "template", "control_pairs"),
    leaves="controls",
    result="controls.npz",
    hands_on=("controls.npz", "control_pairs.npz"),
    options=LearnControls,
)
