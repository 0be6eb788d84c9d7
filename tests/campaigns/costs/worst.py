"""The worst megabyte of each kind's options and of each route, and what refusing it costs."""

from __future__ import annotations

import gc
import itertools
import re
import time
from bisect import bisect_right
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import httpx

from solver.kinds import KINDS

MEGABYTE = 1024**2
MOST_SECONDS = 0.5
MOST_MB = 50
MOST_ANSWER = 64 * 1024
SOMEBODY = "8c1d3a52-0f4e-4c5b-9b39-1f3a4f1f6c11"
JSON = {"Content-Type": "application/json"}
# Of the requests that are not jobs or batches, above which they are refused unread
SMALL = 64 * 1024

Filling = tuple[str, Callable[[int], str], str]

# What fills a place in a document: begins it, an item of it, ends it
FILLINGS: dict[str, Filling] = {
    "strangers": ("{", lambda number: f'"{number}":1', "}"),
    "long names": ("{", lambda number: f'"{"n" * 10_000}{number}":1', "}"),
    "one name": ("{", lambda _: f'"{"n" * 1_000_000}":1', "}"),
    "empty lists": ("[", lambda _: "[]", "]"),
    "empty objects": ("[", lambda _: "{}", "]"),
    "small objects": ("[", lambda _: '{"a":1,"b":2}', "]"),
    "lists of numbers": ("[", lambda _: "[1,2,3,4,5,6,7,8,9,0]", "]"),
    "numbers": ("[", lambda _: "1", "]"),
    "long numbers": ("[", lambda _: "9" * 4000, "]"),
    "long fractions": ("[", lambda _: "0." + "1" * 4000, "]"),
    "a text": ('"', lambda _: "x" * 1000, '"'),
    "escapes": ('"', lambda _: "\\ud83d\\ude00" * 100, '"'),
}
# Places of scenes that have lists and maps
PLACES = {
    "muscles": ('{"scene":{"keys":[{"time":0,"muscles":', "}]}}"),
    "expressions": ('{"scene":{"keys":[{"time":0,"expressions":', "}]}}"),
    "keys": ('{"scene":{"keys":', "}}"),
    "head": ('{"scene":{"head":', "}}"),
    "edits": ('{"scene":{"edits":', "}}"),
    "forces": ('{"scene":{"forces":', "}}"),
    "objects": ('{"scene":{"objects":', "}}"),
    "paths": ('{"scene":{"objects":[{"path":', "}]}}"),
    "recording": ('{"scene":{"recording":', "}}"),
}
EXPRESSIONS = ",".join(f'"e{number}":0.5' for number in range(9))
MUSCLES = ",".join(f'"muscle of a long name {number}":[1,0,0,1,0,1]' for number in range(3))
FAULTS = ",".join(f'"m{number}":9' for number in range(12))
# Scenes of nearly as many keys as may be, or of more, that are as they should be but for their end
SOUND: dict[str, Filling] = {
    "sound keys": (
        '{"scene":{"keys":[',
        lambda number: f'{{"time":{number / 100},"expressions":{{{EXPRESSIONS}}}}}',
        "]}}",
    ),
    "sound keys, then a fault": (
        '{"scene":{"keys":[',
        lambda number: f'{{"time":{number / 100},"expressions":{{{EXPRESSIONS}}}}}',
        ',{"time":-1}]}}',
    ),
    "sound muscles, then a fault": (
        '{"scene":{"keys":[',
        lambda number: f'{{"time":{number / 100},"muscles":{{{MUSCLES}}}}}',
        ',{"time":-1}]}}',
    ),
    "too many sound keys": (
        '{"scene":{"keys":[',
        lambda number: f'{{"time":{number / 100},"jaw":{{"open_deg":1}}}}',
        "]}}",
    ),
    "keys with a fault each": (
        '{"scene":{"keys":[',
        lambda number: f'{{"time":{number / 100},"muscles":{{{FAULTS}}}}}',
        "]}}",
    ),
}


