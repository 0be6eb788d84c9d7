"""Edits of a person's anatomy in a scene, by maps on the skin and at places."""

from typing import Annotated, Literal

from pydantic import Discriminator, Field, Tag

from solver.kinds.document import Document, Place, Vector, by_member, find_kind, tell_forms


class AssetMap(Document):
    """A map in a file."""

    asset: str = Field(description="an NPY file with a number for every skin vertex")


class RegionMap(Document):
    """A map of whole regions."""

    regions: list[str] = Field(
        min_length=1, max_length=64, description="regions of the template, such as cheeks"
    )


class SpotMap(Document):
    """A map of soft round spots."""

    spots: list[Place] = Field(min_length=1, max_length=64, description="their centres")
    radius_mm: float = Field(ge=0.001, le=200)


SkinMap = Annotated[
    Annotated[AssetMap, Tag("<asset>")]
    | Annotated[RegionMap, Tag("<regions>")]
    | Annotated[SpotMap, Tag("<spots>")],
    tell_forms(
        by_member("asset", "regions", "spots"),
        "is not null or an object with asset, regions or spots",
    ),
]
Everywhere = Field(
    default=None,
    description="where on the skin, from 0 (not at all) to 1 (wholly); null is everywhere",
)


class FatEntry(Document):
    """Fatter or slimmer: in the face's fat compartments, or where a map says."""

    kind: Literal["fat"]
    f_min: float = Field(ge=0.6, le=1.5, description="by which muscle grows in length")
    f_max: float = Field(ge=0.6, le=1.5, description="by which passive flesh grows in length")
    softening: float = Field(
        default=3.0, ge=0, le=10, description="flesh that grows by f gets softer by f to this power"
    )
    sex: Literal["female", "male", None] = Field(
        default=None, description="whose compartments change; null: the mean of both"
    )
    map: SkinMap | None = Field(
        default=None,
        description="where on the skin, from 0 (not at all) to 1 (wholly); null is the fat "
        "compartments of the face",
    )


class Stop(Document):
    """A point of a needle's path."""

    at: Place
    depth_mm: float = Field(default=0.0, ge=0, le=50, description="under the skin")


class FillerEntry(Document):
    """Filler along the path of a needle."""

    kind: Literal["filler"]
    path: list[Stop] = Field(min_length=1, max_length=64)
    ml: float = Field(ge=0.001, le=100)
    radius_mm: float = Field(
        default=2.5, ge=0.001, le=50, description="how far it spreads from the path"
    )


class BoneEntry(Document):
    """A part of a bone, moved."""

    kind: Literal["bone"]
    bone: Literal["cranium", "mandible"]
    at: Place
    radius_mm: float = Field(ge=0.001, le=200)
    move_mm: Vector


class FactorEntry(Document):
    """A property of the flesh, scaled."""

    factor: float = Field(ge=0.01, le=100, description="of the flesh's own, where the map is 1")
    map: SkinMap | None = Everywhere


class StiffnessEntry(FactorEntry):
    """Stiffer or softer."""

    kind: Literal["stiffness"]


class DensityEntry(FactorEntry):
    """Heavier or lighter."""

    kind: Literal["density"]


class ParalysisEntry(Document):
    """Muscles, or a side, that contract less."""

    kind: Literal["paralysis"]
    muscles: Annotated[list[str], Field(min_length=1, max_length=256)] | None = Field(
        default=None, description="their names; null: all of them"
    )
    side: Literal["left", "right", None] = Field(
        default=None, description="the subject's own; null: both"
    )
    strength: float = Field(default=0.0, ge=0, le=1, description="what is left of the muscles")


Edit = Annotated[
    Annotated[FatEntry, Tag("<fat>")]
    | Annotated[FillerEntry, Tag("<filler>")]
    | Annotated[BoneEntry, Tag("<bone>")]
    | Annotated[StiffnessEntry, Tag("<stiffness>")]
    | Annotated[DensityEntry, Tag("<density>")]
    | Annotated[ParalysisEntry, Tag("<paralysis>")],
    Discriminator(find_kind),
]
Edits = Annotated[
    list[Edit], Field(max_length=32, description="of the anatomy, made one after the other")
]
