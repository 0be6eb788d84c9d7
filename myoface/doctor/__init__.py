"""Checks of this machine and of the service, with advice for each fault."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from myoface.doctor import machine, service
from myoface.doctor.machine import Diagnosis
from service.settings import Settings

__all__ = ["Diagnosis", "examine"]


def examine(settings: Settings) -> Iterator[Diagnosis]:
    """Run the checks one by one, the quick ones first."""
    yield machine.python()
    yield machine.packages()
    yield machine.data_folder(settings.data_dir)
    yield machine.access(*_private_places(settings))
    yield machine.disk(settings.data_dir)
    yield machine.memory()
    yield machine.port(settings.host, settings.port)
    yield service.broker(settings)
    yield service.secret(settings)
    yield from service.stores(settings)
    yield machine.confinement()
    yield machine.limits(settings)
    yield machine.tenant_caches(settings)
    yield machine.compiler()
    yield machine.kernels()
    yield machine.mesher()
    yield machine.node()


def _private_places(settings: Settings) -> list[Path]:
    """Return the folders with faces in them, but for those inside another one."""
    files = settings.files if isinstance(settings.files, Path) else settings.data_dir
    places = {settings.data_dir, files, settings.uploads, settings.work}
    return sorted(each for each in places if not places & {*each.parents})
