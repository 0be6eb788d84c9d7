"""Tracks of a person's muscles: targets of every muscle for any weights of shapes and any jaw.

For weights w (K,) and a jaw j (5,), b = j + sum_k w_k b_k, the target of the flesh is

    M(w, j) = (1 - o) Y + o J(b) Y,    Y(w) = X_0 + sum_k w_k X_k

The morph X_k carries a shape without its jaw, B_k on the skin, into the flesh:

    min_X  1/2 int |grad X|^2 + weight / 2 |E X - B_k|^2

over the tets, E being the skin's embedding in them; nothing is asked for at bones, or X = 0 there
with bones that are held. That is linear, so the morph of a sum of shapes is the sum of their
morphs, and one factorisation has them all.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import scipy.sparse as sp

from solver.errors import InputError, quote
from solver.fitting.simplex import mix_by_stiffness
from solver.fitting.stretches import IsochoricActivations, fibre_tensors
from solver.kinds import FILES
from solver.mechanics.boundary import JAW_FREEDOM, FreeJaw
from solver.mechanics.flesh import IDENTITY, LAWS, shape_gradients
from solver.mechanics.harmonic import HarmonicExtension, laplacian
from solver.model import SubjectModel, by_muscle, find_muscles, tell_muscles
from solver.storage import Archive, Arrays, csr_arrays, csr_from
from solver.surface import Floats
from solver.tracks.lines import CentreLines
from solver.tracks.shapes import JawFreeShapes, ShapeOnTop, skinning_weights

Bones = Literal["free", "held"]
FORMAT = FILES["tracks.npz"].format
ARRAYS = ("jaw", "morphs", "skinning", "stiffness", "teeth_mm", "off_mm")  # as they are stored


@dataclass(frozen=True)
class TrackOptions:
    """How shapes are carried into the flesh, and how firmly muscles are held to them."""

    # free: bones are no border of a morph, as published; held: morphs are zero there
    bones: Bones = "free"
    # how far from its target a muscle is held as stiffly as by its own flesh: less follows shapes
    # more closely, more keeps the lips' volume better (docs/science/tracks.md)
    length_mm: float = 1.0
    stiffness: Mapping[str, float] | None = None  # muscle -> a factor on its springs
    law: str = "corotated_det"  # of the flesh, a name in LAWS: this one keeps volumes
    # stiffness of a muscle over that of the flesh around it, which weighs its share of a tet
    firmness: float = 30.0
    # of the skin over the Laplacian's mean diagonal: what it leaves is off_mm
    skin_weight: float = 1e3


@dataclass(frozen=True)
class MuscleTracks:
    """K shapes of a person as motions of the flesh, with what holds its m muscles to them.

    They are of one model, whose hash is ``model_sha256``.
    """

    model_sha256: str
    names: tuple[str, ...]  # of the K shapes
    jaw: Floats  # (K, 5) b_k, rad and mm
    morphs: Floats  # (K, p, 3) X_k, mm
    skinning: Floats  # (p,) o
    lines: CentreLines
    stiffness: Floats  # (m,) factor on the springs of each muscle
    bones: Bones
    length_mm: float
    law: str
    firmness: float
    teeth_mm: Floats  # (K,) what the jaw's motion misses of the lower teeth, root mean square
    off_mm: Floats  # (K,) what the morph misses of the skin's shape, on average
    # (K, K) weights of the shapes that each of a person's own is on top of; zero for the template's
    sums: Floats
    notices: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        model: SubjectModel,
        shapes: Mapping[str, Floats],
        options: TrackOptions = TrackOptions(),
    ) -> MuscleTracks:
        """Carry ``shapes``, name -> motion (V, 3) of the skin in mm, into a model's flesh.

        Raises :class:`InputError`: as :func:`~solver.tracks.shapes.check_shapes`, and
        ``tracks.muscle`` and ``tracks.options`` for options that do not fit.
        """
        stiffness = _check_options(model, options)
        morphing = _Morphing(model, options)
        free = JawFreeShapes.of(model, shapes, morphing.skinning)
        morphs, missed = morphing(free.motions)
        count = len(free.names)
        return cls(
            model.sha256,
            free.names,
            free.jaw,
            morphs,
            morphing.skinning,
            CentreLines.of(model),
            stiffness,
            options.bones,
            options.length_mm,
            options.law,
            options.firmness,
            free.teeth_mm,
            missed,
            np.zeros((count, count)),
            free.notices,
        )

    def with_shapes(self, model: SubjectModel, more: Sequence[ShapeOnTop]) -> MuscleTracks:
        """Return the tracks of a model with further shapes, each on top of a sum of these."""
        morphing = _Morphing(model, TrackOptions(self.bones))
        carried = [morphing(each.motion[None], each.confidence) for each in more]
        count = len(self.names)
        sums = np.pad(self.sums, (0, len(more)))
        sums[count:, :count] = [each.weights for each in more]
        return replace(
            self,
            names=(*self.names, *(each.name for each in more)),
            jaw=np.vstack([self.jaw, *(each.jaw for each in more)]),
            morphs=np.concatenate([self.morphs, *(morph for morph, _ in carried)]),
            teeth_mm=np.pad(self.teeth_mm, (0, len(more))),
            off_mm=np.concatenate([self.off_mm, *(missed for _, missed in carried)]),
            sums=sums,
        )

    @property
    def size(self) -> int:
        """Return the number of controls q = (w, j): K weights and the jaw's five."""
        return len(self.names) + JAW_FREEDOM

    def controls(self, weights: Mapping[str, float], jaw: Floats | None = None) -> Floats:
        """Return q (K + 5,) for weights by name and a jaw on top of the shapes'.

        Raises :class:`InputError` (``tracks.name``) for a shape that there is not.
        """
        q = np.zeros(self.size)
        for name, weight in weights.items():
            if name not in self.names:
                near = difflib.get_close_matches(name, self.names, 4)
                told = f"did you mean {', '.join(near)}?" if near else "see tracks.json for all"
                message = f"the tracks have no shape {quote(name)!r}; {told}"
                raise InputError("tracks.name", message, found=name, expected=list(self.names))
            q[self.names.index(name)] = weight
        if jaw is not None:
            q[len(self.names) :] = jaw
        return q

    def whole(self, name: str) -> Floats:
        """Return q (K + 5,) of a shape at weight 1 with the sum that it is on top of.

        Of a person's own shape that is the scan. Raises as :meth:`controls`.
        """
        q = self.controls({name: 1.0})
        q[: len(self.names)] += self.sums[self.names.index(name)]
        return q

    def check_controls(self, q: Floats) -> None:
        """Raise :class:`InputError` (``tracks.controls``) for anything but q (K + 5,), finite."""
        if q.shape != (self.size,) or not np.isfinite(q).all():
            wanted = f"{len(self.names)} weights and five numbers of the jaw"
            message = f"controls are {wanted}, all finite, not of shape {q.shape}"
            raise InputError("tracks.controls", message, expected=self.size)

    def shares(self, model: SubjectModel) -> sp.csr_array:
        """Return S (n, m + 1), a model's muscles' parts of its tets weighed by their firmness.

        A muscle that fills a tenth of a tet then moves nearly all of it, as in fits.
        """
        return mix_by_stiffness(model.weights, self.firmness)

    def check(self, model: SubjectModel) -> None:
        """Raise :class:`InputError` (``tracks.model``) unless the tracks are of this model."""
        if self.model_sha256 != model.sha256:
            message = "the tracks belong to another model: build them anew"
            raise InputError("tracks.model", message)

    def save(self, path: Path | str) -> None:
        """Write the tracks as NPZ, replacing the file whole."""
        arrays: Arrays = {name: getattr(self, name) for name in ARRAYS}
        arrays |= csr_arrays("line_rows", self.lines.rows)
        arrays |= {"line_first": self.lines.first, "line_closed": self.lines.closed}
        arrays["sums"] = self.sums
        header = {
            "format": FORMAT,
            "units": "mm, rad",
            "model": self.model_sha256,
            "names": self.names,
            "bones": self.bones,
            "length_mm": self.length_mm,
            "law": self.law,
            "firmness": self.firmness,
            "notices": self.notices,
        }
        Archive(header, arrays).write(path)

    @classmethod
    def load(cls, path: Path | str, model: SubjectModel) -> MuscleTracks:
        """Read the tracks of a model that :meth:`save` wrote.

        Raises :class:`InputError`: ``tracks.unreadable``, ``tracks.format``, and as :meth:`check`.
        """
        path = Path(path)
        archive = Archive.read(path, "tracks", "a set of muscle tracks", FORMAT)
        header = archive.header
        data = archive.arrays
        try:
            rows = csr_from("line_rows", data, len(data["skinning"]))
            tracks = cls(
                model_sha256=header["model"],
                names=tuple(header["names"]),
                lines=CentreLines(rows, data["line_first"], data["line_closed"]),
                bones=header["bones"],
                length_mm=float(header["length_mm"]),
                law=header["law"],
                firmness=float(header["firmness"]),
                notices=tuple(header["notices"]),
                # files of before there were a person's own shapes have none
                sums=data.get("sums", np.zeros((len(header["names"]),) * 2)),
                **{name: data[name] for name in ARRAYS},
            )
        except (LookupError, TypeError, ValueError) as error:
            message = f"{path.name} is not a set of muscle tracks: {error}"
            raise InputError("tracks.unreadable", message, file=path.name) from error
        tracks.check(model)
        return tracks


