"""The inputs of jobs, the files that jobs leave for later ones and the roles of captures.

Each is declared once. A contract (:class:`~solver.kinds.kind.Kind`) names them: ``reads`` and
``asks`` those of :data:`INPUTS`, ``hands_on`` those of :data:`FILES`. The command line makes its
arguments and options of the first; the service checks and finds by the second what earlier jobs
left.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

Form = Literal["file", "file or folder", "files", "named files", "role"]


@dataclass(frozen=True)
class InputPart:
    """A part of an input on the command line: an argument if a job needs it, else an option."""

    parameter: str
    words: str  # of the command line's help
    # what the job calls its file (task.inputs); None: it is no file, or the job has all of them by
    # their own names (task.captures)
    role: str | None = None
    form: Form = "file"
    is_needed: bool = False


@dataclass(frozen=True)
class Input:
    """An input of jobs."""

    parts: tuple[InputPart, ...]
    of_an_expression: tuple[InputPart, ...] = ()  # in their place where a kind reads a capture, too
    beside_a_rig: tuple[InputPart, ...] = ()  # in their place where a kind reads any_rig, too


def _given(parameter: str, words: str, form: Form = "file", role: str | None = None) -> InputPart:
    """Return an argument; its file has the role that is called as it is."""
    return InputPart(parameter, words, role or parameter, form, is_needed=True)


def _option(parameter: str, words: str, role: str | None = None, form: Form = "file") -> InputPart:
    """Return an option; its file has the role that is called as it is."""
    return InputPart(parameter, words, role or parameter, form)


def _named_files(parameter: str, words: str) -> InputPart:
    """Return an option that is repeated, with a name for each file."""
    return InputPart(parameter, words, form="named files")


RIG = "rig.npz, or a rig's folder or ZIP; to one of 0.1 copy its model.npz"

INPUTS: Mapping[str, Input] = {
    "capture": Input(
        (
            _given("scan", "OBJ, PLY, STL, GLB, a ZIP of one with its images, or point cloud"),
            _option("landmarks", "JSON, LJSON or CSV"),
        )
    ),
    "neutral": Input(
        (_given("neutral", "OBJ, PLY, GLB or STL"),),
        (_option("neutral", "of an expression: registered neutral"),),
    ),
    "captures": Input((InputPart("scans", "expression scans", form="files", is_needed=True),)),
    "own_scans": Input(
        (InputPart("scans", "expression scan, as a shape; repeatable", form="files"),)
    ),
    "performance": Input(
        (_given("performance", "frames (.npy), or a folder of registered scans", "file or folder"),)
    ),
    "markers": Input(
        (
            _given("take", "markers: C3D, TRC, Motive CSV or NPZ", role="markers"),
            _option("set", "the session's marker set, JSON", role="marker_set"),
        )
    ),
    "activations": Input(
        (_option("activations", "what is known of single muscles, as of EMG: CSV"),)
    ),
    "photos": Input(
        (
            _named_files("photo", "NAME=FILE, a photograph, JPEG or PNG; repeatable"),
            _named_files("facts", "NAME=FILE, what is known of the photograph of this name, JSON"),
            _named_files("mask", "NAME=FILE, a PNG that is white where the photograph counts"),
            _option(
                "film",
                "MP4, MOV, WebM, Matroska or AVI, or a folder or ZIP of pictures",
                form="file or folder",
            ),
        )
    ),
    "model": Input(
        (_given("model", "model.npz"),),
        # an option may be called "model": that of fit_photo says what is fitted
        beside_a_rig=(_option("person", "model.npz, where no rig is given", role="model"),),
    ),
    "rig": Input((_given("rig", RIG, "file or folder"),)),
    "any_rig": Input((_option("rig", RIG, form="file or folder"),)),
    "template": Input((_option("template", "template NPZ; default: built-in"),)),
    "assets": Input((_named_files("asset", "NAME=FILE, a file that the scene names; repeatable"),)),
    "sequences": Input(()),  # a scene names them as it does assets
    "signals": Input(()),  # the same
    "blendshapes": Input((_option("blendshapes", "blendshapes.npz of an earlier animation"),)),
    "expression_basis": Input(
        (_option("basis", "expression_basis.npz of an earlier job", "expression_basis"),)
    ),
    "control_pairs": Input(
        (_option("known", "control_pairs.npz of an earlier learn-controls", "control_pairs"),)
    ),
    "controls": Input((_option("controls", "controls.npz of learn-controls"),)),
    "fibre_muscles": Input(
        (_option("fibres", "fibre_muscles.npz of fit-fibres", "fibre_muscles"),)
    ),
    "live_skin": Input((_option("skin", "live_skin.npz of a live session", "live_skin"),)),
    "live_samples": Input(
        (_option("samples", "live_samples.npz of a live session", "live_samples"),)
    ),
    "live_takes": Input(
        (_option("live", "live_takes.npz of the live session of the take", "live_takes"),)
    ),
    "marker_set": Input((_option("set", "the session's marker set, JSON", role="marker_set"),)),
    "tracks": Input((_option("tracks", "tracks.npz of build-tracks"),)),
    "texture": Input((_option("texture", "texture.png of the neutral's register-scan"),)),
    "wrinkles": Input(
        (
            _named_files(
                "wrinkle", "NAME=FILE, wrinkle_normals.png of the expression NAME; repeatable"
            ),
        )
    ),
    "normals": Input((_option("normals", "normals.png of the neutral's register-scan"),)),
    "role": Input((InputPart("role", "what the scan is meant to be", form="role"),)),
    "start": Input(
        (_option("start", "rig to start from, also of another person", form="file or folder"),)
    ),
}


@dataclass(frozen=True)
class LeftFile:
    """A file that jobs leave for later ones."""

    input: str  # what it is to those: of kinds that have it in ``reads``
    role: str  # what the job that reads it calls it
    formats: tuple[int, ...] = (1,)  # the numbers that this release reads, the newest last
    of_a_rig: bool = False  # made of one rig and of no other: later jobs of it find the newest
    of_a_model: bool = False  # the same of a model: jobs of rigs that have it find the newest
    # made of the neutral that a model is built from: jobs of rigs that have it find that one
    of_a_neutral: bool = False
    # made of one expression: jobs of rigs find the newest of each that the rig has, by its name
    of_expressions: bool = False
    is_kept: bool = False  # takes minutes to make: the next attempt at a job goes on with it

    @property
    def format(self) -> int:
        """The number of the newest format."""
        return self.formats[-1]


FILES: Mapping[str, LeftFile] = {
    "model.npz": LeftFile("model", "model"),
    "tracks.npz": LeftFile("tracks", "tracks", of_a_model=True),
    "rig.npz": LeftFile("rig", "rig"),
    "markers.json": LeftFile("markers", "marker_set"),
    "sequence.npz": LeftFile(
        "sequences",
        "asset",
        formats=(1, 2, 3),  # 2 has what markers add, 3 weights of shapes
    ),
    "signals.csv": LeftFile("signals", "asset"),
    "blendshapes.npz": LeftFile("blendshapes", "blendshapes", of_a_rig=True, is_kept=True),
    "expression_basis.npz": LeftFile(
        "expression_basis", "expression_basis", of_a_rig=True, is_kept=True
    ),
    "control_pairs.npz": LeftFile("control_pairs", "control_pairs", of_a_rig=True, is_kept=True),
    "controls.npz": LeftFile("controls", "controls", of_a_rig=True),
    "live_skin.npz": LeftFile("live_skin", "live_skin", of_a_rig=True, is_kept=True),
    "live_takes.npz": LeftFile("live_takes", "live_takes"),
    "live_samples.npz": LeftFile("live_samples", "live_samples", of_a_rig=True, is_kept=True),
    "fibre_muscles.npz": LeftFile("fibre_muscles", "fibre_muscles", of_a_rig=True),
    "texture.png": LeftFile("texture", "texture", of_a_neutral=True),
    "wrinkle_normals.png": LeftFile("wrinkles", "wrinkles", of_expressions=True),
    "normals.png": LeftFile("normals", "normals", of_a_neutral=True),
}


# Roles of captures: what a subject's file is to its jobs. The API takes these and shows them to the
# page; ``scripts/client_roles.py`` writes them down for the client, which is published alone.

MESHES = (".obj", ".ply", ".stl", ".glb")
ARCHIVES = (".zip",)  # of a mesh with its MTL files and images, or of the pictures of a film
CLOUDS = (".xyz", ".pts", ".asc", ".csv", ".txt", ".xyzn", ".xyzrgb")
PICTURES = (".jpg", ".jpeg", ".png")
LANDMARKS = (".json", ".ljson", ".csv")
MOST_PHOTOS = 16  # of one job
FILMS = (".mp4", ".mov", ".webm", ".mkv", ".avi")  # all that solver.scans.film reads
MOST_FILM_FRAMES = 2000  # of one job


@dataclass(frozen=True)
class Role:
    """A role of captures; files have formats by their endings."""

    title: str
    noun: str  # what such a file is, in errors and descriptions
    formats: tuple[str, ...]
    then: str  # what becomes of it, in words that follow a colon
    registered: tuple[str, ...] = ()  # formats of one in the template's topology
    landmarks: tuple[str, ...] = ()  # formats of the file beside it with landmarks, if it takes one
    masks: tuple[str, ...] = ()  # formats of the mask beside it, if it takes one
    own_formats: tuple[str, ...] = ()  # of no other role: it is of this one if nobody says another
    sets: tuple[str, ...] = ()  # of what lies beside such files for all of a session, one as well

    @property
    def is_scan(self) -> bool:
        """Whether it is checked and registered; others stay as they are."""
        return bool(self.registered)


ROLES: Mapping[str, Role] = {
    "neutral": Role(
        title="Neutral",
        noun="the neutral capture",
        formats=(*MESHES, *ARCHIVES, *CLOUDS),
        registered=MESHES,
        landmarks=LANDMARKS,
        then="it is checked and registered, and the model is built from it",
    ),
    "expression": Role(
        title="Expression",
        noun="an expression",
        formats=(*MESHES, *ARCHIVES, *CLOUDS),
        registered=MESHES,
        landmarks=LANDMARKS,
        then="it is checked, registered and fitted",
    ),
    "performance": Role(
        title="Performance",
        noun="a performance",
        formats=(".npy",),
        own_formats=(".npy",),
        then="it is fitted with a rig (fit_sequence)",
    ),
    "markers": Role(
        title="Markers",
        noun="a take of markers",
        formats=(".c3d", ".trc", ".csv", ".npz"),
        own_formats=(".c3d", ".trc"),
        sets=(".json",),
        then="it is checked (check_markers) and fitted with a rig (fit_markers)",
    ),
    "activations": Role(
        title="Known activations",
        noun="a table of known activations",
        formats=(".csv",),
        then="it lies beside scans, a performance or a take in a fit",
    ),
    "photo": Role(
        title="Photograph",
        noun="a photograph",
        formats=PICTURES,
        own_formats=PICTURES,
        landmarks=(".json",),
        masks=(".png",),
        then="faces are fitted to photographs",
    ),
    "film": Role(
        title="Film",
        noun="a film",
        formats=(*FILMS, *ARCHIVES),  # a ZIP of pictures
        own_formats=FILMS,
        then="a face is fitted to its frames (fit_photo with sequence)",
    ),
    "asset": Role(
        title="File for scenes",
        noun="an asset",
        formats=(*MESHES, ".csv", ".npy", ".npz", ".osim", *FILMS),
        then="scenes name it",
    ),
}
SCANS = tuple(name for name, role in ROLES.items() if role.is_scan)
