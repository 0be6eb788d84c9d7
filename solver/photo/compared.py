"""How much of the face a photograph was compared with, and how much of that it contradicts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from solver.errors import Finding, make_warning
from solver.photo.camera import PinholeCamera
from solver.photo.shading import CHANNELS, ShadingTerm
from solver.photo.terms import PseudoHuber
from solver.surface import Floats, Ints


@dataclass(frozen=True)
class ComparedOptions:
    """What counts as unexplained, and from where on it is told."""

    # standard deviation of what light and albedo leave of clear skin, by the mean of its colours
    noise: float = 0.1
    least_weight: float = 0.5  # by the loss: a sample that counts for less is unexplained
    # share that is told: without beard or glasses 8 to 19 % of real faces are unexplained, with
    # either 25 % and more
    unexplained: float = 0.2


COMPARED_OPTIONS = ComparedOptions()


@dataclass(frozen=True)
class ComparedSkin:
    """What the shading of one photograph was compared with."""

    share: float  # of the face's visible skin
    # share of these samples that neither light nor albedo explains: glasses, a hand, beard, hair
    unexplained: float
    vertices: Ints  # (k,) of the skin that samples lie at

    @classmethod
    def of(
        cls,
        term: ShadingTerm,
        skin: Floats,
        camera: PinholeCamera,
        loss: PseudoHuber,
        options: ComparedOptions = COMPARED_OPTIONS,
    ) -> ComparedSkin:
        """Return what a term compares of a fitted ``skin`` (V, 3).

        The term's own noise grows with what is unexplained and with the samples that err together,
        so that hardly a residual is large by it: what is counted is large by that of clear skin.
        """
        away = term.noise * term.residual(skin, camera).reshape(-1, CHANNELS)
        noise = options.noise * float(term.seen(skin, camera).mean())
        weights = loss.weights(np.sqrt((away**2).mean(axis=1)) / noise)
        unexplained = float((weights < options.least_weight).mean())
        return cls(term.share, unexplained, np.unique(term.samples.corners))

    def figures(self) -> dict[str, float]:
        """Return the shares as JSON values."""
        return {
            "skin_compared": round(self.share, 3),
            "skin_unexplained": round(self.unexplained, 3),
        }


def find_unexplained(
    name: str, found: ComparedSkin, options: ComparedOptions = COMPARED_OPTIONS
) -> Iterator[Finding]:
    """Yield the warning ``photo.unexplained`` about the photograph ``name``."""
    if found.unexplained > options.unexplained:
        message = (
            f"{name}: {100 * found.unexplained:.0f} % of the skin that was compared do not look as "
            "light and its colours make skin look: glasses, a hand, hair or a beard may hide it"
        )
        about = {"file": name, "share": round(found.unexplained, 3)}
        yield make_warning("photo.unexplained", message, about)
