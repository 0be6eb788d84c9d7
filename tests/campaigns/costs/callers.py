"""Eight callers who send the dearest requests again and again."""

from __future__ import annotations

import itertools
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import httpx

from tests.campaigns.costs.worst import Order

CALLERS = 8


def call(url: str, key: str, orders: Sequence[Order], seconds: float) -> Counter[int]:
    """Send orders by eight connections for some seconds; returns the answers by their status."""
    headers = {"Authorization": f"Bearer {key}"}
    with httpx.Client(base_url=url, headers=headers, trust_env=False) as http:
        subject = http.post("/v1/subjects", json={"name": "Alex"}).json()["id"]
    mine = [replace(order, body=_for(subject, order.body)) for order in orders]
    until = time.monotonic() + seconds

    def one(first: int) -> Counter[int]:
        answers: Counter[int] = Counter()
        with httpx.Client(base_url=url, headers=headers, timeout=60, trust_env=False) as http:
            for order in itertools.cycle(mine[first:] + mine[:first]):
                if time.monotonic() > until:
                    return answers
                answers[order.send(http).status_code] += 1
        return answers

    with ThreadPoolExecutor(CALLERS) as callers:
        return sum(callers.map(one, range(CALLERS)), Counter[int]())


def _for(subject: str, body: bytes) -> bytes:
    """Return an order's body with another subject."""
    head, mark, rest = body.partition(b'"subject_id":"')
    return head + mark + subject.encode() + rest[len(subject) :]
