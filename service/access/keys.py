"""API keys: made once, told once, kept as a keyed hash.

``myo_`` + 12 characters that name the key + 32 secret ones (190 bits) + 6 of a checksum, by which
a mistyped key is known without a look into the table and scanners for leaked secrets can be sure.
"""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
import string
import threading
import zlib
from collections.abc import Iterable
from datetime import datetime, timedelta

from sqlalchemy import ColumnElement, func, or_, select, update
from sqlalchemy.orm import Session

from service import paging
from service.access.limits import KeyLookups
from service.access.principal import Principal, Scope, unauthorized_problem
from service.access.schemas import NewKey
from service.background import Background
from service.errors import Problem, not_found
from service.paging import Slice
from service.store.database import Store, clock
from service.store.models import ApiKey
from service.store.tenancy import own_tenant

LETTERS = string.digits + string.ascii_uppercase + string.ascii_lowercase
KEY = re.compile(r"(myo_([0-9A-Za-z]{12})[0-9A-Za-z]{32})([0-9A-Za-z]{6})")
# Living keys of a tenant
MOST_TENANT_KEYS = 100
# Resolution of a key's `last_used_at`: one write a minute, not one a request
USED_EVERY = timedelta(minutes=1)
# Seconds between the writes of all that was used
EVERY = 1.0


class LastUses(Background):
    """Write down, best effort, when keys were last used.

    A database that is full or busy costs a note, never a request: the key's next use makes another.
    """

    def __init__(self, store: Store) -> None:
        super().__init__("last-uses", EVERY)
        self._store = store
        self._noted: dict[str, datetime] = {}
        self._lock = threading.Lock()

    def note(self, key_id: str, moment: datetime) -> None:
        """Remember that a key was used."""
        with self._lock:
            self._noted[key_id] = moment

    def _round(self) -> None:
        with self._lock:
            noted = self._noted
            self._noted = {}
        if not noted:
            return
        with self._store.write() as session:
            for key_id, moment in noted.items():
                changed = update(ApiKey).where(ApiKey.id == key_id).values(last_used_at=moment)
                session.execute(changed)


class Keyring:
    """The keys of a store, hashed with ``secret`` (bytes, the same in every API process)."""

    def __init__(self, store: Store, secret: bytes, lookups: KeyLookups | None = None) -> None:
        self._store = store
        self._lookups = lookups
        self.uses = LastUses(store)
        self._pepper = hmac.digest(secret, b"api keys", "sha256")

    def mint(
        self,
        session: Session,
        tenant_id: str,
        name: str,
        scopes: Iterable[Scope],
        expires_at: datetime | None = None,
    ) -> tuple[ApiKey, str]:
        """Add a key; returns its row and its text, which cannot be had again."""
        key_id = _letters(12)
        body = f"myo_{key_id}{_letters(32)}"
        text = body + _checksum(body)
        key = ApiKey(
            id=key_id,
            tenant_id=tenant_id,
            name=name,
            hash=self._hash(text),
            scopes=sorted(scopes),
            created_at=clock(session),
            expires_at=expires_at,
        )
        session.add(key)
        session.flush()
        return key, text

    def verify(self, text: str, address: str = "") -> Principal:
        """Return whose key ``text`` is, which came from ``address``.

        Raises
        ------
        Problem
            401 for what is no key, is not known here, was revoked or has expired; 429 if the
            address has tried too many.
        """
        key_id = check_text(text)
        key_hash = self._hash(text)
        if self._lookups is None:
            return self._look_up(key_id, key_hash)
        self._lookups.check(address, key_hash)
        try:
            who = self._look_up(key_id, key_hash)
        except Problem:
            self._lookups.note(key_hash, None)
            raise
        self._lookups.note(key_hash, who.tenant_id)
        return who

    def known_tenant(self, text: str) -> str | None:
        """Return the tenant of a key that has worked here lately; asks no table."""
        return None if self._lookups is None else self._lookups.known_tenant(self._hash(text))

    def _look_up(self, key_id: str, key_hash: str) -> Principal:
        with self._store.read() as session:
            key = session.get(ApiKey, key_id)
            moment = clock(session)
        if key is None or not hmac.compare_digest(key.hash, key_hash):
            raise unauthorized_problem("auth.invalid", "this service does not know the API key")
        if key.revoked_at is not None and key.revoked_at <= moment:
            raise unauthorized_problem("auth.expired", "the API key was revoked")
        if key.expires_at is not None and key.expires_at <= moment:
            raise unauthorized_problem("auth.expired", "the API key has expired")
        if key.last_used_at is None or moment - key.last_used_at > USED_EVERY:
            self.uses.note(key.id, moment)
        return Principal(key.tenant_id, key.id, frozenset(key.scopes))

    def _hash(self, text: str) -> str:
        return hmac.new(self._pepper, text.encode(), hashlib.sha256).hexdigest()


