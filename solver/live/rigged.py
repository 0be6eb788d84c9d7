"""What a live session needs of a rig: its flesh, reduced skin, and what values mean for muscles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import structlog
from numpy.typing import NDArray

from solver.anatomy.skin_points import SkinPoints
from solver.anatomy.template import ShapeBasis, Template
from solver.animation.controls import Controls
from solver.errors import InputError
from solver.fitting.contraction import Contraction
from solver.fitting.drives.admissible import ADMISSIBLE
from solver.fitting.drives.stored import are_same
from solver.fitting.expression_basis import FILE as BASIS_FILE
from solver.fitting.expression_basis import OTHER, ExpressionBasis
from solver.fitting.face import Face, Pose
from solver.fitting.target_checks import check_held
from solver.kinds.live_session import Source
from solver.live.landmarks import LiveLandmarks
from solver.live.markers import LiveMarkers
from solver.live.points import LivePoints
from solver.live.skin import FILE, LIVE_SKIN, TOLERANCE, LiveSkin, LiveSkinOptions, SkinProjection
from solver.live.source import LiveSource
from solver.live.weights import LiveWeights
from solver.mechanics.boundary import five_numbers
from solver.mechanics.linear import fastest
from solver.photo.mesh_points import landmark_points
from solver.rig import Rig
from solver.rig.preview import Listener
from solver.scans.markers.places.marker_set import MarkerSet
from solver.storage import copy_whole
from solver.surface import Floats
from solver.templates.builtin.build import builtin_template

log = structlog.get_logger(__name__)


@dataclass(frozen=True, eq=False)
class LiveFace:
    """A rig with its reduced skin; ``controls`` are what was learned of it, if it was."""

    rig: Rig
    face: Face
    skin: LiveSkin
    expressions: ExpressionBasis
    points: SkinPoints  # landmarks of the template
    controls: Controls | None = None

    def pose(self, values: Floats) -> Pose:
        """Return activations and jaw for values (s,), as learned if they were."""
        if self.controls is None:
            return self.skin.sliders.pose(values)
        found = self.controls.pose_of(self._weights(values), self.rig.limits)
        return self.face.pose_of(found.a, found.jaw)

    def amounts(self, values: Floats, *, learned: bool = False) -> Floats:
        """Return the amounts (r,) of the skin's modes, ``learned`` ones where there are some."""
        if not learned or self.controls is None:
            return self.skin.amounts(values)
        rest, modes = self._learned
        return np.asarray(rest + modes @ self.controls.skin_coordinates(self._weights(values)))

    def skin_of(self, amounts: Floats) -> Floats:
        """Return the skin (n, 3) in the head's frame."""
        return np.asarray(self.rig.model.skin.vertices + np.tensordot(amounts, self.skin.basis, 1))

    def contractions(self, values: Floats) -> Floats:
        """Return how much each muscle is shortened along its fibres, (m,), 0 without fibres.

        They are kept within what fibres can, not the muscles within all bounds: that takes longer
        than a frame may.
        """
        if self.controls is None:
            rest, rates = self._contraction_rates
            found = rest + rates @ values
        else:
            found = self._contraction(self.controls.pose(self._weights(values)).a)
        return np.nan_to_num(np.clip(found, 1.0 - ADMISSIBLE.fibre, 1.0 - ADMISSIBLE.shortest))

    def jaw(self, values: Floats, *, learned: bool = False) -> Floats:
        """Return the free jaw (5,) that the skin of :meth:`amounts` has, ``learned`` or not."""
        if learned and self.controls is not None:
            return self.controls.pose(self._weights(values)).b
        b = self.skin.sliders.jaw_numbers(values)
        return five_numbers(self.rig.model.jaw, self.face.jaw.matrix(b))

    @cached_property
    def project(self) -> SkinProjection:
        """What finds the amounts of a skin."""
        return SkinProjection(self.rig.model, self.skin.basis)

    @cached_property
    def _contraction(self) -> Contraction:
        found = Contraction.of_face(self.face)
        assert found is not None, "the muscles of a rig are blended by S"
        return found

    @cached_property
    def _contraction_rates(self) -> tuple[Floats, Floats]:
        """The contractions (m,) at rest, and their derivative (m, s) by the values."""
        sliders = self.skin.sliders
        own = sliders.rest.layout["activations"]
        rest = self._contraction(sliders.rest.a)
        changed = sliders.rest.a + sliders.directions[own].T.reshape(-1, *sliders.rest.a.shape)
        return rest, (self._contraction(changed) - rest).T

    @cached_property
    def _learned(self) -> tuple[Floats, Floats]:
        """Amounts (r,) of the learned skin at rest, and (r, k) of its modes."""
        assert self.controls is not None
        skin = self.controls.skin_modes
        still = self.rig.model.skin.vertices
        modes = skin.modes.reshape(len(skin.modes), -1, 3).astype(np.float64)
        return self.project(skin.rest.astype(np.float64)), np.array(
            [self.project(still + mode) for mode in modes]
        ).T

    @cached_property
    def _places(self) -> list[int]:
        """Where each weight of the controls is among the values, -1 for one that is not."""
        assert self.controls is not None
        known = {name: number for number, name in enumerate(self.skin.names)}
        return [known.get(name, -1) for name in self.controls.names]

    def _weights(self, values: Floats) -> Floats:
        return np.append(values, 0.0)[self._places]

    def source(self, kind: Source, markers: MarkerSet | None = None) -> LiveSource:
        """Return what follows the face by frames of a kind; ``markers`` need their set."""
        model = self.rig.model
        about = (model, self.skin.sliders, self.skin.reduced)
        if kind == "weights":
            return LiveWeights(model, self.skin.names)
        if kind == "points":
            return LivePoints(*about)
        if kind == "landmarks":
            return LiveLandmarks(*about, self.points)
        assert markers is not None, "a session of markers has their set"
        return LiveMarkers(*about, markers)

    @classmethod
    def open(
        cls,
        files: Mapping[str, Path],
        out: Path,
        listen: Listener = lambda _phase, _part: None,
        options: LiveSkinOptions = LIVE_SKIN,
    ) -> LiveFace:
        """Read a rig and what was made of it by the roles of a job's files.

        What is missing of its basis of expressions and its reduced skin, or is of another rig, is
        made, which takes minutes, and left in ``out``. Raises :class:`InputError`
        (``live.no_shapes``) where the template has no expressions of this skin, and as readers do.
        """
        listen("read", 0.0)
        rig = Rig.load(files)
        template = _template(files)
        shapes = _shapes(rig, template)
        face = rig.face(fastest(), TOLERANCE)
        check_held(face)
        basis = _basis(files, out, face, shapes.expressions, listen)
        live = _live_skin(files, out, face, shapes, basis, listen, options)
        controls = None
        if "controls" in files:
            controls = Controls.load(files["controls"], rig.model, rig.weights)
            if not are_same(controls.drive, rig.drive):
                controls = None  # learned by a release with other limits
        return cls(rig, face, live, basis, landmark_points(template), controls)