class _Morphing:
    """Carries motions of a model's skin into its flesh, with the jaw's skinning weights o (p,)."""

    def __init__(self, model: SubjectModel, options: TrackOptions) -> None:
        gradients, volumes = shape_gradients(model.rest, model.tets)
        self._matrix = laplacian(gradients, volumes, model.tets, len(model.rest))
        self._model = model
        self._weight = options.skin_weight * self._matrix.diagonal().mean()
        self._given = np.zeros(len(model.rest), dtype=bool)
        if options.bones == "held":
            for held in (model.cranium, model.mandible, model.cut):
                self._given[held] = True

    @cached_property
    def skinning(self) -> Floats:
        """The weights o."""
        return skinning_weights(self._model, self._matrix)

    def __call__(self, motions: Floats, trust: Floats | None = None) -> tuple[Floats, Floats]:
        """Return X (n, p, 3) of ``motions`` B (n, e, 3), and what they miss of them (n,), mm.

        ``trust`` (e,) are factors on the weight of the skin, 0 where nothing is asked for.
        """
        embedding = self._model.embedding
        factors = np.ones(len(self._model.embedded)) if trust is None else trust
        parts = self._matrix, self._given, embedding, self._weight * factors
        carry = HarmonicExtension(*parts, trace=1e-9)
        nothing = np.zeros((len(self._model.rest), 3, len(motions)))
        by_vertex = carry(nothing, targets=motions.transpose(1, 2, 0))
        on_skin = embedding @ by_vertex.reshape(len(by_vertex), -1)
        missed = on_skin.reshape(len(factors), 3, -1).transpose(2, 0, 1) - motions
        off = np.linalg.norm(missed, axis=2) @ factors / factors.sum()
        return np.ascontiguousarray(by_vertex.transpose(2, 0, 1)), off


