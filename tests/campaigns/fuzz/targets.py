"""What is fuzzed: readers of untrusted bytes, and the only exceptions each may raise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from service import outbound, paging
from service.errors import Problem
from service.http import bodies
from service.uploads.schemas import parse_checksum, parse_metadata
from solver.anatomy.template import Template
from solver.animation.performance import FittedSequence
from solver.errors import InputError
from solver.kinds.scene_recording import Recording
from solver.meshio.raw import mend, read_raw
from solver.meshio.registered import read_registered
from solver.neck.osim import read_osim
from solver.photo.facts import read_facts
from solver.photo.picture import Picture, read_picture
from solver.registration.landmarks import read_landmarks
from solver.scans.film import decode_film
from solver.scans.known_activations import read_known
from solver.scans.live_link import read_live_link
from solver.scans.markers.check import check_take
from solver.scans.markers.places.bind import Reference
from solver.scans.markers.places.face_take import USUAL_RATE, living_labels
from solver.scans.markers.places.marker_set import MarkerSet
from solver.scans.markers.readers.take import read_take
from solver.scans.markers.signal.faults import find_faults
from solver.scans.openface import read_openface
from solver.scans.performance import open_performance
from solver.storage import Archive
from solver.surface import Surface
from solver.templates.folder import read_template
from tests.campaigns.fuzz import seeds
from tests.campaigns.fuzz.arrays import read_spoilt_template
from tests.campaigns.fuzz.growth import GrowthOptions

Read = Callable[[Path], object]


@dataclass(frozen=True)
class Target:
    """A reader: valid inputs to begin with, and what it may raise for others.

    ``run`` gets the input and an empty folder; how it grows matters up to ``most_bytes``, as it is
    never given more.
    """

    name: str
    seeds: list[bytes]
    run: Callable[[bytes, Path], object]
    refusal: type[Exception]
    most_bytes: int = GrowthOptions.most_bytes
    most_inputs: int | None = None  # small ones, of a reader that takes seconds for each


def _surface() -> Surface:
    mesh = seeds.surface()
    return Surface(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64))


def _raw(path: Path) -> None:
    mend(read_raw(path))


def _registered(path: Path) -> None:
    face = _surface()
    read_registered(path, face.faces, len(face.vertices), neutral=face.vertices)


def _performance(path: Path) -> None:
    performance = open_performance(path, _surface(), np.arange(10))
    for number in range(min(3, len(performance))):
        performance.frame(number)


def _marker_set(path: Path) -> None:
    MarkerSet.load(path, seeds.person())


def _check(path: Path) -> None:
    take = read_take(path)
    check_take(take, Reference.of(seeds.person()))
    faults = find_faults(take.positions[:, living_labels(take)], USUAL_RATE)  # as a fit does
    faults.put_right(faults.motion.places)


def _sequence(path: Path) -> None:
    found = FittedSequence.load(path, "asset")
    found.check_values()
    found.places_of(found.muscles)


def _known_activations(path: Path) -> None:
    table = read_known(path, ("frontalis_l.medial", "frontalis_l.lateral", "procerus"))
    if table.times is None:
        table.of_expressions(["smile"])
    else:
        table.of_take(100, 60.0).at(0.5)


def _facts(path: Path) -> None:
    width, height = seeds.PICTURE
    read_facts(path, Picture(np.zeros((height, width, 3), np.float32), None, None, False, "PNG"))


def _archive(path: Path) -> None:
    Archive.read(path, "model", "a model", 1)


def _file(name: str, contents: list[bytes], suffix: str, read: Read) -> Target:
    def run(content: bytes, folder: Path) -> object:
        path = folder / f"input.{suffix}"
        path.write_bytes(content)
        return read(path)

    return Target(name, contents, run, InputError)


def _text(name: str, contents: list[bytes], read: Callable[[str], object]) -> Target:
    # a header or a query parameter: uvicorn gives Latin-1
    return Target(name, contents, lambda content, _: read(content.decode("latin-1")), Problem)


def _meshes() -> list[Target]:
    kinds = {"obj": seeds.obj(), "ply": seeds.ply(), "stl": seeds.stl(), "glb": seeds.glb()}
    return [
        *(_file(f"raw {kind}", contents, kind, _raw) for kind, contents in kinds.items()),
        _file("raw xyz", seeds.xyz(), "xyz", _raw),
        *(_file(f"{kind}", contents, kind, _registered) for kind, contents in kinds.items()),
    ]


def _markers() -> list[Target]:
    takes = {
        "c3d": seeds.markers_c3d(),
        "trc": seeds.markers_trc(),
        "motive": seeds.markers_motive(),
        "npz": seeds.markers_npz(),
    }
    readers = (_file(f"markers {kind}", known, kind, read_take) for kind, known in takes.items())
    checked = [content for known in takes.values() for content in known]
    return [
        *readers,
        _file("marker set", seeds.marker_set(), "json", _marker_set),
        # a check looks for a face: what costs it the most is made for it
        replace(_file("markers check", checked, "dat", _check), most_inputs=40),
        _file("known activations", seeds.known_activations(), "csv", _known_activations),
        _file("sequence", seeds.sequence(), "npz", _sequence),
    ]


def _openface(path: Path) -> None:
    read_openface(path, Recording(asset=path.stem))


def _film(path: Path) -> None:
    for picture in decode_film(path, "video"):
        picture.pixels()


def targets() -> list[Target]:
    """Return all targets."""
    return [
        *_meshes(),
        _file("landmarks json", seeds.landmarks_json(), "json", read_landmarks),
        _file("landmarks csv", seeds.landmarks_csv(), "csv", read_landmarks),
        *_markers(),
        _file("picture jpg", seeds.pictures_jpg(), "jpg", read_picture),
        _file("picture png", seeds.pictures_png(), "png", read_picture),
        _file("photograph json", seeds.photograph_json(), "json", _facts),
        _file("live link", seeds.live_link(), "csv", read_live_link),
        _file("osim", seeds.osim(), "osim", read_osim),
        _file("openface", seeds.openface(), "csv", _openface),
        _file("signals", seeds.signals(), "csv", read_live_link),
        replace(_file("film", seeds.films(), "mp4", _film), most_inputs=300),
        _file("npy", seeds.npy() + seeds.npz(), "npy", _performance),
        _file("npz", seeds.npz() + seeds.npy(), "npz", _archive),
        _file("template", seeds.template(), "zip", read_template),
        Target("template npz", [b"1", b"2"], read_spoilt_template, InputError),
        _file("template file", seeds.template_arrays(), "npz", Template.load),
        _text("upload metadata", seeds.metadata(), parse_metadata),
        _text(
            "upload checksum",
            seeds.checksum(),
            lambda text: parse_checksum(text, ("sha256", "sha1")),
        ),
        _text("cursor", seeds.cursor(), paging.read_cursor),
        Target(
            "json",
            seeds.bodies(),
            lambda content, _: bodies.check_json(content),
            Problem,
            bodies.MOST_BYTES_LARGER,
        ),
        Target(
            "webhook url",
            seeds.urls(),
            lambda content, _: outbound.parse(content.decode("latin-1")),
            outbound.Refused,
        ),
    ]
