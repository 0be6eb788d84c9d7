"""What a check of a scan could judge and what it could not, in words.

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
from solver.scans.mouth import Eye, Mouth


@dataclass(frozen=True)
class Judged:
    """A part of a scan, and whether it was judged."""

    about: str
    judged: bool
    words: str

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain JSON values."""
        return asdict(self)


@dataclass(frozen=True)
class Looked:
    """What a close look at a face saw."""

    cover: Cover
    noise_mm: float  # NaN in a scan too coarse to tell
    spacing_mm: float
    mouth: Mouth
    eyes: dict[str, Eye]


def judged(scan: RawScan, place: Location, looked: Looked, *, marked: bool) -> Iterator[Judged]:
    """Yield what was judged; ``marked`` says whether the scan has landmarks."""
    size = place.size
    words = f"read {size.unit.words}, {size.words}" if size.is_known else SIZE_WORDS["template"]
    yield Judged("size", size.is_known, words)
    share = looked.cover.share()
    yield Judged("cover", True, f"{share:.1%} of the face is in the scan")
    is_dense = not np.isnan(looked.noise_mm)
    spaced = f"a vertex every {looked.spacing_mm:.1f} mm on the face"
    noise = f"{looked.noise_mm:.2f} mm, {spaced}" if is_dense else f"{spaced} is too few to tell"
    yield Judged("noise", is_dense, noise)
    yield _eyes(looked.eyes)
    yield from _mouth(looked.mouth)
    tells = marked or (scan.normals is not None and len(scan.faces) > 0)
    words = "by the landmarks" if marked else "by the stored normals"
    unknown = "without stored normals or landmarks a mirrored face looks like another person's"
    yield Judged("mirroring", tells, words if tells else unknown)


def _eyes(eyes: dict[str, Eye]) -> Judged:
    unseen = {side: eye for side, eye in eyes.items() if eye.closed is None}
    if not eyes:
        return Judged("eyes", False, "the template does not name their corners")
    if not unseen:
        shut = [side for side, eye in eyes.items() if eye.closed]
        words = "open" if not shut else "closed" if len(shut) == 2 else f"the {shut[0]} one closed"
        return Judged("eyes", True, words)
    which = "both" if len(unseen) == 2 else f"the {next(iter(unseen))} one"
    return Judged("eyes", False, f"{which}: {next(iter(unseen.values())).why_not}")


def _mouth(mouth: Mouth) -> Iterator[Judged]:
    if mouth.lips_mm is None:
        yield Judged("lips", False, mouth.why_not)
    else:
        words = f"{mouth.lips_mm:.0f} mm apart" if mouth.lips_mm else "closed"
        yield Judged("lips", True, words)
    if mouth.teeth_mm is not None:
        yield Judged("teeth", True, f"{mouth.teeth_mm:.0f} mm apart")
    else:
        words = "between the lips" if mouth.is_open else "behind closed lips"
        yield Judged("teeth", False, f"{words} it does not show whether they are apart")