def check_text(text: str) -> str:
    """Return the id of a key of the right form, which nobody need know; asks no table.

    Raises
    ------
    Problem
        401 for what is no key.
    """
    match = KEY.fullmatch(text)
    if match is None or not hmac.compare_digest(_checksum(match[1]), match[3]):
        raise unauthorized_problem("auth.invalid", "that is no API key: it is mistyped or cut off")
    return match[2]


def _letters(count: int) -> str:
    return "".join(secrets.choice(LETTERS) for _ in range(count))


def _checksum(body: str) -> str:
    rest = zlib.crc32(body.encode())
    digits = ""
    for _ in range(6):
        rest, digit = divmod(rest, len(LETTERS))
        digits = LETTERS[digit] + digits
    return digits


def create(session: Session, keyring: Keyring, new: NewKey, who: Principal) -> tuple[ApiKey, str]:
    """Make a key that may do no more than the caller's; returns it and its text.

    Raises
    ------
    Problem
        403 for a scope that the caller has not, 409 if the tenant has as many keys as it may.
    """
    _refuse_more(new.scopes, who)
    if new.expires_at is not None and new.expires_at <= clock(session):
        raise Problem(422, "key.expired", "a new key cannot have expired", field="expires_at")
    tenant = own_tenant(session, lock=True)  # two at a time would both count one less
    _refuse_many(session)
    return keyring.mint(session, tenant.id, new.name, set(new.scopes), new.expires_at)


def rotate(
    session: Session, keyring: Keyring, key_id: str, grace: int, who: Principal
) -> tuple[ApiKey, str]:
    """Make a key in place of one that goes on to work for ``grace`` seconds.

    The caller is told its text, and so must have its scopes. Raises a problem as :func:`create`:
    with a grace there is one key more for a while.
    """
    tenant = own_tenant(session, lock=True)
    old = get(session, key_id)
    moment = clock(session)
    _refuse_more(old.scopes, who)
    if _is_over(old, session):
        raise Problem(409, "key.over", "the key opens nothing any more", key_id=key_id)
    if grace:
        _refuse_many(session)
    fresh, text = keyring.mint(session, tenant.id, old.name, old.scopes, old.expires_at)
    until = moment + timedelta(seconds=grace)
    old.expires_at = min(filter(None, (old.expires_at, until)))
    return fresh, text


def _refuse_more(scopes: Iterable[str], who: Principal) -> None:
    beyond = sorted(map(str, set(scopes) - who.scopes))
    if beyond:
        detail = f"the key cannot grant what it may not do itself: {', '.join(beyond)}"
        raise Problem(403, "auth.scope", detail, expected=beyond, found=sorted(who.scopes))


def _refuse_many(session: Session) -> None:
    moment = clock(session)
    lasting = or_(ApiKey.expires_at.is_(None), ApiKey.expires_at > moment)
    living = select(func.count()).select_from(ApiKey).where(ApiKey.revoked_at.is_(None), lasting)
    if (session.scalar(living) or 0) >= MOST_TENANT_KEYS:
        detail = f"there are {MOST_TENANT_KEYS} keys already: revoke some first"
        raise Problem(409, "key.too_many", detail, expected=MOST_TENANT_KEYS)


def revoke(session: Session, key_id: str) -> None:
    """Take a key back; again is as good as once.

    Raises
    ------
    Problem
        409 for the last key that can make others.
    """
    own_tenant(session, lock=True)  # two at a time would each leave the other
    key = get(session, key_id)
    if _is_over(key, session):
        return
    if Scope.ADMIN in key.scopes and not other_admins(session, key):
        raise Problem(409, "key.last_admin", "no other key could make keys then", key_id=key_id)
    key.revoked_at = clock(session)


def _is_over(key: ApiKey, session: Session) -> bool:
    ends = [moment for moment in (key.revoked_at, key.expires_at) if moment is not None]
    return any(moment <= clock(session) for moment in ends)


def get(session: Session, key_id: str) -> ApiKey:
    """Return a key."""
    key = session.get(ApiKey, key_id)
    if key is None:
        raise not_found("key", key_id)
    return key


def newest(session: Session, limit: int, cursor: str | None) -> Slice[ApiKey]:
    """Return keys, newest first, also those that open nothing any more."""
    return paging.newest(session, select(ApiKey), limit, cursor)


def other_admins(session: Session, key: ApiKey) -> Iterable[str]:
    """Return the ids of the further keys that may make keys for as long as ``key`` could."""
    lasting: ColumnElement[bool] = ApiKey.expires_at.is_(None)
    if key.expires_at is not None:
        lasting = or_(lasting, ApiKey.expires_at >= key.expires_at)
    # one that has given way to another lives on for a grace only
    living = select(ApiKey).where(ApiKey.id != key.id, ApiKey.revoked_at.is_(None), lasting)
    return [other.id for other in session.scalars(living) if Scope.ADMIN in other.scopes]
