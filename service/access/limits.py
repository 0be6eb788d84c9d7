"""Limits of a tenant and a key: stored bytes, queued jobs, requests a minute, open connections.

A tenant's row holds its quotas; null is none. Requests are counted by a token bucket a key and one
a tenant, in the broker for all API processes. While the broker is away each process counts by
itself: a limit that is kept loosely is better than a service that stops. Connections that last long
are counted in each process, which has few of them for all tenants.
"""

from __future__ import annotations

import math
import threading
import time
from collections import Counter, OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import redis
import structlog
from sqlalchemy import func, select
from sqlalchemy.orm import Session
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.access.principal import Principal
from service.errors import Problem
from service.queue.states import HELD, State
from service.queue.wakeups import connect
from service.store.models import Job, Tenant
from service.store.tenancy import own_tenant
from service.store.usage import stored_bytes

ASK_AGAIN = "60"
# Jobs of a tenant without a quota of its own that wait
MOST_QUEUED = 10_000

# A token of each bucket, or of none; `ARGV` has what each holds, and is refilled with in a minute
SCRIPT = """
local moment = redis.call('TIME')
local now = moment[1] + moment[2] / 1000000
local allowed, left = 1, {}
for i, key in ipairs(KEYS) do
  local most = tonumber(ARGV[i])
  local kept = redis.call('HMGET', key, 'tokens', 'at')
  local tokens = tonumber(kept[1]) or most
  left[i] = math.min(most, tokens + math.max(0, now - (tonumber(kept[2]) or now)) * most / 60)
  if left[i] < 1 then allowed = 0 end
end
for i, key in ipairs(KEYS) do
  left[i] = left[i] - allowed
  redis.call('HSET', key, 'tokens', tostring(left[i]), 'at', tostring(now))
  redis.call('EXPIRE', key, 61)
  left[i] = tostring(left[i])
end
return {allowed, unpack(left)}
"""
# Seconds that a request waits for the broker
PATIENCE = 0.25
# Seconds for which a broker that did not answer is not asked
TRY_AGAIN = 5.0
# Buckets of a kind that a process keeps, and keys that it remembers
MOST_BUCKETS = 10_000
# `Retry-After` of a refused connection, in seconds
COME_BACK = "5"

log = structlog.get_logger()


def check_bytes(session: Session, size: int) -> None:
    """Make room for a file of ``size`` bytes; two at a time wait for one another.

    Raises
    ------
    Problem
        413 for a file that does not fit, alone or beside what is stored: waiting makes no room.
    """
    tenant = own_tenant(session, lock=True)
    if tenant.max_bytes is None:
        return
    most = tenant.max_bytes
    if size > most:
        raise Problem(
            413, "quota.bytes", "the file is larger than the quota", expected=most, found=size
        )
    used = stored_bytes(session, tenant.id)
    if used + size > most:
        raise Problem(
            413,
            "quota.bytes",
            f"{used} of {most} bytes are in use: delete something first",
            expected=most,
            found=used + size,
        )


def check_queued(session: Session) -> None:
    """Make room for a job in the queue.

    Raises
    ------
    Problem
        429 if as many jobs wait as the tenant may have.
    """
    most = most_queued(own_tenant(session, lock=True))
    waiting = count_queued(session)
    if waiting >= most:
        problem = Problem(
            429,
            "quota.queued",
            f"{waiting} jobs wait already: let some end first",
            expected=most,
            found=waiting,
        )
        problem.headers = {"Retry-After": ASK_AGAIN}
        raise problem


def most_queued(tenant: Tenant) -> int:
    """Return how many of a tenant's jobs may wait."""
    return MOST_QUEUED if tenant.max_queued is None else tenant.max_queued


def count_queued(session: Session) -> int:
    """Return how many of the tenant's jobs wait."""
    return session.scalar(select(func.count(Job.id)).where(Job.state == State.QUEUED)) or 0


def count_running(session: Session) -> int:
    """Return how many of the tenant's jobs a worker has."""
    return session.scalar(select(func.count(Job.id)).where(Job.state.in_(HELD))) or 0


@dataclass(frozen=True)
class Verdict:
    """Decision on a request: ``left`` tokens of ``limit`` remain, refilled in a minute.

    ``owner`` is whose bucket it is, the key's or the tenant's: the one that has less left.
    """

    allowed: bool
    limit: int
    left: float
    owner: str = "key"

    @property
    def headers(self) -> dict[str, str]:
        """Headers that state the limit; the reset is when the bucket is full again."""
        refill = (self.limit - self.left) * 60 / self.limit
        return {
            "RateLimit-Limit": str(self.limit),
            "RateLimit-Remaining": str(int(self.left)),
            "RateLimit-Reset": str(math.ceil(refill)),
        }

    @property
    def wait(self) -> int:
        """Seconds until the next request may pass."""
        return max(1, math.ceil((1 - self.left) * 60 / self.limit))


