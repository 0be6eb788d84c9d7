"""Places on a person: landmarks, skin vertices, points, and maps painted on the skin.

A place is a landmark's name, the number of a skin vertex, or a point [x, y, z] in mm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from solver.anatomy.template import Template
from solver.edits.changes import spots
from solver.edits.fat_compartments import Sex, fat_map, missing_landmarks
from solver.errors import InputError
from solver.kinds.scene import AssetMap, RegionMap, SkinMap
from solver.model import SubjectModel
from solver.registration.landmarks import landmark_vertices
from solver.storage import map_array
from solver.surface import Floats
from solver.templates.builtin.build import NAME as BUILTIN
from solver.templates.builtin.build import builtin_template

Place = str | int | Sequence[float]


@dataclass(frozen=True)
class Places:
    """A person's places: ``landmarks`` by name are skin vertices, ``assets`` files by name."""

    model: SubjectModel
    landmarks: Mapping[str, int]
    assets: Mapping[str, Path] = field(default_factory=dict)

    @classmethod
    def of(cls, model: SubjectModel, template: Path | None, assets: Mapping[str, Path]) -> Places:
        """Return the places of a person whose model was made with ``template``.

        None is the built-in template; a person of another one then has no landmarks. Raises
        :class:`InputError` (``scene.template``) for a template of another topology.
        """
        if template is not None:
            anatomy = Template.load(template)
        elif model.template["name"] == BUILTIN:
            anatomy = builtin_template()
        else:
            return cls(model, {}, assets)
        if len(anatomy.skin.vertices) != len(model.skin.vertices):
            own = model.template["name"]
            reason = f"the model was made with the template {own}, not with {anatomy.name}"
            raise InputError("scene.template", reason, expected=own, found=anatomy.name)
        return cls(model, landmark_vertices(anatomy), assets)

    def vertex(self, place: Place) -> int:
        """Return the skin vertex at or nearest to a place.

        Raises :class:`InputError`: ``scene.landmark`` or ``scene.vertex`` for one that is not.
        """
        count = len(self.model.skin.vertices)
        if isinstance(place, str):
            if place not in self.landmarks:
                known = sorted(self.landmarks)
                listed = ", ".join(known) or "none without the template of the model"
                reason = f"there is no landmark {place!r}; there are {listed}"
                raise InputError("scene.landmark", reason, found=place, expected=known)
            return self.landmarks[place]
        if isinstance(place, int):
            if not 0 <= place < count:
                reason = f"the skin has the vertices 0 to {count - 1}, not {place}"
                raise InputError("scene.vertex", reason, found=place, expected=count)
            return place
        away = np.linalg.norm(self.model.skin.vertices - np.array(place, np.float64), axis=1)
        return int(np.argmin(away))

    def point(self, place: Place) -> Floats:
        """Return the point (3,) of a place, at rest; raises as :meth:`vertex`."""
        if isinstance(place, str | int):
            return np.asarray(self.model.skin.vertices[self.vertex(place)])
        return np.array(place, np.float64)

    def asset(self, name: str) -> Path:
        """Return the file of an asset; raises ``scene.asset`` if the job was given none."""
        if name not in self.assets:
            known = sorted(self.assets)
            given = ", ".join(known) or "none"
            reason = f"the job was given no asset {name!r}; it was given {given}"
            raise InputError("scene.asset", reason, found=name, expected=known)
        return self.assets[name]

    def map_of(self, given: SkinMap | None) -> Floats | None:
        """Return a map (V,) on the skin: of an asset, of ``regions``, or of ``spots``.

        None is no map. Raises ``scene.region``, ``scene.map`` and as :meth:`vertex`.
        """
        if given is None:
            return None
        if isinstance(given, AssetMap):
            return self._file(self.asset(given.asset))
        if isinstance(given, RegionMap):
            return self._regions(given.regions)
        centres = np.array([self.point(place) for place in given.spots])
        return spots(self.model, centres.reshape(-1, 3), given.radius_mm)

    def fat_map(self, *, gain: bool, sex: Sex | None = None) -> Floats:
        """Return the map (V,) of the fat compartments, not for :attr:`without_compartments`."""
        return fat_map(self.model, self.landmarks, gain=gain, sex=sex)

    @property
    def without_compartments(self) -> str | None:
        """Return why fat changes everywhere alike; None where it has its compartments."""
        missing = missing_landmarks(self.landmarks)
        if not missing:
            return None
        listed = "" if not self.landmarks else f", which lacks {', '.join(missing)}"
        return f"fat changes everywhere alike: compartments need landmarks of the template{listed}"

    def _file(self, path: Path) -> Floats:
        try:
            return np.array(map_array(path), dtype=np.float64)
        except (OSError, ValueError) as error:
            reason = f"{path.name} is not an NPY file of numbers: {error}"
            raise InputError("scene.map", reason, file=path.name) from error

    def _regions(self, names: Sequence[str]) -> Floats:
        regions = self.model.regions
        for name in names:
            if name not in regions:
                reason = f"the subject has no region {name!r}; it has {', '.join(regions)}"
                raise InputError("scene.region", reason, found=name, expected=list(regions))
        vertices = [np.zeros(0, np.int64), *(regions[name] for name in names)]
        numbers = np.arange(len(self.model.skin.vertices))
        return np.isin(numbers, np.concatenate(vertices)).astype(np.float64)
