"""Commands on the data itself, where the service runs: its tenants and what they may."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from myoface.cli.commands import Argument, Group, Option, UsageError
from myoface.cli.console import out, show_table
from myoface.cli.service import Data, read_settings

if TYPE_CHECKING:
    from service.settings import Settings
    from service.store.database import Store

tenants = Group("Tenants: customers who see nothing of one another.")

MaxBytes = Annotated[int | None, Option(min=0, help="bytes that may be stored")]
MaxQueued = Annotated[int | None, Option(min=0, help="jobs that may wait")]
MaxRunning = Annotated[int | None, Option(min=0, help="jobs that may run at a time")]
NewLimit = Annotated[
    str | None, Option(metavar="NUMBER", help="'none': no limit; default: as it is")
]
RetainDays = Annotated[
    str | None, Option(metavar="DAYS", help="'none': the installation's; default: as it is")
]


@tenants.command("list")
def list_tenants(data: Data = None) -> None:
    """List the tenants with their quotas and the days they keep things, if they have their own."""
    from service.access import bootstrap
    from service.store.retention import KINDS

    with _store(data) as (store, _), store.read() as session:
        rows = [
            (
                each.id,
                each.name,
                each.max_bytes,
                each.max_queued,
                each.max_running,
                *(getattr(each, f"retain_{kind}") for kind in KINDS),
            )
            for each in bootstrap.list_tenants(session)
        ]
    kept = [f"{kind} (days)" for kind in KINDS]
    show_table(("id", "name", "bytes", "queued", "running", *kept), rows)


@tenants.command("add")
def add_tenant(
    name: str,
    key: Annotated[Path, Option(dir_okay=False, help="file for its first key")],
    max_bytes: MaxBytes = None,
    max_queued: MaxQueued = None,
    max_running: MaxRunning = None,
    data: Data = None,
) -> None:
    """Add a tenant and write its first key, which may do everything, to a file (mode 0600)."""
    from service.access import bootstrap
    from service.access.keys import Keyring
    from service.secret import secret

    _refuse_to_overwrite(key)
    quotas = {"max_bytes": max_bytes, "max_queued": max_queued, "max_running": max_running}
    with _store(data) as (store, settings):
        keyring = Keyring(store, secret(settings))
        out.print(bootstrap.add_tenant(store, keyring, name, key, **quotas))


@tenants.command("key")
def make_key(
    tenant: Annotated[str, Argument(help="tenant id")],
    key: Annotated[Path, Option(dir_okay=False, help="file for the key")],
    data: Data = None,
) -> None:
    """Make a key for a tenant that has lost its own: it may do everything (file of mode 0600)."""
    from service.access import bootstrap
    from service.access.keys import Keyring
    from service.secret import secret

    _refuse_to_overwrite(key)
    with _store(data) as (store, settings):
        if not bootstrap.tenant_key(store, Keyring(store, secret(settings)), tenant, key):
            raise UsageError(f"there is no tenant {tenant}")


@tenants.command("limit")
def limit_tenant(
    tenant: Annotated[str, Argument(help="tenant id")],
    max_bytes: NewLimit = None,
    max_queued: NewLimit = None,
    max_running: NewLimit = None,
    data: Data = None,
) -> None:
    """Set a tenant's quotas; those that are not given stay as they are."""
    given = {"max_bytes": max_bytes, "max_queued": max_queued, "max_running": max_running}
    _change(data, tenant, **_numbers(given, least=0))


@tenants.command("retain")
def retain(
    tenant: Annotated[str, Argument(help="tenant id")],
    subjects: RetainDays = None,
    scans: RetainDays = None,
    jobs: RetainDays = None,
    rigs: RetainDays = None,
    data: Data = None,
) -> None:
    """Set after how many days a tenant's things go; those that are not given stay as they are.

    The installation's days hold where they are fewer than the tenant's.
    """
    from service.store.retention import KINDS

    given = dict(zip(KINDS, (subjects, scans, jobs, rigs), strict=True))
    days = _numbers(given, least=1)
    _change(data, tenant, **{f"retain_{kind}": most for kind, most in days.items()})


def _numbers(given: dict[str, str | None], *, least: int) -> dict[str, int | None]:
    """Return what was typed for some options as numbers; ``none`` is None."""
    numbers: dict[str, int | None] = {}
    for name, text in given.items():
        if text is None:
            continue
        option = f"--{name.replace('_', '-')}"
        if text != "none" and (not text.isdecimal() or int(text) < least):
            message = f"{text!r} is neither a number from {least} on nor 'none'"
            raise UsageError(f"{option}: {message}")
        numbers[name] = None if text == "none" else int(text)
    if not numbers:
        options = ", ".join(f"--{name.replace('_', '-')}" for name in given)
        raise UsageError(f"give at least one of {options}")
    return numbers


def _change(data: Path | None, tenant: str, **limits: int | None) -> None:
    from service.access import bootstrap

    with _store(data) as (store, _), store.write() as session:
        if not bootstrap.change_tenant(session, tenant, **limits):
            raise UsageError(f"there is no tenant {tenant}")


def _refuse_to_overwrite(key: Path) -> None:
    if key.exists():
        raise UsageError(f"--key: {key} is there already")


@contextmanager
def _store(data: Path | None) -> Iterator[tuple[Store, Settings]]:
    from service.store.database import Store

    given: dict[str, Any] = {} if data is None else {"data_dir": data}
    settings = read_settings(**given)
    if data is not None and not data.is_dir():
        raise UsageError(f"--data {data}: there is no such folder: is it the service's?")
    store = Store(settings.database, settings.files, settings.broker)
    store.database.migrate()
    try:
        yield store, settings
    finally:
        store.close()