def _check_options(model: SubjectModel, options: TrackOptions) -> Floats:
    """Return the factors (m,) on the muscles' springs; raises as :meth:`MuscleTracks.of`."""
    given = options.stiffness or {}
    for name, factor in given.items():
        if not find_muscles(name, model.muscle_names):
            told = tell_muscles(name, model.muscle_names)
            message = f"the model has no muscle {quote(name)!r}; {told}"
            raise InputError("tracks.muscle", message, found=name)
        if not 0.0 <= factor < np.inf:
            message = f"the stiffness of {name} is {factor}, not 0 or more"
            raise InputError("tracks.options", message, found=factor)
    for what in ("length_mm", "firmness", "skin_weight"):
        if not 0.0 < getattr(options, what) < np.inf:
            message = f"{what} is {getattr(options, what)}, not above 0"
            raise InputError("tracks.options", message, found=getattr(options, what))
    if options.law not in LAWS or options.bones not in get_args(Bones):
        message = f"bones {options.bones!r} or law {options.law!r} is none: {', '.join(LAWS)}"
        raise InputError("tracks.options", message)
    factors = by_muscle(given, model.muscle_names)
    return np.array([factors.get(name, 1.0) for name in model.muscle_names])


@dataclass(frozen=True)
class TrackPose:
    """Flesh that controls ask for: its places ``target`` (p, 3), the jaw, and the muscles."""

    target: Floats  # (p, 3) M
    jaw: Floats  # (5,) b
    lengths: Floats  # (m,) mm of the centre lines; zero where there is none
    activations: Floats  # (m, 6)


