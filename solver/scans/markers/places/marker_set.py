"""A session's marker set: where each label sits on a person, on the skin or on a bone."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from solver.errors import InputError, quote
from solver.kinds.document import find_faults
from solver.kinds.marker_set import LONGEST_LABEL, MarkerEntry, MarkerSetDocument, Part, SkinPoint
from solver.model import SubjectModel
from solver.scans.markers.readers.take import Take
from solver.similarity import Similarity
from solver.storage import write_json
from solver.surface import Floats, Ints, area_normals

Triple = tuple[float, float, float]

MOST_BYTES = 4 << 20  # of a marker set's file
ROUNDING = 1e-3  # off which weights may sum to 1, and a rotation be orthogonal
LONGEST_NUMBER = 12  # characters behind the label of a marker that moved
LEAST_AREA = 1e-6  # mm2, of a triangle that has a normal
BONY: tuple[Part, ...] = ("head", "upper_teeth", "lower_teeth")  # parts that ride on a bone

SPAN = re.compile("(.+@)-?[0-9]+")


def span_label(label: str, frame: int) -> str:
    """Return the label of a marker from the ``frame`` on at which it moved: ``LBRO1@312``."""
    return f"{label[: LONGEST_LABEL - LONGEST_NUMBER]}@{frame}"


@dataclass(frozen=True)
class Marker:
    """One marker: a point of the skin and its height over it, or a place on a bone."""

    label: str
    vertices: tuple[int, int, int] = (0, 0, 0)  # skin vertices of a triangle; of `face` only
    weights: Triple = (1.0, 0.0, 0.0)  # their shares, which sum to 1
    height_mm: float = 0.0  # over the skin, along its normal
    part: Part = "face"
    sigma_mm: float = 0.5  # of its place, a standard deviation
    place_mm: Triple | None = None  # on the person at rest, in the model's frame; of BONY parts


@dataclass(frozen=True)
class MarkerSet:
    """Markers of all takes of a session, and where the session's axes are in the model's.

    ``session`` takes a take's positions to the model's frame at the neutral; its rotation is
    orthogonal and mirrors if the take's axes are left-handed.
    """

    markers: tuple[Marker, ...]
    session: Similarity
    model_sha256: str

    @property
    def labels(self) -> tuple[str, ...]:
        """Return the markers' labels."""
        return tuple(marker.label for marker in self.markers)

    @property
    def used(self) -> tuple[Marker, ...]:
        """Return the markers that sit on the person: all but those that are to be ignored."""
        return tuple(marker for marker in self.markers if marker.part != "ignore")

    @cached_property
    def vertices(self) -> Ints:
        """Return skin vertices (k, 3)."""
        return np.array([marker.vertices for marker in self.markers], np.int64).reshape(-1, 3)

    @cached_property
    def weights(self) -> Floats:
        """Return their shares (k, 3)."""
        return np.array([marker.weights for marker in self.markers], float).reshape(-1, 3)

    @cached_property
    def heights(self) -> Floats:
        """Return heights (k,) over the skin in mm."""
        return np.array([marker.height_mm for marker in self.markers], float)

    @cached_property
    def sigma(self) -> Floats:
        """Return standard deviations (k,) in mm."""
        return np.array([marker.sigma_mm for marker in self.markers], float)

    @cached_property
    def places(self) -> Floats:
        """Return places on bones (k, 3) in mm, NaN for markers of the skin."""
        nowhere = (np.nan, np.nan, np.nan)
        places = [nowhere if each.place_mm is None else each.place_mm for each in self.markers]
        return np.array(places, float).reshape(-1, 3)

    def of_part(self, *parts: Part) -> Ints:
        """Return the numbers of the markers that ride on any of ``parts``."""
        chosen = [number for number, each in enumerate(self.markers) if each.part in parts]
        return np.array(chosen, np.int64)

    def for_take(self, labels: Sequence[str]) -> MarkerSet:
        """Return the set for a take with ``labels``, without what moved in another one.

        A place from a frame on (:func:`span_label`) is of the take in which the marker moved.
        """
        stems = {span_label(label, 0)[:-1] for label in self.labels}  # LBRO1@
        found = {label: SPAN.fullmatch(label) for label in self.labels}
        spans = {label for label, match in found.items() if match and match[1] in stems}
        others = spans.difference(labels)
        kept = tuple(marker for marker in self.markers if marker.label not in others)
        return replace(self, markers=kept)

    def save(self, path: Path) -> None:
        """Write the set as JSON."""
        write_json(path, self.to_document())

    def check_model(self, model: SubjectModel) -> None:
        """Refuse a set that is not bound to the skin of a model.

        Raises :class:`InputError`: ``markers.other_model``, or ``markers.set_schema`` for vertices
        that the skin does not have or that make no triangle.
        """
        if self.model_sha256 != model.sha256:
            message = "the marker set is of another model: bind it again"
            raise InputError("markers.other_model", message)
        count = len(model.skin.vertices)
        for number, marker in enumerate(self.markers):
            if marker.part != "face":
                continue
            where = f"markers.markers[{number}].at.vertices"
            if max(marker.vertices) >= count:
                message = f"{max(marker.vertices)} is no vertex of the skin, which has {count}"
                raise _schema_error(where, message)
            area = np.linalg.norm(area_normals(model.skin.vertices, np.array([marker.vertices])))
            if not area > LEAST_AREA:
                raise _schema_error(where, "are no triangle")

    @classmethod
    def load(cls, path: Path, model: SubjectModel | None = None) -> MarkerSet:
        """Read a set, which is of a ``model`` if that is given.

        Raises :class:`InputError`: ``markers.set_unreadable`` with ``file``, or what
        :meth:`from_document` and :meth:`check_model` find.
        """
        file = path.name
        try:
            with path.open("rb") as stream:
                content = stream.read(MOST_BYTES + 1)
            if len(content) > MOST_BYTES:
                raise ValueError(f"it has more than {MOST_BYTES} bytes")
            found = cls.from_document(json.loads(content))
            if model is not None:
                found.check_model(model)
            return found
        except InputError as error:
            error.context["file"] = file
            raise
        except (OSError, RecursionError, ValueError) as error:
            message = f"{file} is not a marker set: {quote(error)}"
            raise InputError("markers.set_unreadable", message, file=file) from error

    def to_document(self) -> dict[str, Any]:
        """Return the set as JSON values."""
        session = self.session
        return {
            "format": 1,
            "model_sha256": self.model_sha256,
            "session": {
                "scale": float(session.scale),
                "rotation": np.asarray(session.rotation, float).tolist(),
                "shift_mm": np.asarray(session.shift, float).tolist(),
            },
            "markers": [_entry(marker) for marker in self.markers],
        }

    @classmethod
    def from_document(cls, document: Any) -> MarkerSet:
        """Return the set that JSON values describe.

        Raises :class:`InputError`: ``markers.set_schema`` with ``where`` (a JSON path), or
        ``markers.set_labels`` (``label`` stands there twice).
        """
        try:
            read = MarkerSetDocument.model_validate(document)
        except ValidationError as error:
            fault = find_faults(error, document, "markers")[0]
            raise _schema_error(fault.where, fault.message) from error
        markers = tuple(_marker(entry, number) for number, entry in enumerate(read.markers))
        seen: set[str] = set()
        for marker in markers:
            if marker.label in seen:
                label = quote(marker.label)
                message = f"the marker set has the label '{label}' twice"
                raise InputError("markers.set_labels", message, label=label)
            seen.add(marker.label)
        rotation = np.array(read.session.rotation)
        shift = np.array(read.session.shift_mm)
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > ROUNDING:
            raise _schema_error("markers.session.rotation", "is not orthogonal")
        return cls(markers, Similarity(read.session.scale, rotation, shift), read.model_sha256)


