"""Tetrahedra by fTetWild, in a process of their own.

fTetWild (Hu, Schneider, Wang, Zorin and Panozzo, "Fast tetrahedral meshing in the wild", 2020)
takes any triangle soup, but it may crash or not come back, so it runs as a child that ends itself
after so many seconds of work: ``python -m solver.anatomy.tetrahedra input.npz output.npz SECONDS``.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
import types
from dataclasses import dataclass
from pathlib import Path

import igl
import numpy as np

from solver.errors import SolveError
from solver.surface import Floats, Ints, Surface

ML = 1e-3  # millilitres in a cubic millimetre

_ROOT = Path(__file__).parents[2]
_CORNERS = np.indices((2, 2, 2)).reshape(3, -1).T  # of a cube
# The six tetrahedra of a cube around its main diagonal (Kuhn's subdivision), by corner number.
_KUHN = np.array(
    [[0, 4, 6, 7], [0, 6, 2, 7], [0, 2, 3, 7], [0, 3, 1, 7], [0, 1, 5, 7], [0, 5, 4, 7]]
)


@dataclass(frozen=True)
class EdgeLengths:
    """Wanted edge lengths in mm at the points of a tetrahedral background mesh."""

    points: Floats
    tets: Ints
    lengths: Floats


def background_grid(lo: Floats, hi: Floats, spacing: float) -> tuple[Floats, Ints]:
    """Return points (p, 3) and tetrahedra (t, 4) of a regular grid that covers the box ``lo, hi``.

    ``spacing`` is the length of a cell in mm.
    """
    counts = np.ceil((hi - lo) / spacing).astype(int) + 1
    points = lo + spacing * np.indices(tuple(counts)).reshape(3, -1).T
    corners = np.indices(tuple(counts - 1)).reshape(3, -1).T[:, None] + _CORNERS
    numbers = np.ravel_multi_index(tuple(np.moveaxis(corners, -1, 0)), tuple(counts))
    return points, numbers[:, _KUHN].reshape(-1, 4)


def tetrahedralize(
    surface: Surface,
    edge_mm: float,
    *,
    envelope_mm: float,
    lengths: EdgeLengths,
    cpu_seconds: float,
) -> tuple[Floats, Ints]:
    """Fill the bounding box of a triangle soup with tetrahedra that follow its triangles.

    Nothing is filtered: the tetrahedra inside, outside and in holes are all returned, and the
    caller chooses. The result is not reproducible from run to run.

    The triangles of ``surface`` are followed within ``envelope_mm`` (the largest distance) by tets
    with edges of ``edge_mm``, or of ``lengths`` where that background mesh is. The child ends after
    ``cpu_seconds`` of processor time: a busy machine makes it slow, not wrong.

    Returns vertices (p, 3) in mm and positively oriented tetrahedra (t, 4). Raises
    :class:`SolveError`: ``mesher.timeout`` or ``mesher.crashed``.
    """
    with tempfile.TemporaryDirectory(prefix="tetrahedra-") as name:
        source = Path(name) / "input.npz"
        target = Path(name) / "output.npz"
        np.savez(
            source,
            vertices=surface.vertices,
            faces=surface.faces,
            bg_vertices=lengths.points,
            bg_tets=lengths.tets,
            bg_values=lengths.lengths,
            edge=edge_mm,
            envelope=envelope_mm,
        )
        command = [sys.executable, "-m", "solver.anatomy.tetrahedra"]
        command += [str(source), str(target), str(cpu_seconds)]
        child = subprocess.run(command, cwd=_ROOT, capture_output=True, check=False)
        if child.returncode == -signal.SIGPROF:
            reason = f"the mesher had no result after {cpu_seconds:.0f} seconds of processor time"
            raise SolveError("mesher.timeout", reason, seconds=cpu_seconds)
        if child.returncode != 0 or not target.exists():
            last_words = child.stderr.decode(errors="replace").strip()[-500:]
            reason = f"the mesher ended with code {child.returncode}: {last_words}"
            raise SolveError("mesher.crashed", reason, returncode=child.returncode)
        with np.load(target) as result:
            vertices = result["vertices"]
            tets = result["tets"].astype(np.int64)
    return vertices, positively_oriented(vertices, tets)


def positively_oriented(vertices: Floats, tets: Ints) -> Ints:
    """Return the tetrahedra with two vertices swapped where the signed volume is negative."""
    negative = volumes(vertices, tets)[:, None] < 0
    return np.where(negative, tets[:, [0, 1, 3, 2]], tets)


def volumes(vertices: Floats, tets: Ints) -> Floats:
    """Return the signed volumes (t,) in mm^3."""
    edges = vertices[tets[:, 1:]] - vertices[tets[:, :1]]
    return np.asarray(np.linalg.det(edges) / 6.0)


def volume_ml(vertices: Floats, tets: Ints) -> float:
    """Return the signed volume of all tets in ml."""
    return ML * float(volumes(vertices, tets).sum())


def barycentric_in_tets(points: Floats, corners: Floats) -> Floats:
    """Return barycentric coordinates (n, 4) of points (n, 3) in tetrahedra (n, 4, 3)."""
    edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    last = np.linalg.solve(edges, (points - corners[:, 0])[..., None])[..., 0]
    return np.column_stack([1.0 - last.sum(axis=1), last])


def dihedral_angles(vertices: Floats, tets: Ints) -> Floats:
    """Return the six dihedral angles (t, 6) of each tetrahedron, in degrees."""
    return np.asarray(np.degrees(igl.dihedral_angles(vertices, tets)[0]))


def _run_child(source: Path, target: Path) -> None:
    # pytetwild 0.4 imports pyvista when it is loaded, only to register an accessor on it, without
    # depending on it; an empty module spares this process the whole of VTK.
    sys.modules.setdefault("pyvista", types.ModuleType("pyvista"))
    from pytetwild.pytetwild import tetrahedralize as fill

    with np.load(source) as data:
        diagonal = float(np.linalg.norm(np.ptp(data["vertices"], axis=0)))
        vertices, tets = fill(
            data["vertices"],
            data["faces"].astype(np.int32),
            edge_length_abs=float(data["edge"]),
            epsilon=float(data["envelope"]) / diagonal,
            disable_filtering=True,
            bg_vertices=data["bg_vertices"],
            bg_tets=data["bg_tets"].astype(np.int32),
            bg_values=data["bg_values"],
        )
    with target.open("wb") as stream:
        np.savez(stream, vertices=vertices, tets=tets)


if __name__ == "__main__":
    signal.setitimer(signal.ITIMER_PROF, float(sys.argv[3]))  # whose signal ends the process
    _run_child(Path(sys.argv[1]), Path(sys.argv[2]))