@dataclass(frozen=True)
class TrackRates:
    """The derivatives of a :class:`TrackPose` by q (K + 5,)."""

    target: Floats  # (p, 3, K + 5)
    jaw: Floats  # (5, K + 5)
    stretches: Floats  # (m, K + 5) of the muscles; zero where a stretch drives nothing
    by_stretch: Floats  # (m, 6) the activations' derivatives by them

    @property
    def activations(self) -> Floats:
        """Return the activations' derivatives (m, 6, K + 5)."""
        return np.asarray(self.by_stretch[:, :, None] * self.stretches[:, None])


class TrackTargets:
    """The targets of a model's tracks as functions of q = (w, j)."""

    def __init__(self, model: SubjectModel, tracks: MuscleTracks) -> None:
        self._model = model
        self._tracks = tracks
        self._jaw = FreeJaw(model.jaw)
        lengths = tracks.lines.lengths(model.rest)
        _, volumes = shape_gradients(model.rest, model.tets)
        tensors = fibre_tensors(model, volumes, model.weights)
        self.has_fibres = np.asarray(np.isfinite(tensors).all(axis=(1, 2)))
        # (m,) muscles with a line and fibres; the others stay as passive flesh
        self.driven = (lengths > 0.0) & self.has_fibres
        self._rest_lengths = lengths[self.driven]
        self._activations = IsochoricActivations.of(tensors[self.driven])

    @cached_property
    def _jaw_rates(self) -> Floats:
        """The jaw's derivatives (5, K + 5)."""
        return np.hstack([self._tracks.jaw.T, np.eye(JAW_FREEDOM)])

    @cached_property
    def _morphs_by_vertex(self) -> Floats:
        """The morphs as (p, 3, K), as a product with each vertex's turn wants them."""
        return np.ascontiguousarray(self._tracks.morphs.transpose(1, 2, 0))

    def jaw(self, q: Floats) -> Floats:
        """Return b (5,)."""
        return np.asarray(self._jaw_rates @ q)

    def at(self, q: Floats) -> TrackPose:
        """Return what q (K + 5,) asks for."""
        return self._pose(self.jaw(q), self._morph(q))

    def _pose(self, b: Floats, y: Floats) -> TrackPose:
        """Return what a jaw b (5,) and the morphed flesh y (p, 3) ask for."""
        share = self._tracks.skinning[:, None]
        target = (1.0 - share) * y + share * self._jaw.move(y, b)
        lengths = self._tracks.lines.lengths(target)
        a = np.tile(IDENTITY, (len(lengths), 1))
        a[self.driven] = self._activations(self._stretches(lengths))
        return TrackPose(target, b, lengths, a)

    def rates(self, q: Floats) -> TrackRates:
        """Return the derivatives of :meth:`at`."""
        b = self.jaw(q)
        y = self._morph(q)
        tracks = self._tracks
        share = tracks.skinning[:, None, None]
        turned = (1.0 - share) * np.eye(3) + share * self._jaw.matrix(b)[:3, :3]
        target = share * (self._jaw.jacobian(y, b) @ self._jaw_rates)
        target[:, :, : len(tracks.names)] += turned @ self._morphs_by_vertex
        pose = self._pose(b, y)
        lengths = tracks.lines.length_rates(pose.target, target)
        stretches = np.zeros_like(lengths)
        by_stretch = np.zeros_like(pose.activations)
        stretches[self.driven] = lengths[self.driven] / self._rest_lengths[:, None]
        by_stretch[self.driven] = self._activations.rates(self._stretches(pose.lengths))
        return TrackRates(target, self._jaw_rates, stretches, by_stretch)

    def _morph(self, q: Floats) -> Floats:
        weights = q[: len(self._tracks.names)]
        return np.asarray(self._model.rest + np.tensordot(weights, self._tracks.morphs, 1))

    def _stretches(self, lengths: Floats) -> Floats:
        return np.asarray(lengths[self.driven] / self._rest_lengths)