@dataclass(frozen=True)
class Order:
    """A request that costs as much as its sender could think of; ``about`` is a kind or a route."""

    about: str
    how: str
    method: str
    path: str
    body: bytes

    def send(self, http: httpx.Client) -> httpx.Response:
        """Send it."""
        return http.request(self.method, self.path, content=self.body, headers=JSON)


@dataclass(frozen=True)
class Cost:
    """Processor time, growth of memory, and the answer's bytes."""

    order: Order
    status: int
    seconds: float
    megabytes: float
    answer: int

    @property
    def is_small(self) -> bool:
        """Whether it is what refusing may cost."""
        within = self.seconds <= MOST_SECONDS and self.megabytes <= MOST_MB
        return within and self.answer <= MOST_ANSWER and 400 <= self.status < 500

    def __str__(self) -> str:
        about = f"{self.order.about}, {self.order.how}: answer {self.status}"
        return f"{about}, {self.seconds:.2f} s, {self.megabytes:.0f} MB, {self.answer} bytes"


def fill(start: str, item: Callable[[int], str], end: str, size: int = MEGABYTE) -> bytes:
    """Return a document of ``size`` bytes less a little, of items."""
    items, ends = _items(item)
    count = bisect_right(ends, size - 1000 - len(start) - len(end))
    return f"{start}{','.join(items[:count])}{end}".encode()


@cache
def _items(item: Callable[[int], str]) -> tuple[list[str], list[int]]:
    """Return the items of a megabyte, and where each would end behind the others and a comma."""
    items: list[str] = []
    ends = [0]
    for number in itertools.count():
        if ends[-1] > MEGABYTE:
            return items, ends[1:]
        items.append(item(number))
        ends.append(ends[-1] + len(items[-1]) + 1)
    raise AssertionError("numbers do not end")


def places_of(kind: str) -> list[str]:
    """Return the places of a kind's options that are filled, one of them the options themselves."""
    has_scene = "scene" in KINDS[kind].options.model_fields
    return ["options", *(PLACES if has_scene else ()), *(SOUND if has_scene else ())]


def orders_of(kind: str, place: str, subject_id: str) -> Iterator[Order]:
    """Give the requests for a job of a kind, with a place of its options filled in every way."""
    begin = f'{{"kind":"{kind}","subject_id":"{subject_id}","options":'
    fillings, (head, tail) = FILLINGS, PLACES.get(place, ("", ""))
    if place in SOUND:
        fillings = {"": SOUND[place]}
    for name, (start, item, end) in fillings.items():
        body = fill(f"{begin}{head}{start}", item, f"{end}{tail}}}")
        yield Order(kind, f"{place} {name}".strip(), "POST", "/v1/jobs", body)


def orders_of_routes(document: dict[str, Any]) -> Iterator[Order]:
    """Give the requests to every route of an OpenAPI document that takes JSON."""
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            if "application/json" not in operation.get("requestBody", {}).get("content", {}):
                continue
            about = f"{method.upper()} {path}"
            place = re.sub(r"\{\w+\}", SOMEBODY, path)
            for size in (MEGABYTE, SMALL):
                for name, (start, item, end) in FILLINGS.items():
                    body = fill(start, item, end, size)
                    how = f"{size // 1024} KB of {name}"
                    yield Order(about, how, method.upper(), place, body)


def measure(order: Order, http: httpx.Client) -> Cost:
    """Send an order to a service in this process, and return what it cost."""
    gc.freeze()  # as the service does when it starts: what tests hold is no part of the cost
    try:
        Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
        before = _memory("VmRSS")
        started = time.process_time()  # of all threads
        answer = order.send(http)
        seconds = time.process_time() - started
        megabytes = _memory("VmHWM") - before
    finally:
        gc.unfreeze()
    return Cost(order, answer.status_code, seconds, megabytes, len(answer.content))


def _memory(name: str) -> float:
    found = re.search(rf"{name}:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert found
    return int(found[1]) / 1024
