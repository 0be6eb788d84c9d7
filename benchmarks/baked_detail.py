"""Detail that a registration bakes, beside the scan that it is from and what was carved into it."""

from __future__ import annotations

import json
import tempfile
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from benchmarks.detail_views import draw_detail, read_placed
from benchmarks.documents import Figures
from benchmarks.made_skin import carve, furrows, pits
from solver.anatomy.embedding import barycentric
from solver.anatomy.tangents import frames, vertex_tangents
from solver.anatomy.template import Template
from solver.anatomy.texture_coordinates import TextureCoordinates
from solver.jobs import run_job
from solver.meshio.ply import write_ply
from solver.registration.detail import Detail, bake_detail
from solver.registration.normal_maps import by_slopes, slopes
from solver.registration.subdivided import CHILDREN, Subdivided
from solver.registration.texture import texture_coordinates
from solver.registration.topology import Topology, topology
from solver.surface import (
    Floats,
    Ints,
    Surface,
    faces_within,
    part_of,
    unit_rows,
    vertex_areas,
    vertex_normals,
)
from solver.templates.builtin.build import builtin_template

STEEP = 7.0  # degrees of the mesh alone from which on a place is looked at
NEAR_MM = 2.0  # of the registered skin, for a vertex of the scan to be compared
LEAST_COSINE = 0.5  # of both normals, likewise
LEVELS = 3  # of subdivision of a made scan
NOISE_MM = 0.01  # of its vertices, at most
NOISE = 0.02  # of the distance between them, at most
SUBJECT = 5  # seed of the person
IDENTITIES = 12  # shapes that make the person, and their deviation
SPREAD = 0.6
EXPRESSION = {"browInnerUp": 1.0, "mouthSmileLeft": 0.7, "mouthSmileRight": 0.7}
DEEP_MM = 0.1  # of relief whose depth is compared
NAMES = ("neutral", "expression")  # of the scans
AT_REST = 0.4  # share of the furrows' depth that the neutral has


@dataclass(frozen=True, eq=False)
class Registered:
    """A registration's files, asked at the vertices of its scan that lie on the face."""

    folder: Path
    places: Floats  # (n, 2) in images
    axes: Floats  # (n, 3, 3) of the mesh
    normals: Floats  # (n, 3) of the scan
    areas: Floats  # (n,) mm^2
    vertices: Ints  # (n,) of the scan
    told: Figures  # registration.json

    @classmethod
    def read(cls, folder: Path, scan: Path, template: Template) -> Registered:
        """Read the files of a ``scan`` that was registered to a template."""
        told, skin, surface = read_placed(scan, folder, template)
        own = vertex_normals(surface)
        faces, shares, distance = barycentric(surface.vertices, skin)
        coordinates = texture_coordinates(template)
        mapped = coordinates.mapped
        cut = coordinates.split(skin, mapped)
        normals = vertex_normals(skin)[cut.vertices]
        tangents = vertex_tangents(skin.vertices[cut.vertices], normals, cut.places, cut.faces)
        on_face = faces_within(skin.faces, topology(template).face)
        used = np.flatnonzero((distance < NEAR_MM) & on_face[faces] & np.isin(faces, mapped))
        corners = cut.faces[np.searchsorted(mapped, faces[used])]
        at = partial(np.einsum, "nc,ncd->nd", shares[used])
        axes = frames(at(tangents[corners]), at(normals[corners]))
        kept = np.einsum("nd,nd->n", axes[:, 2], own[used]) > LEAST_COSINE
        places = at(cut.places[corners])[kept]
        places[:, 1] = 1.0 - places[:, 1]
        used = used[kept]
        areas = vertex_areas(surface.vertices, surface.faces)[used]
        return cls(folder, places, axes[kept], own[used], areas, used, told)

    def image(self, path: Path) -> Floats:
        """Return the values (n, c) of an image at the vertices, bilinear, whatever their depth."""
        image = np.asarray(Image.open(path)).astype(np.float64)
        image = image.reshape(*image.shape[:2], -1)
        size = image.shape[0]
        at = self.places * size - 0.5
        low = np.clip(np.floor(at).astype(np.int64), 0, size - 2)
        right, down = (at - low).T[:, :, None]
        column, row = low.T
        upper = (1.0 - right) * image[row, column] + right * image[row, column + 1]
        lower = (1.0 - right) * image[row + 1, column] + right * image[row + 1, column + 1]
        return np.asarray((1.0 - down) * upper + down * lower)

    def map(self, path: Path) -> Floats:
        """Return the unit normals (n, 3) that a map has, by the mesh's axes."""
        return unit_rows(2.0 * self.image(path)[:, :3] / 255.0 - 1.0)

    def heights(self, folder: Path) -> Floats:
        """Return the displacement (n,) in mm that a registration with the same limits has left."""
        told = self.told["detail"]["displacement"]
        numbers = self.image(folder / "displacement.png")[:, 0]
        return np.asarray(told["offset_mm"] + told["scale_mm"] * numbers)

    def off(self, local: Floats) -> Floats:
        """Return how far (n,) in degrees normals (n, 3) by the mesh's axes are off the scan's."""
        found = np.einsum("ni,nij->nj", local, self.axes)
        cosine = np.einsum("nd,nd->n", found, self.normals)
        return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))

    def mean(self, values: Floats, chosen: NDArray[np.bool_] | slice = slice(None)) -> float:
        """Return the mean of values (n,) over the scan's area, of all vertices or ``chosen``."""
        return float(np.average(values[chosen], weights=self.areas[chosen]))

    def errors(self) -> Figures:
        """Return how far mesh and normal map are off the scan's normals, in degrees."""
        alone = self.off(np.tile([0.0, 0.0, 1.0], (len(self.places), 1)))
        baked = self.off(self.map(self.folder / "normals.png"))
        steep = alone >= STEEP
        return {
            "mesh_error_deg": self.mean(alone, steep),
            "normal_error_deg": self.mean(baked, steep),
            "steep_share": float(self.areas[steep].sum() / self.areas.sum()),
            "face_mesh_error_deg": self.mean(alone),
            "face_normal_error_deg": self.mean(baked),
            "displacement_p95_mm": float(np.percentile(np.abs(self.heights(self.folder)), 95)),
            "noise_mm": self.told["detail"]["noise_mm"],
        }


