"""Assessment of a scan part by part: those that a check could judge, and those it could not.

A finding says what is wrong; where there is none, these words tell a part that is right from one
that nobody looked at.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from solver.meshio.raw import RawScan
from solver.model import SIZE_WORDS
from solver.registration.locate import Location
from solver.scans.cover import Cover
from solver.scans.mouth import Eye, MouthGaps


@dataclass(frozen=True)
class Assessment:
    """A part of a scan, and whether it was judged."""

    about: str
    judged: bool
    words: str

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain JSON values."""
        return asdict(self)


@dataclass(frozen=True)
class FaceDetail:
    """Cover, roughness, mouth and eyes of the face in a scan."""

    cover: Cover
    noise_mm: float  # NaN in a scan too coarse to tell
    spacing_mm: float
    mouth: MouthGaps
    eyes: dict[str, Eye]


def assess(
    scan: RawScan, place: Location, detail: FaceDetail, *, marked: bool
) -> Iterator[Assessment]:
    """Yield the parts of a scan; ``marked`` says whether it has landmarks."""
    size = place.size
    words = f"read {size.unit.words}, {size.words}" if size.is_known else SIZE_WORDS["template"]
    yield Assessment("size", size.is_known, words)
    share = detail.cover.share()
    yield Assessment("cover", True, f"{share:.1%} of the face is in the scan")
    is_dense = not np.isnan(detail.noise_mm)
    spaced = f"a vertex every {detail.spacing_mm:.1f} mm on the face"
    noise = f"{detail.noise_mm:.2f} mm, {spaced}" if is_dense else f"{spaced} is too few to tell"
    yield Assessment("noise", is_dense, noise)
    yield _eyes(detail.eyes)
    yield from _mouth(detail.mouth)
    tells = marked or (scan.normals is not None and len(scan.faces) > 0)
    words = "by the landmarks" if marked else "by the stored normals"
    unknown = "without stored normals or landmarks a mirrored face looks like another person's"
    yield Assessment("mirroring", tells, words if tells else unknown)


def _eyes(eyes: dict[str, Eye]) -> Assessment:
    unseen = {side: eye for side, eye in eyes.items() if eye.closed is None}
    if not eyes:
        return Assessment("eyes", False, "the template does not name their corners")
    if not unseen:
        shut = [side for side, eye in eyes.items() if eye.closed]
        words = "open" if not shut else "closed" if len(shut) == 2 else f"the {shut[0]} one closed"
        return Assessment("eyes", True, words)
    which = "both" if len(unseen) == 2 else f"the {next(iter(unseen))} one"
    return Assessment("eyes", False, f"{which}: {next(iter(unseen.values())).why_not}")


def _mouth(mouth: MouthGaps) -> Iterator[Assessment]:
    if mouth.lips_mm is None:
        yield Assessment("lips", False, mouth.why_not)
    else:
        words = f"{mouth.lips_mm:.0f} mm apart" if mouth.lips_mm else "closed"
        yield Assessment("lips", True, words)
    if mouth.teeth_mm is not None:
        yield Assessment("teeth", True, f"{mouth.teeth_mm:.0f} mm apart")
    else:
        words = "between the lips" if mouth.is_open else "behind closed lips"
        yield Assessment("teeth", False, f"{words} it does not show whether they are apart")
