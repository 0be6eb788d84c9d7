"""Checks of this machine: can the service run here, and if not, what is to be done."""

from __future__ import annotations

import importlib.metadata
import os
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from packaging.requirements import Requirement

from service.settings import Settings
from service.store.broker import BrokerNotFoundError, find_server

PYTHONS = ((3, 11), (3, 14))
WANTED_DISK_GB = 5.0
WANTED_MEMORY_GB = 4.0
CHILD_TIMEOUT_S = 120.0

COMPILE = "import numba; print(numba.njit(lambda x: x + 1)(41))"
MESH = """
import numpy, pytetwild, trimesh
box = trimesh.creation.box()
corners, faces = numpy.asarray(box.vertices), numpy.asarray(box.faces)
vertices, tets = pytetwild.tetrahedralize(corners, faces, quiet=True)[:2]
print(len(tets), "tetrahedra in a cube")
"""

Verdict = Literal["ok", "warning", "fault"]


@dataclass(frozen=True)
class Finding:
    """One check's outcome; ``advice`` says what to do where it is not ok."""

    subject: str
    verdict: Verdict
    found: str
    advice: str = ""


def examine(settings: Settings) -> Iterator[Finding]:
    """Run the checks one by one, the quick ones first."""
    yield python()
    yield packages()
    yield data_folder(settings.data_dir)
    yield disk(settings.data_dir)
    yield memory()
    yield port(settings.host, settings.port)
    yield broker(settings)
    yield child("compiler", COMPILE, "reinstall: rm -rf .venv && make setup")
    yield child("mesher", MESH, "reinstall: rm -rf .venv && make setup")
    yield node()


def python() -> Finding:
    """Check that this Python is a supported one."""
    found = ".".join(map(str, sys.version_info[:3]))
    if PYTHONS[0] <= sys.version_info[:2] < PYTHONS[1]:
        return Finding("Python", "ok", found)
    return Finding("Python", "fault", found, "use Python 3.11, 3.12 or 3.13")


def packages() -> Finding:
    """Check that every required package is there, in a version that will do."""
    try:
        lines = importlib.metadata.requires("myoface") or []
    except importlib.metadata.PackageNotFoundError:
        return Finding("packages", "fault", "myoface is not installed", "run `make setup`")
    requirements = map(Requirement, lines)
    needed = [each for each in requirements if each.marker is None or each.marker.evaluate()]
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
        return Finding("packages", "fault", "; ".join(faults), "run `make setup`")
    return Finding("packages", "ok", f"all {len(needed)} there")


def data_folder(folder: Path) -> Finding:
    """Check that files can be written where the service keeps its data."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return Finding("data folder", "ok", str(folder))
    except OSError as error:
        advice = "set MYOFACE_DATA_DIR to a folder that you can write to"
        return Finding("data folder", "fault", f"{folder}: {error.strerror}", advice)


def disk(folder: Path) -> Finding:
    """Check that there is room for scans and rigs."""
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    free = shutil.disk_usage(existing).free / 1024**3
    if free >= WANTED_DISK_GB:
        return Finding("disk", "ok", f"{free:.0f} GB free")
    advice = f"free {WANTED_DISK_GB:.0f} GB or set MYOFACE_DATA_DIR to another disk"
    return Finding("disk", "warning", f"{free:.1f} GB free", advice)


def memory() -> Finding:
    """Check that there is memory enough for a fit."""
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1024**3
    if total >= WANTED_MEMORY_GB:
        return Finding("memory", "ok", f"{total:.0f} GB")
    return Finding("memory", "warning", f"{total:.1f} GB", "a fit of a whole face needs 3 GB")


def port(host: str, number: int) -> Finding:
    """Check that the port is free."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, number))
        except OSError as error:
            advice = "is the service running already? else `myoface up --port 0` takes a free one"
            return Finding("port", "warning", f"{host}:{number}: {error.strerror}", advice)
    return Finding("port", "ok", f"{host}:{number} is free")


def broker(settings: Settings) -> Finding:
    """Check that there is a broker."""
    if settings.broker_url is not None:
        return Finding("broker", "ok", "an own one, by MYOFACE_BROKER_URL")
    try:
        return Finding("broker", "ok", find_server())
    except BrokerNotFoundError as error:
        return Finding("broker", "fault", "none", str(error))


def child(subject: str, program: str, advice: str) -> Finding:
    """Check that a small program works, in a process that may die without harm."""
    try:
        command = [sys.executable, "-c", program]
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=CHILD_TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired:
        return Finding(subject, "fault", f"no answer in {CHILD_TIMEOUT_S:.0f} s", advice)
    if done.returncode != 0:
        last = done.stderr.strip().splitlines()[-1:] or [f"ended with code {done.returncode}"]
        return Finding(subject, "fault", last[0], advice)
    return Finding(subject, "ok", done.stdout.strip().splitlines()[-1])


def node() -> Finding:
    """Look for node, which the Khronos validator of the demonstration needs."""
    if shutil.which("node") and shutil.which("npm"):
        return Finding("node", "ok", "there, for the Khronos glTF validator")
    advice = "optional: with `apt-get install nodejs npm` the demo runs the Khronos validator"
    return Finding("node", "warning", "not installed", advice)
