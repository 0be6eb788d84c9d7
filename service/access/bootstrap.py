"""First keys, tenants, and when the API may listen beyond this machine."""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable, Sequence
from pathlib import Path

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.access.keys import Keyring
from service.access.principal import Principal, Scope
from service.records.audit import record
from service.settings import Settings
from service.store.database import Store
from service.store.durable import write_durably
from service.store.models import DEFAULT_TENANT, ApiKey, Tenant

# Stands for a key id in the audit log when somebody on the machine itself had no key
OPERATOR = "operator"
# Metrics and workers are the whole service's, not a tenant's
OF_TENANTS = frozenset(Scope) - {Scope.METRICS}


class OpenDoorError(Exception):
    """The API would listen to other machines while nothing protects it."""


def prepare(store: Store, keyring: Keyring, settings: Settings) -> None:
    """Bring the tables up to date and make sure that somebody, but not everybody, can come in.

    Raises
    ------
    OpenDoorError
        If the API is to listen beyond this machine and is not protected.
    UnfinishedRestoreError
        If a restore was interrupted.
    """
    store.database.refuse_unfinished()
    store.database.migrate()
    if is_loopback(settings.host):
        admin_key(store, keyring, settings, only_first=True)
    else:
        _refuse_open_door(store, settings)


def admin_key(store: Store, keyring: Keyring, settings: Settings, *, only_first: bool) -> Path:
    """Make a key that may do everything and write it to ``settings.admin_key``, mode 0600.

    ``only_first`` makes none if the default tenant has keys already.
    """
    path = settings.admin_key
    with store.write() as session:
        # two API processes that start together: one makes the key
        session.get_one(Tenant, DEFAULT_TENANT, with_for_update=True)
        known = select(ApiKey.id).where(ApiKey.tenant_id == DEFAULT_TENANT)
        if only_first and session.scalars(known.limit(1)).first():
            return path
        _mint(session, keyring, DEFAULT_TENANT, Scope, path)
    return path


def add_tenant(store: Store, keyring: Keyring, name: str, key: Path, **quotas: int | None) -> str:
    """Add a tenant, and its first key to the file ``key``, mode 0600; returns its id."""
    with store.write() as session:
        session.add(tenant := Tenant(name=name, **quotas))
        session.flush()
        _mint(session, keyring, tenant.id, OF_TENANTS, key)
    return tenant.id


def tenant_key(store: Store, keyring: Keyring, tenant_id: str, key: Path) -> bool:
    """Make a key for a tenant that has none left, to the file ``key``, mode 0600.

    It may do everything of the tenant's. False: there is no such tenant.
    """
    with store.write() as session:
        if session.get(Tenant, tenant_id) is None:
            return False
        _mint(session, keyring, tenant_id, OF_TENANTS, key)
    return True


def list_tenants(session: Session) -> Sequence[Tenant]:
    """Return the tenants, the oldest first."""
    return session.scalars(select(Tenant).order_by(Tenant.created_at)).all()


def change_tenant(session: Session, tenant_id: str, **limits: int | None) -> bool:
    """Set a tenant's quotas or days of retention; False: there is no such tenant."""
    tenant = session.get(Tenant, tenant_id, with_for_update=True)
    if tenant is None:
        return False
    for name, most in limits.items():
        setattr(tenant, name, most)
    return True


def _mint(
    session: Session, keyring: Keyring, tenant_id: str, scopes: Iterable[Scope], path: Path
) -> None:
    key, text = keyring.mint(session, tenant_id, "admin", scopes)
    record(session, Principal(tenant_id, OPERATOR, frozenset()), "key.created", key.id)
    write_durably(path, text.encode())


def _refuse_open_door(store: Store, settings: Settings) -> None:
    if "allowed_hosts" not in settings.model_fields_set:
        raise OpenDoorError(
            f"to listen on {settings.host}, set MYOFACE_ALLOWED_HOSTS to the names by which "
            'clients reach this service, for example ["myoface.studio.example"]'
        )
    with store.read() as session:
        if session.scalars(select(ApiKey.id).limit(1)).first() is None:
            raise OpenDoorError(
                f"to listen on {settings.host}, make a key first: myoface admin-key"
            )


def is_loopback(host: str) -> bool:
    """Return whether only this machine reaches ``host``, a name or an address."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
