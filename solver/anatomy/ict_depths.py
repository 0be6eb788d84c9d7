"""Landmarks on both sides of the ICT-FaceKit face, and the soft-tissue depths at them."""

from __future__ import annotations

import csv
from importlib import resources

from scipy.spatial import cKDTree

from solver.anatomy.depths import Depth
from solver.surface import Floats

SOURCE = (
    "Means after Stephan and Simpson (2008) and Rhine and Moore (1982), see sources.csv; entered "
    "by hand, not yet checked against the printed tables"
)


def both_sides(landmarks: dict[str, int], skin: Floats) -> dict[str, int]:
    """Return landmarks with a right one (``name_r``) for every left one: the face is symmetric."""
    left = {name: vertex for name, vertex in landmarks.items() if name.endswith("_l")}
    mirrored = skin[list(left.values())] * [-1, 1, 1]
    right = cKDTree(skin).query(mirrored)[1]
    names = (f"{name.removesuffix('_l')}_r" for name in left)
    return {**landmarks, **{name: int(vertex) for name, vertex in zip(names, right, strict=True)}}


def depth_table(skin: Floats) -> tuple[dict[str, int], tuple[Depth, ...]]:
    """Return the landmarks of the depth table in a skin (n, 3), and the depths at them."""
    path = resources.files("solver.anatomy.data").joinpath("bodyparts3d_landmarks.csv")
    with path.open() as stream:
        rows = [row for row in csv.DictReader(stream) if row["kind"] != "muscle"]
    landmarks, depths = {}, []
    for row in rows:
        name = row["name"].replace(" ", "_")
        paired = row["side"] == "both"
        landmarks[f"{name}_l" if paired else name] = int(row["skin_vertex"])
        for landmark in (f"{name}_l", f"{name}_r") if paired else (name,):
            depths.append(
                Depth(landmark, row["bone"], float(row["depth_mm"]), float(row["sd_mm"]), SOURCE)
            )
    return both_sides(landmarks, skin), tuple(depths)
