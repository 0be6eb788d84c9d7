"""How fast a key may ask: a token bucket a key, in the broker for all API processes.

While the broker is away each process counts by itself: a limit that is kept loosely is better than
a service that stops.
"""

from __future__ import annotations

import math
import threading
import time
from collections import OrderedDict
from dataclasses import dataclass

import redis
import structlog
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.errors import Problem
from service.store.queue import connect

SCRIPT = """
local moment = redis.call('TIME')
local now = moment[1] + moment[2] / 1000000
local most, rate = tonumber(ARGV[1]), tonumber(ARGV[2])
local kept = redis.call('HMGET', KEYS[1], 'tokens', 'at')
local tokens = tonumber(kept[1]) or most
tokens = math.min(most, tokens + math.max(0, now - (tonumber(kept[2]) or now)) * rate)
local allowed = tokens >= 1
if allowed then tokens = tokens - 1 end
redis.call('HSET', KEYS[1], 'tokens', tostring(tokens), 'at', tostring(now))
redis.call('EXPIRE', KEYS[1], math.ceil(most / rate) + 1)
return {allowed and 1 or 0, tostring(tokens)}
"""
PATIENCE = 0.25
"""Seconds that a request waits for the broker."""
TRY_AGAIN = 5.0
"""Seconds for which a broker that did not answer is not asked."""
MOST_KEYS = 10_000
"""Keys whose buckets a process keeps while the broker is away."""

log = structlog.get_logger()


@dataclass(frozen=True)
class Verdict:
    """Whether a request may pass; ``left`` tokens of ``limit`` remain, refilled in a minute."""

    allowed: bool
    limit: int
    left: float

    @property
    def headers(self) -> dict[str, str]:
        """What a caller is told of its limit; the reset is when its bucket is full again."""
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
    """The buckets of all keys: each holds ``per_minute`` tokens and is refilled in a minute."""

    def __init__(self, broker_url: str, per_minute: int) -> None:
        self._per_minute = per_minute
        self._client = connect(broker_url, socket_timeout=PATIENCE, socket_connect_timeout=PATIENCE)
        self._take = self._client.register_script(SCRIPT)
        self._away_until = 0.0
        self._here = _Buckets(per_minute)

    def take(self, key_id: str) -> Verdict:
        """Count a request of a key."""
        if time.monotonic() >= self._away_until:
            try:
                arguments = [self._per_minute, self._per_minute / 60]
                allowed, left = self._take(keys=[f"myoface:rate:{key_id}"], args=arguments)
                return Verdict(bool(allowed), self._per_minute, float(left))
            except (redis.RedisError, OSError) as error:
                self._away_until = time.monotonic() + TRY_AGAIN
                log.warning("rates.broker_away", error=str(error))
        return self._here.take(key_id)

    def check(self, key_id: str) -> Verdict:
        """Count a request of a key that may pass.

        Raises
        ------
        Problem
            429 with ``Retry-After`` for one that may not.
        """
        verdict = self.take(key_id)
        if not verdict.allowed:
            problem = Problem(
                429,
                "request.rate",
                f"the key has sent more than {verdict.limit} requests a minute",
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

    def __init__(self, per_minute: int) -> None:
        self._per_minute = per_minute
        self._lock = threading.Lock()
        self._kept: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def take(self, key_id: str) -> Verdict:
        moment, most = time.monotonic(), float(self._per_minute)
        with self._lock:
            tokens, at = self._kept.pop(key_id, (most, moment))
            tokens = min(most, tokens + (moment - at) * most / 60)
            allowed = tokens >= 1
            tokens -= allowed
            self._kept[key_id] = (tokens, moment)
            if len(self._kept) > MOST_KEYS:
                self._kept.popitem(last=False)
        return Verdict(allowed, self._per_minute, tokens)


class RateHeaders:
    """Tells a caller with each answer how much of its rate is left."""

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