@dataclass(frozen=True)
class BoundFrame:
    """A frame of a :class:`BoundTake`: k points, NaN where one is missing, mm."""

    points: Floats  # (k, 3)
    exchanged: NDArray[np.bool_]  # (k,) points that were another label's in the file
    unlabelled: Floats  # (u, 3) points without a label
    sigma: Floats | None  # (k, 3) standard deviations that the take has of the points


class BoundTake:
    """A take read by a marker set: points of its markers, in the model's axes and mm.

    ``exchanged`` (f, labels of the take) are points that were another label's in the file. Raises
    :class:`InputError` ``markers.few`` where the take has fewer than ``least`` of the set's labels.
    """

    def __init__(
        self, take: Take, markers: MarkerSet, least: int, exchanged: NDArray[np.bool_] | None = None
    ) -> None:
        self.markers = markers.used
        self._take = take
        self._set = markers
        self._session = markers.session
        self._exchanged = exchanged
        number = {label: column for column, label in enumerate(take.labels)}
        self._columns = np.array([number.get(each.label, -1) for each in self.markers], np.int64)
        known = int(np.sum(self._columns >= 0))
        if known < least:
            message = (
                f"{take.file} has {known} of the marker set's {len(self.markers)} labels: "
                f"{least} are needed"
            )
            raise InputError("markers.few", message, file=take.file, found=known)

    def save(self, used: Sequence[Marker], path: Path) -> None:
        """Write the set with the markers that are ``used`` as they are now."""
        others = (marker for marker in self._set.markers if marker.part == "ignore")
        replace(self._set, markers=(*used, *others)).save(path)

    @property
    def frames(self) -> range:
        """Return the numbers of the take's frames, as its file counts them."""
        return self._take.numbers

    @property
    def labels(self) -> tuple[str, ...]:
        """Return the markers' labels."""
        return tuple(marker.label for marker in self.markers)

    def frame(self, number: int) -> BoundFrame:
        """Return the frame with a number."""
        take = self._take
        session = self._session
        row = self.frames.index(number)
        columns = self._columns
        points = session(take.positions[row][columns])
        points[columns < 0] = np.nan
        exchanged = np.zeros(len(columns), bool)
        if self._exchanged is not None:
            here = self._exchanged[row]
            known = (columns >= 0) & (columns < len(here))  # not those of moved markers
            exchanged[known] = here[columns[known]]
        sigma = None
        if take.sigma is not None:
            variance = take.sigma[row][columns] ** 2
            sigma = np.asarray(session.scale * np.sqrt(variance @ session.rotation.T**2))
        return BoundFrame(points, exchanged, session(take.unlabelled[row]), sigma)


