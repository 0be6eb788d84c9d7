"""A take made of the small person: named markers 2 mm off the skin, motion of its expressions."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from solver.registration.search import nose_tip
from solver.scans.markers.places.bind import model_face
from solver.scans.markers.readers.names import read_names
from solver.scans.markers.readers.take import Take
from solver.surface import Floats, vertex_normals
from tests.fixtures import small_capture, small_model

LABELS = (
    *("Forehead_M", "Forehead_L", "Forehead_R", "Eyebrow_Center"),
    *("LBrow_In", "LBrow_M", "LBrow_Out", "RBrow_In", "RBrow_M", "RBrow_Out"),
    *("LEye_Up", "LEye_Down", "LEye_Out", "REye_Up", "REye_Down", "REye_Out"),
    *("Nose_Top", "Nose_Tip", "Nostril_L", "Nostril_R"),
    *("LCheek", "LCheek_Up", "LCheek_Down", "LCheek_Out"),
    *("RCheek", "RCheek_Up", "RCheek_Down", "RCheek_Out"),
    *("UpperLip", "UpperLip_L", "UpperLip_R", "LowerLip", "LowerLip_L", "LowerLip_R"),
    *("Mouth_Lend", "Mouth_Rend", "Chin", "Chin_L1", "Chin_R1", "Chin_L2", "Chin_R2"),
)
RATE = 60.0
FRAMES = 1200
HEIGHT = 2.0
AWAY = np.array([120.0, 900.0, 60.0])  # of the head at rest, in the studio


@cache
def sites() -> np.ndarray:
    """Return the skin vertex under each marker."""
    face = model_face(small_model())
    used = np.unique(face.faces)
    found: list[int] = []
    for named in read_names(LABELS):
        goal = np.array(named.place) + nose_tip(face)
        away = np.linalg.norm(face.vertices[used] - goal, axis=1)
        away[np.isin(used, found)] = np.inf
        found.append(int(used[np.argmin(away)]))
    return np.array(found)


@cache
def on_skin(name: str) -> Floats:
    """Return where the markers are in an expression."""
    skin = small_capture(name)
    places: Floats = skin.vertices[sites()] + HEIGHT * vertex_normals(skin)[sites()]
    places.setflags(write=False)
    return places


def made_positions(frames: int = FRAMES, noise: float = 0.1, seed: int = 0) -> Floats:
    """Return markers (f, k, 3): two seconds at rest, then expressions, the head turning."""
    rng = np.random.default_rng(seed)
    time = np.arange(frames) / RATE
    rest = on_skin("neutral")
    face = np.repeat(rest[None], frames, axis=0)
    for name, every, start in (("smile", 4.1, 2.2), ("surprise", 5.3, 3.0), ("ah", 2.7, 2.6)):
        phase = np.maximum(time - start, 0.0) / every
        weight = np.sin(np.pi * phase) ** 4 * (time > start)
        face += weight[:, None, None] * (on_skin(name) - rest)
    still = np.clip(time - 1.5, 0.0, 1.0)
    angles = still[:, None] * np.stack(
        [8 * np.sin(0.9 * time), 14 * np.sin(0.5 * time), 5 * np.sin(0.7 * time)], axis=1
    )
    turns = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    moved = np.einsum("fij,fkj->fki", turns, face) + AWAY
    moved += still[:, None, None] * 10 * np.sin(0.6 * time)[:, None, None] * [1.0, 0.3, 0.5]
    return np.asarray(moved + noise * rng.standard_normal(moved.shape))


def made_take(positions: Floats | None = None, labels: tuple[str, ...] = LABELS, **more) -> Take:
    """Return a take of these positions, as a reader would."""
    given = made_positions() if positions is None else positions
    return Take("made.c3d", labels, given, more.pop("rate", RATE), **more)
