"""The roles of captures, each declared once: what a subject's file is to its jobs.

The API takes these and shows them to the page; ``scripts/client_roles.py`` writes them down for the
client, which is published alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

MESHES = (".obj", ".ply", ".stl", ".glb")
CLOUDS = (".xyz", ".pts", ".asc", ".csv", ".txt", ".xyzn", ".xyzrgb")


@dataclass(frozen=True)
class Role:
    """A role of captures.

    noun
        What such a file is, in errors and descriptions.
    formats
        The endings of its files, and in ``registered`` those of one in the template's topology.
    own_formats
        Those of them that no file of another role has: it is of this role if nobody says another.
    sets
        The endings of what lies beside such files for all of a session, and is one of them as well.
    then
        What becomes of it, in words that follow a colon.
    """

    title: str
    noun: str
    formats: tuple[str, ...]
    then: str
    registered: tuple[str, ...] = ()
    own_formats: tuple[str, ...] = ()
    sets: tuple[str, ...] = ()

    @property
    def is_scan(self) -> bool:
        """Whether it is checked and registered; what is none takes no landmarks, and stays so."""
        return bool(self.registered)


ROLES: Mapping[str, Role] = {
    "neutral": Role(
        title="Neutral",
        noun="the neutral capture",
        formats=(*MESHES, *CLOUDS),
        registered=MESHES,
        then="it is checked and registered, and the model is built from it",
    ),
    "expression": Role(
        title="Expression",
        noun="an expression",
        formats=(*MESHES, *CLOUDS),
        registered=MESHES,
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
    "asset": Role(
        title="File for scenes",
        noun="an asset",
        formats=(*MESHES, ".csv", ".npy", ".npz"),
        then="scenes name it",
    ),
}
SCANS = tuple(name for name, role in ROLES.items() if role.is_scan)