@nb.njit(cache=True, error_model="numpy")
def places_over(corners: Floats, weights: Floats, heights: Floats) -> Floats:
    """Return places (k, 3) at ``heights`` (k,) over triangles (k, 3, 3), along their normals."""
    out = np.empty((len(corners), 3))
    sides = np.empty((2, 3))
    normal = np.empty(3)
    for k in range(len(corners)):
        height = heights[k] / area_normal(corners[k], sides, normal)
        for i in range(3):
            out[k, i] = height * normal[i]
            for j in range(3):
                out[k, i] += weights[k, j] * corners[k, j, i]
    return out


@nb.njit(cache=True, error_model="numpy")
def area_normal(corners: Floats, sides: Floats, normal: Floats) -> float:
    """Return the length of the normal (3,) of a triangle's ``corners`` (3, 3), twice its area.

    Both ``sides`` (2, 3) from its first corner and the ``normal`` are written into these.
    """
    for side in range(2):
        for i in range(3):
            sides[side, i] = corners[1 + side, i] - corners[0, i]
    first = sides[0]
    second = sides[1]
    normal[0] = first[1] * second[2] - first[2] * second[1]
    normal[1] = first[2] * second[0] - first[0] * second[2]
    normal[2] = first[0] * second[1] - first[1] * second[0]
    return math.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2) + 1e-30


def _entry(marker: Marker) -> dict[str, Any]:
    at: Any = {"vertices": list(marker.vertices), "weights": list(marker.weights)}
    return {
        "label": marker.label,
        "part": marker.part,
        "at": at if marker.place_mm is None else list(marker.place_mm),
        "height_mm": marker.height_mm,
        "sigma_mm": marker.sigma_mm,
    }


def _marker(entry: MarkerEntry, number: int) -> Marker:
    where = f"markers.markers[{number}].at"
    at = entry.at
    height = entry.height_mm
    sigma = entry.sigma_mm
    marker = Marker(entry.label, height_mm=height, part=entry.part, sigma_mm=sigma)
    if not isinstance(at, SkinPoint):
        if entry.part == "face":
            raise _schema_error(where, "is a place; a marker of the face is a point of the skin")
        return replace(marker, place_mm=(at[0], at[1], at[2]))
    if entry.part in BONY:
        raise _schema_error(where, "is a point of the skin; what rides on bone has a place")
    if abs(sum(at.weights) - 1.0) > ROUNDING:
        raise _schema_error(f"{where}.weights", f"sum to {sum(at.weights):.4g}, not to 1")
    first, second, third = at.vertices
    one, two, three = at.weights
    return replace(marker, vertices=(first, second, third), weights=(one, two, three))


def _schema_error(where: str, message: str) -> InputError:
    return InputError("markers.set_schema", f"{where}: {message}", where=where)