class Rates:
    """The buckets of all keys and tenants, each with the tokens of a minute."""

    def __init__(self, broker_url: str, per_minute: int, tenant_per_minute: int) -> None:
        self._limits = {"key": per_minute, "tenant": tenant_per_minute}
        self._client = connect(broker_url, socket_timeout=PATIENCE, socket_connect_timeout=PATIENCE)
        self._take = self._client.register_script(SCRIPT)
        self._away_until = 0.0
        self._here = _Buckets()

    def take(self, key_id: str, tenant_id: str) -> Verdict:
        """Count a request of a tenant's key."""
        buckets = {f"myoface:rate:{key_id}": "key", f"myoface:rate:tenant:{tenant_id}": "tenant"}
        limits = [self._limits[owner] for owner in buckets.values()]
        allowed, left = self._count(list(buckets), limits)
        verdicts = zip(limits, left, buckets.values(), strict=True)
        return min(
            (Verdict(allowed, limit, tokens, owner) for limit, tokens, owner in verdicts),
            key=lambda verdict: verdict.left,
        )

    def _count(self, names: list[str], limits: list[int]) -> tuple[bool, list[float]]:
        if time.monotonic() >= self._away_until:
            try:
                allowed, *left = self._take(keys=names, args=limits)
                return bool(allowed), list(map(float, left))
            except (redis.RedisError, OSError) as error:
                self._away_until = time.monotonic() + TRY_AGAIN
                log.warning("rates.broker_away", error=str(error))
        return self._here.take(names, limits)

    def check(self, key_id: str, tenant_id: str) -> Verdict:
        """Count a request of a tenant's key that may pass.

        Raises
        ------
        Problem
            429 with ``Retry-After`` for one that may not.
        """
        verdict = self.take(key_id, tenant_id)
        if not verdict.allowed:
            problem = Problem(
                429,
                "request.rate",
                f"the {verdict.owner} has sent more than {verdict.limit} requests a minute",
                expected=verdict.limit,
            )
            problem.headers = {"Retry-After": str(verdict.wait), **verdict.headers}
            raise problem
        return verdict

    def close(self) -> None:
        """Close the connections to the broker."""
        self._client.close()


class _Buckets:
    """Buckets in this process, those used lately."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._kept: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def take(self, names: list[str], limits: list[int]) -> tuple[bool, list[float]]:
        """Take a token of each bucket, or of none."""
        moment = time.monotonic()
        with self._lock:
            left = []
            for name, most in zip(names, limits, strict=True):
                tokens, at = self._kept.pop(name, (float(most), moment))
                left.append(min(most, tokens + (moment - at) * most / 60))
            allowed = min(left) >= 1
            left = [tokens - allowed for tokens in left]
            for name, tokens in zip(names, left, strict=True):
                self._kept[name] = (tokens, moment)
            while len(self._kept) > MOST_BUCKETS:
                self._kept.popitem(last=False)
        return allowed, left


class KeyLookups:
    """Limit on the keys that an address tries, in this process: guessing costs looks into a table.

    Keys that have opened something lately, by their hash, are not counted; their tenant is known.
    """

    def __init__(self, per_minute: int) -> None:
        self._limit = per_minute
        self._tries = _Buckets()
        self._lock = threading.Lock()
        self._known: OrderedDict[str, str] = OrderedDict()

    def check(self, address: str, key_hash: str) -> None:
        """Count a key that comes from an address.

        Raises
        ------
        Problem
            429 if too many came that are not known here.
        """
        if self.known_tenant(key_hash) is not None:
            return
        allowed, [left] = self._tries.take([address], [self._limit])
        if not allowed:
            detail = f"more than {self._limit} keys a minute came from this address"
            problem = Problem(429, "request.rate", detail, expected=self._limit)
            problem.headers = {"Retry-After": str(Verdict(allowed, self._limit, left).wait)}
            raise problem

    def known_tenant(self, key_hash: str) -> str | None:
        """Return the tenant of a key that has opened something lately."""
        with self._lock:
            return self._known.get(key_hash)

    def note(self, key_hash: str, tenant_id: str | None) -> None:
        """Remember a key that opens something of a tenant's, forget one that opens nothing."""
        with self._lock:
            self._known.pop(key_hash, None)
            if tenant_id is not None:
                self._known[key_hash] = tenant_id
            while len(self._known) > MOST_BUCKETS:
                self._known.popitem(last=False)


class RateHeaders:
    """Middleware that adds the rate headers to each answer."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""

        async def send_with_rate(message: Message) -> None:
            verdict: Verdict | None = scope.get("state", {}).get("rate")
            if message["type"] == "http.response.start" and verdict is not None:
                told = verdict.headers.items()
                added = [(name.lower().encode(), value.encode()) for name, value in told]
                message["headers"] = [*message["headers"], *added]
            await send(message)

        await self._app(scope, receive, send_with_rate)


class ConnectionLimit:
    """Limit on the connections that a tenant, and each of its keys, holds open in this process.

    ``code``: problem code when the limit is hit. ``kind``: what is limited, for the message.
    """

    def __init__(self, code: str, kind: str, most_of_tenant: int, most_of_key: int) -> None:
        self._code = code
        self._kind = kind
        self._most_of_tenant = most_of_tenant
        self._most_of_key = most_of_key
        self._taken: Counter[tuple[str, ...]] = Counter()

    @contextmanager
    def hold(self, who: Principal) -> Iterator[None]:
        """Count a connection of ``who`` for as long as it lasts.

        Raises
        ------
        Problem
            429 if the tenant or the key has as many as it may.
        """
        limits = {
            ("key", who.tenant_id, who.key_id): self._most_of_key,
            ("tenant", who.tenant_id): self._most_of_tenant,
        }
        for owner, most in limits.items():
            if self._taken[owner] >= most:
                problem = Problem(
                    429,
                    self._code,
                    f"{most} {self._kind} are open for this {owner[0]} already",
                    expected=most,
                )
                problem.headers = {"Retry-After": COME_BACK}
                raise problem
        self._taken.update(limits.keys())
        try:
            yield
        finally:
            self._taken.subtract(limits.keys())
            self._taken = +self._taken  # those that nobody has any more are forgotten