def measure(scan: Path | None, template: Path | None, picture: Path | None) -> Figures:
    """Return what registrations bake: of a made person, and of a ``scan`` where one is given.

    ``picture`` is where the made scans and their skins are drawn side by side.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        found = measure_made(out)
        if picture is not None:
            rows = [(name, out / f"{name}.ply", out / name) for name in NAMES]
            draw_detail(picture, rows, builtin_template())
        if scan is not None:
            found |= {f"scan_{key}": value for key, value in _given(scan, template).items()}
    return found


def _given(scan: Path, template: Path | None) -> Figures:
    with tempfile.TemporaryDirectory() as folder:
        run_job("register_scan", folder, scan=scan, template=template)
        told = json.loads((Path(folder) / "registration.json").read_text())
        if "detail" not in told:
            return {"note": "the scan is hardly finer than the template's mesh"}
        anatomy = builtin_template() if template is None else Template.load(template)
        return Registered.read(Path(folder), scan, anatomy).errors()


def measure_made(folder: Path) -> Figures:
    """Return figures of a made person, neutral and with deeper furrows; files go to ``folder``."""
    template = builtin_template()
    person = Person.of(template)
    skins = ((person.skin, AT_REST), (person.moved, 1.0))
    scans = [folder / f"{name}.ply" for name in NAMES]
    outs = [folder / name for name in NAMES]
    relief = []
    for path, (skin, share) in zip(scans, skins, strict=True):
        scan, heights = person.scan(skin, share)
        write_ply(path, scan)
        relief.append(heights)
    neutral, carved = relief
    run_job("register_scan", outs[0], scan=scans[0])
    run_job(
        "register_scan",
        outs[1],
        scan=scans[1],
        neutral=outs[0] / "registered.ply",
        normals=outs[0] / "normals.png",
    )
    rest = Registered.read(outs[0], scans[0], template)
    moved = Registered.read(outs[1], scans[1], template)
    known = neutral[rest.vertices]
    deeper = (carved - neutral)[moved.vertices]
    change = moved.heights(outs[1]) - moved.heights(outs[0])
    before_map = moved.map(outs[0] / "normals.png")
    wrinkles = slopes(moved.map(outs[1] / "wrinkle_normals.png"))
    mask = moved.image(outs[1] / "wrinkle_normals.png")[:, 3] / 255.0
    worn = by_slopes(slopes(before_map) + mask[:, None] * wrinkles)
    wrinkled = deeper < 0.3 * deeper.min()
    return {
        **rest.errors(),
        **person.recovered(texture_coordinates(template)),
        "registered_correlation": correlation(rest.heights(outs[0]), known, rest.areas),
        "registered_wrinkles_correlation": correlation(mask * change, deeper, moved.areas),
        "wrinkles_error_deg": moved.mean(moved.off(worn), wrinkled),
        "without_wrinkles_deg": moved.mean(moved.off(before_map), wrinkled),
        "wrinkles_mask": moved.mean(mask, wrinkled),
        "smooth_mask": moved.mean(mask, deeper > -1e-6),
    }


@dataclass(frozen=True, eq=False)
class Person:
    """A made person: skin, that with an expression, and relief on the finely divided neutral."""

    topology: Topology
    skin: Surface
    moved: Surface
    pores: Floats  # (n,) mm
    lines: Floats  # (n,) mm
    outer: Ints  # (f,) triangles of the fine skin that a scanner sees

    @classmethod
    def of(cls, template: Template) -> Person:
        """Return a person by a template's shapes."""
        shapes = template.shapes
        assert shapes is not None
        known = topology(template)
        weights = SPREAD * np.random.default_rng(SUBJECT).standard_normal(IDENTITIES)
        identity = np.tensordot(weights, shapes.identity[:IDENTITIES].astype(np.float64), 1)
        skin = template.skin.with_vertices(template.skin.vertices + identity)
        moved = skin.vertices.copy()
        for name, weight in EXPRESSION.items():
            moved += weight * shapes.expressions[shapes.expression_names.index(name)]
        fine = Subdivided.of(skin, LEVELS).surface
        face = np.flatnonzero(faces_within(skin.faces, known.face))
        outer = np.flatnonzero(np.repeat(faces_within(skin.faces, known.outer), CHILDREN**LEVELS))
        pores = pits(skin, face, fine.vertices)
        lines = furrows(skin, fine.vertices)
        return cls(known, skin, skin.with_vertices(moved), pores, lines, outer)

    def scan(self, skin: Surface, share: float) -> tuple[Surface, Floats]:
        """Return a scan of one of the skins and its heights (k,), the lines at a ``share``."""
        fine = Subdivided.of(skin, LEVELS).surface
        heights = self.pores + share * self.lines
        spacing = np.sqrt(vertex_areas(fine.vertices, fine.faces))
        noise = np.random.default_rng(SUBJECT).standard_normal(len(heights))
        rough = heights + noise * np.minimum(NOISE * spacing, NOISE_MM)
        used = np.unique(fine.faces[self.outer])
        return part_of(carve(fine, rough), self.outer), heights[used]

    def recovered(self, coordinates: TextureCoordinates) -> Figures:
        """Return how heights baked on the very skins that were carved compare with those known."""
        rest, known = self._baked(self.skin, AT_REST, coordinates)
        moved, carved = self._baked(self.moved, 1.0, coordinates)
        own = moved.texels.within(self.topology.face)
        area = moved.texels.areas(own)
        found = moved.heights[own]
        deep = carved[own] < -DEEP_MM
        share = float(np.average(found[deep] / carved[own][deep], weights=area[deep]))
        change = (moved.heights - rest.heights)[own]
        return {
            "recovered_correlation": correlation(rest.heights[own], known[own], area),
            "recovered_depth": share,
            "wrinkles_correlation": correlation(change, (carved - known)[own], area),
        }

    def _baked(
        self, skin: Surface, share: float, coordinates: TextureCoordinates
    ) -> tuple[Detail, Floats]:
        """Return what is baked of a scan of a skin, and the heights (t,) that were carved there."""
        detail = bake_detail(self.scan(skin, share)[0], skin, self.topology, coordinates)
        assert detail is not None
        fine = Subdivided.of(skin, LEVELS)
        faces, shares = fine.locate(detail.texels.faces, detail.texels.shares)
        heights = (self.pores + share * self.lines)[fine.surface.faces[faces]]
        return detail, np.einsum("nc,nc->n", shares, heights)


def correlation(one: Floats, other: Floats, weights: Floats) -> float:
    """Return the correlation of values (n,) by ``weights`` (n,)."""
    one = one - np.average(one, weights=weights)
    other = other - np.average(other, weights=weights)
    products = (one * other, one * one, other * other)
    common, first, second = (np.average(each, weights=weights) for each in products)
    return float(common / np.sqrt(first * second))
