"""Checks of this machine: Python, packages, disk, memory, port, compiler, mesher and node."""

from __future__ import annotations

import importlib.metadata
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh
from packaging.requirements import Requirement

from myoface.stack import check_port
from service.settings import Settings
from solver.anatomy.tetrahedra import EdgeLengths, background_grid, tetrahedralize
from solver.errors import SolveError
from solver.kinds import KINDS, Kind
from solver.surface import Surface
from worker.caches import CACHES
from worker.kernels import are_compiled
from worker.sandbox import missing_layers

PYTHONS = ((3, 11), (3, 14))
WANTED_DISK_GB = 5.0
WANTED_MEMORY_GB = 4.0
CHILD_TIMEOUT_S = 120.0
# Bits of a file's mode that let others than its owner in
OTHERS = 0o077

NEEDED_EXTRAS = ("service", "solver")
REINSTALL = "reinstall: rm -rf .venv && make setup"
COMPILE = "import numba; print(numba.njit(lambda x: x + 1)(41))"

Verdict = Literal["ok", "warning", "fault"]


@dataclass(frozen=True)
class Diagnosis:
    """One check's outcome; ``advice`` says what to do where it is not ok."""

    subject: str
    verdict: Verdict
    found: str
    advice: str = ""


def python() -> Diagnosis:
    """Check that this Python is a supported one."""
    found = ".".join(map(str, sys.version_info[:3]))
    if PYTHONS[0] <= sys.version_info[:2] < PYTHONS[1]:
        return Diagnosis("Python", "ok", found)
    return Diagnosis("Python", "fault", found, "use Python 3.11, 3.12 or 3.13")


def packages() -> Diagnosis:
    """Check that every required package is there, in a version that will do."""
    try:
        lines = importlib.metadata.requires("myoface") or []
    except importlib.metadata.PackageNotFoundError:
        return Diagnosis("packages", "fault", "myoface is not installed", "run `make setup`")
    requirements = map(Requirement, lines)
    needed = [each for each in requirements if _is_needed(each)]
    faults = []
    for requirement in needed:
        try:
            version = importlib.metadata.version(requirement.name)
        except importlib.metadata.PackageNotFoundError:
            faults.append(f"{requirement.name} is missing")
        else:
            if not requirement.specifier.contains(version, prereleases=True):
                faults.append(f"{requirement.name} {version} is not {requirement.specifier}")
    if faults:
        return Diagnosis("packages", "fault", "; ".join(faults), "run `make setup`")
    return Diagnosis("packages", "ok", f"all {len(needed)} there")


def _is_needed(requirement: Requirement) -> bool:
    """Tell whether the service and the solver need a package on this machine."""
    marker = requirement.marker
    return marker is None or any(marker.evaluate({"extra": extra}) for extra in NEEDED_EXTRAS)


def data_folder(folder: Path) -> Diagnosis:
    """Check that files can be written where the service keeps its data."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return Diagnosis("data folder", "ok", str(folder))
    except OSError as error:
        advice = "set MYOFACE_DATA_DIR to a folder that you can write to"
        return Diagnosis("data folder", "fault", f"{folder}: {error.strerror}", advice)


def access(*folders: Path) -> Diagnosis:
    """Check that no other user can look into the folders: what is in them is faces."""
    wide = [folder for folder in folders if folder.exists() and folder.stat().st_mode & OTHERS]
    if not wide:
        return Diagnosis("access", "ok", "nobody else's")
    found = "others can look into " + ", ".join(map(str, wide))
    advice = f"chmod -R go= {shlex.join(map(str, wide))}"
    return Diagnosis("access", "warning", found, advice)


def disk(folder: Path) -> Diagnosis:
    """Check that there is room for scans and rigs."""
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    free = shutil.disk_usage(existing).free / 1024**3
    if free >= WANTED_DISK_GB:
        return Diagnosis("disk", "ok", f"{free:.0f} GB free")
    advice = f"free {WANTED_DISK_GB:.0f} GB or set MYOFACE_DATA_DIR to another disk"
    return Diagnosis("disk", "warning", f"{free:.1f} GB free", advice)


def memory() -> Diagnosis:
    """Check that there is memory enough for a fit."""
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1024**3
    if total >= WANTED_MEMORY_GB:
        return Diagnosis("memory", "ok", f"{total:.0f} GB")
    return Diagnosis("memory", "warning", f"{total:.1f} GB", "a fit of a whole face needs 3 GB")


def confinement() -> Diagnosis:
    """Check that solver processes, which read strangers' files, can be confined."""
    missing = missing_layers()
    if not missing:
        return Diagnosis("confinement", "ok", "solver processes reach their own folder only")
    advice = "a file that takes a solver over could reach these: use a newer Linux"
    return Diagnosis("confinement", "warning", "; ".join(missing), advice)