def _template(files: Mapping[str, Path]) -> Template:
    given = files.get("template")
    return builtin_template() if given is None else Template.load(given)


def _shapes(rig: Rig, template: Template) -> ShapeBasis:
    shapes = template.shapes
    if shapes is None or shapes.expressions.shape[1] != len(rig.model.skin.vertices):
        message = "the template has no expressions of this rig's skin, which a live face is made of"
        raise InputError("live.no_shapes", message)
    return shapes


def _basis(
    files: Mapping[str, Path], out: Path, face: Face, shapes: NDArray[np.floating], listen: Listener
) -> ExpressionBasis:
    """Return the basis that an earlier job or attempt left, else solve it."""
    kept = out / BASIS_FILE
    for path in (kept, files.get("expression_basis")):
        if path is not None and path.is_file():
            try:
                return ExpressionBasis.load(path, face, shapes)
            except InputError as error:
                if error.code != OTHER:
                    raise
                log.warning(error.code, file=path.name, error=error.message)
    found = ExpressionBasis.solve(face, shapes, listen=lambda done: listen("expressions", done))
    found.save(kept, face)
    return found


def _live_skin(
    files: Mapping[str, Path],
    out: Path,
    face: Face,
    shapes: ShapeBasis,
    basis: ExpressionBasis,
    listen: Listener,
    options: LiveSkinOptions,
) -> LiveSkin:
    """Return the reduced skin that an earlier job or attempt left, else make it.

    It is left in ``out`` in any case: what a session sends is told by this file.
    """
    kept = out / FILE
    expressions = shapes.expressions
    for path in (kept, files.get("live_skin")):
        if path is not None and path.is_file():
            found = LiveSkin.load(path, face, expressions)
            if found is not None:
                if path != kept:
                    copy_whole(path, kept)
                return found
    found = LiveSkin.make(face, shapes.expression_names, basis, listen, options)
    found.save(kept, face, expressions)
    return found
