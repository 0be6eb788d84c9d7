"""Muscle drives: what the numbers of the muscles are, and what they do to the flesh.

A drive is one module with one class. :mod:`.six_numbers` is the published one, six numbers a muscle
that S blends; :mod:`.admissible` keeps these to what muscles can make; :mod:`.fibre_muscles` has
muscles that pull along their fibres. ``docs/develop/add-a-control.md`` adds one. :mod:`.stored`
writes any of them to a file and reads it back.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, is_dataclass
from typing import Any, ClassVar, Protocol, get_type_hints

import scipy.sparse as sp

from solver.errors import Finding
from solver.fitting.controls import Block
from solver.fitting.interior_point import FeasibleSet
from solver.fitting.tet_forces import MuscleRates, TetForces
from solver.mechanics.flesh import Flesh
from solver.model import SubjectModel
from solver.surface import Floats


@dataclass(frozen=True)
class ContractionMap:
    """Contractions of m muscles by their values: c_j = rates_j . (a_j - rest_j), 0 at rest.

    Contraction is the part of their length that fibres lose, of fibre muscles the activation.
    """

    rates: Floats  # (m, k) of the k values of each muscle; NaN without fibres
    volumes: Floats  # (m,) mm^3, by which compartments count in a whole muscle


class MuscleDrive(Protocol):
    """A kind of control of the muscles; it holds no state of a fit.

    Files call it by its ``name``: that of the class in small letters, or what the class statement
    says, as in ``class SixNumbers(MuscleDrive, name="free")``.
    """

    name: ClassVar[str] = ""

    def __init_subclass__(cls, *, name: str = "", **others: Any) -> None:
        """Name the drive of a class."""
        super().__init_subclass__(**others)
        cls.name = name or cls.__name__.lower()

    def block(self, model: SubjectModel, flesh: Flesh, S: sp.csr_array) -> Block:
        """Return the block of its values: rest, bounds, units, and the price of shapes."""

    def attach(self, flesh: Flesh) -> Flesh:
        """Return a flesh that is driven by :meth:`controls`, from one driven by activations."""

    def controls(self, S: sp.csr_array, a: Floats) -> Floats:
        """Return what drives the flesh for values ``a``, in the shape of the block's rest."""

    def rates(self, forces: TetForces) -> MuscleRates:
        """Return the forces' derivative by the values."""

    def feasible(self, model: SubjectModel, volumes: Floats, S: sp.csr_array) -> FeasibleSet | None:
        """Return the set that the values stay in, None if there is none but the block's box.

        ``volumes`` (n,) are the tets' at rest.
        """
        return None

    def contraction_map(
        self, model: SubjectModel, volumes: Floats, S: sp.csr_array
    ) -> ContractionMap | None:
        """Return the muscles' contractions by their values; None where these do not tell them.

        ``volumes`` (n,) are the tets' at rest.
        """
        return None

    def loosen(self, part: float) -> MuscleDrive | None:
        """Return the drive with its bounds ``part`` of the way to none that bind; 0 is the same.

        None for one that free activations cannot be brought into step by step: it has no bounds, or
        its values are others.
        """
        return None

    def lacks(self, model: SubjectModel) -> list[Finding]:
        """Return warnings of what a model does not have, so that the drive cannot do its part."""
        return []

    def settings(self) -> dict[str, Any]:
        """Return what a file keeps of the drive, as JSON values: by default its fields.

        These have to be JSON values, or dataclasses of them.
        """
        assert is_dataclass(self)
        return asdict(self)

    @classmethod
    def restored(
        cls,
        settings: Mapping[str, Any],
        model: SubjectModel,  # noqa: ARG003 - of drives with more than settings
        S: sp.csr_array,  # noqa: ARG003
    ) -> MuscleDrive:
        """Return the drive with such :meth:`settings`, of the muscles of a model with S."""
        kinds = get_type_hints(cls)
        return cls(
            **{
                name: kinds[name](**value) if is_dataclass(kinds[name]) else value
                for name, value in settings.items()
            }
        )


def are_fibres(activations: Floats) -> bool:
    """Tell whether frames' stored activations (f, m) are of fibre muscles; S has (f, m, 6)."""
    return activations.ndim == 2