def limits(settings: Settings) -> Diagnosis:
    """Say within which limits solver processes work here, and whether memory can hold them."""
    slots = settings.ingest_workers + settings.short_workers + settings.long_workers
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 1024**2
    largest = {queue: settings.max_seconds(kind) for queue, kind in _kinds().items()}
    times = ", ".join(f"{queue} {seconds} s" for queue, seconds in largest.items())
    found = f"{times}; {slots} at a time with {settings.solver_memory_mb} MB each"
    if slots * settings.solver_memory_mb <= total:
        return Diagnosis("job limits", "ok", found)
    advice = f"this machine has {total} MB: lower MYOFACE_SOLVER_MEMORY_MB, or run fewer at a time"
    return Diagnosis("job limits", "warning", found, advice)


def _kinds() -> dict[str, Kind]:
    """Return the kind of each queue that may last longest."""
    by_length = sorted(KINDS.values(), key=lambda kind: kind.max_seconds)
    return {kind.queue: kind for kind in by_length}


def tenant_caches(settings: Settings) -> Diagnosis:
    """Measure what is kept of tenants' templates here."""
    folders = (settings.work / CACHES).glob("*/")
    sizes = [sum(file.lstat().st_size for file in folder.iterdir()) for folder in folders]
    most = settings.tenant_cache_bytes
    megabytes = sum(sizes) / 1024**2
    largest = most / 1024**2
    found = f"{megabytes:.0f} MB of {len(sizes)} tenants, {largest:.0f} MB each at most"
    if max(sizes, default=0) <= most:
        return Diagnosis("solver caches", "ok", found)
    return Diagnosis("solver caches", "warning", found, "a worker's sweeper removes the oldest")


def kernels() -> Diagnosis:
    """Check that the solver's kernels are compiled."""
    if are_compiled():
        return Diagnosis("kernels", "ok", "compiled")
    advice = "run `python -m worker.kernels`; `myoface up` does so by itself"
    return Diagnosis("kernels", "warning", "not compiled: each job compiles its own", advice)


def port(host: str, number: int) -> Diagnosis:
    """Check that the port is free."""
    try:
        check_port(host, number)
    except OSError as error:
        advice = "is the service running already? else `myoface up --port 0` takes a free one"
        return Diagnosis("port", "warning", f"{host}:{number}: {error.strerror}", advice)
    return Diagnosis("port", "ok", f"{host}:{number} is free")


def compiler() -> Diagnosis:
    """Check that numba compiles, in a process that may die without harm."""
    try:
        command = [sys.executable, "-c", COMPILE]
        subprocess.run(command, capture_output=True, timeout=CHILD_TIMEOUT_S, check=True)
    except subprocess.SubprocessError as error:
        return Diagnosis("compiler", "fault", str(error), REINSTALL)
    return Diagnosis("compiler", "ok", "numba compiles")


def mesher() -> Diagnosis:
    """Check that fTetWild meshes a cube of 10 mm (in a process of its own, as always)."""
    cube = trimesh.creation.box(extents=(10.0, 10.0, 10.0))
    points, tets = background_grid(cube.bounds[0], cube.bounds[1], 10.0)
    lengths = EdgeLengths(points, tets, np.full(len(points), 5.0))
    surface = Surface(np.asarray(cube.vertices), np.asarray(cube.faces))
    try:
        _, found = tetrahedralize(
            surface, 5.0, envelope_mm=0.1, lengths=lengths, cpu_seconds=CHILD_TIMEOUT_S
        )
    except SolveError as error:
        return Diagnosis("mesher", "fault", str(error), REINSTALL)
    return Diagnosis("mesher", "ok", f"{len(found)} tetrahedra in a cube")


def node() -> Diagnosis:
    """Look for node, which the Khronos validator of the demonstration needs."""
    if shutil.which("node") and shutil.which("npm"):
        return Diagnosis("node", "ok", "there, for the Khronos glTF validator")
    advice = "optional: with `apt-get install nodejs npm` the demo runs the Khronos validator"
    return Diagnosis("node", "warning", "not installed", advice)
