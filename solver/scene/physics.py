"""A scene's ``material``, ``contact``, ``sliding`` and ``activation_model``: what flesh is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from solver.contact.potentials import contact_potentials
from solver.edits.edited import Edited
from solver.fitting.face import Face
from solver.mechanics.flesh import (
    COROTATED_DET,
    COROTATED_TRACE,
    IDENTITY,
    NEO_HOOKEAN,
    Material,
)
from solver.mechanics.linear import fastest
from solver.mechanics.potential import Potential
from solver.simulation.fibres import fibre_activations, nearest_fibre
from solver.surface import Floats, Surface

LAWS: Mapping[str, Material] = {
    "corotated_trace": COROTATED_TRACE,
    "corotated_det": COROTATED_DET,
    "neo_hookean": NEO_HOOKEAN,
}
FITTED_LAW = "corotated_trace"
"""The law that rigs are fitted with: their activations lead to their poses."""
STIFFNESS_PA = 3000.0
"""mu of facial soft tissue: a Young's modulus of 7.5 kPa, and of 8.6 by the other two laws."""


@dataclass(frozen=True)
class Physics:
    """What a scene's flesh is made of, and what it meets.

    ``material`` is in Pa. Flesh slides on the skull with ``sliding``; ``lips`` is contact of skin
    with itself, ``teeth`` of lips with teeth, ``eyes`` of lids with eyeballs, ``friction`` its
    coefficient. With ``fibre_muscles`` these contract along their fibres only
    (:mod:`solver.simulation.fibres`).
    """

    material: Material
    sliding: bool = True
    lips: bool = True
    teeth: bool = True
    eyes: bool = True
    friction: float = 0.0
    fibre_muscles: bool = False

    def face(self, edited: Edited) -> Face:
        """Return an edited person's face."""
        return Face(
            edited.model,
            material=self.material,
            linear=fastest(),
            pinned=not self.sliding,
            stiffness=edited.stiffness,
            growth=edited.growth,
            bones=edited.bones,
        )

    def contacts(self, edited: Edited, objects: Sequence[Surface] = ()) -> list[Potential]:
        """Return what keeps the skin out of itself, of teeth, eyeballs and ``objects``."""
        if not (self.lips or self.teeth or self.eyes or objects):
            return []
        return contact_potentials(
            edited.model,
            self.material.mu,
            unedited=edited.unedited,
            lips=self.lips,
            teeth=self.teeth,
            eyes=self.eyes,
            objects=objects,
            friction=self.friction,
        )

    def activations(self, edited: Edited, a: Floats) -> Floats:
        """Return the activations (n, 6) of the tets for those of the muscles, ``a`` (m, 6)."""
        S = edited.S
        if self.fibre_muscles:
            return fibre_activations(edited.model, S, nearest_fibre(edited.model, S, a))
        return np.ascontiguousarray(S @ np.vstack([IDENTITY, a]))


def physics_of(document: Mapping[str, Any]) -> Physics:
    """Return the physics of a scene that its schema has found good."""
    material, contact = document.get("material", {}), document.get("contact", {})
    law = LAWS[material.get("law", FITTED_LAW)]
    return Physics(
        material=law.in_pascal(material.get("stiffness_pa", STIFFNESS_PA)),
        sliding=document.get("sliding", True),
        lips=contact.get("lips", True),
        teeth=contact.get("teeth", True),
        eyes=contact.get("eyes", True),
        friction=contact.get("friction", 0.0),
        fibre_muscles=document.get("activation_model", "blended") == "fibre",
    )
