"""Refusing is cheap: the worst megabyte of every route and of every kind's options."""

from __future__ import annotations

import itertools
import json
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import pytest
from fastapi.testclient import TestClient

from service.app import create_app
from service.settings import Settings
from solver.kinds import KINDS
from tests.service_client import Studio, served

MEGABYTE = 1024**2
MOST_SECONDS, MOST_MB, MOST_ANSWER = 0.5, 50, 64 * 1024
SOMEBODY = "8c1d3a52-0f4e-4c5b-9b39-1f3a4f1f6c11"
JSON = {"Content-Type": "application/json"}


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    with served(Settings(data_dir=tmp_path_factory.mktemp("costs"))) as studio:
        studio.get("/v1/me")
        yield studio


def _full(start: str, item: Callable[[int], str], end: str) -> bytes:
    """Return a document of a megabyte less a little, of items."""
    items, size = [], len(start) + len(end)
    for number in itertools.count():
        text = item(number)
        size += len(text) + 1
        if size > MEGABYTE - 1000:
            return f"{start}{','.join(items)}{end}".encode()
        items.append(text)
    raise AssertionError


# What fills a place in a document: begins it, an item of it, ends it
FILLINGS = {
    "strangers": ("{", lambda number: f'"{number}":1', "}"),
    "long names": ("{", lambda number: f'"{"n" * 10_000}{number}":1', "}"),
    "one name": ("{", lambda number: f'"{"n" * 1_000_000}":1', "}"),
    "empty lists": ("[", lambda number: "[]", "]"),
    "empty objects": ("[", lambda number: "{}", "]"),
    "small objects": ("[", lambda number: '{"a":1,"b":2}', "]"),
    "numbers": ("[", lambda number: "1", "]"),
    "a text": ('"', lambda number: "x" * 1000, '"'),
}
# Places of scenes that have lists and maps
PLACES = {
    "options": ("", ""),
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


def _memory(name: str) -> float:
    found = re.search(rf"{name}:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert found
    return int(found[1]) / 1024


def _cheap(send: Callable[[], httpx.Response], what: str) -> httpx.Response:
    """Return an answer; fails if it took much time or memory, or is long."""
    Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
    before, started = _memory("VmRSS"), time.process_time()  # of all threads
    answer = send()
    seconds, megabytes = time.process_time() - started, _memory("VmHWM") - before
    told = f"{what}: {seconds:.2f} s, {megabytes:.0f} MB, {len(answer.content)} bytes"
    assert len(answer.content) <= MOST_ANSWER, told
    assert megabytes <= MOST_MB, told
    assert seconds <= MOST_SECONDS, told
    return answer


WITH_SCENES = [name for name, kind in KINDS.items() if "scene" in kind.options.model_fields]


@pytest.mark.parametrize(
    ("kind", "place"),
    [
        *((kind, "options") for kind in KINDS),
        *((kind, place) for kind in WITH_SCENES for place in PLACES if place != "options"),
    ],
)
def test_the_worst_megabyte_of_options(studio: Studio, kind: str, place: str) -> None:
    subject_id = studio.post("/v1/subjects", name="Alex")["id"]
    head, tail = PLACES[place]
    for name, (start, item, end) in FILLINGS.items():
        begin = f'{{"kind":"{kind}","subject_id":"{subject_id}","options":{head}{start}'
        body = _full(begin, item, f"{end}{tail}}}")
        answer = _cheap(
            lambda body=body: studio.http.post("/v1/jobs", content=body, headers=JSON),
            f"{kind} {place} {name}",
        )
        assert 400 <= answer.status_code < 500, answer.text


def test_the_worst_megabyte_of_every_route(studio: Studio) -> None:
    paths = studio.get("/openapi.json")["paths"]
    routes = [
        (method.upper(), re.sub(r"\{\w+\}", SOMEBODY, path))
        for path, operations in paths.items()
        for method, operation in operations.items()
        if "application/json" in operation.get("requestBody", {}).get("content", {})
    ]
    assert len(routes) > 12
    for (method, path), (name, (start, item, end)) in itertools.product(routes, FILLINGS.items()):
        body = _full(start, item, end)
        answer = _cheap(
            lambda body=body, method=method, path=path: studio.http.request(
                method, path, content=body, headers=JSON
            ),
            f"{method} {path} {name}",
        )
        assert 400 <= answer.status_code < 500, (method, path, name, answer.text)


def test_many_faults_are_counted_and_some_told(studio: Studio) -> None:
    keys = [{"time": -1, f"stranger{number}": 1} for number in range(500)]
    subject_id = studio.post("/v1/subjects", name="Alex")["id"]
    order = {"kind": "simulate", "subject_id": subject_id, "options": {"scene": {"keys": keys}}}
    errors = studio.http.post("/v1/jobs", json=order).json()["errors"]
    assert len(errors) == 21
    assert errors[-1]["message"].startswith("and at least ")
    strange = {"name": "Alex", **{f"stranger{number}": 1 for number in range(25)}}
    errors = studio.http.post("/v1/subjects", json=strange).json()["errors"]
    assert [len(errors), errors[-1]["message"]] == [21, "and 5 more"]


def test_long_words_are_cut(studio: Studio) -> None:
    subject_id = studio.post("/v1/subjects", name="Alex")["id"]
    options = {"n" * 5000: 1, "unit": "x" * 5000}
    order = {"kind": "check_scan", "subject_id": subject_id, "options": options}
    problem = studio.http.post("/v1/jobs", json=order).json()
    assert problem["code"] == "job.options"
    assert len(problem["detail"]) <= 400
    for fault in problem["errors"]:
        assert max(len(fault["where"]), len(fault["message"])) <= 203


def test_the_subject_is_looked_up_before_options_are_read(studio: Studio) -> None:
    order = {"kind": "simulate", "subject_id": SOMEBODY, "options": {"scene": {"keys": 1}}}
    answer = studio.http.post("/v1/jobs", json=order)
    assert (answer.status_code, answer.json()["code"]) == (404, "subject.unknown")


@pytest.mark.parametrize(
    ("key", "code"),
    [
        (None, "auth.missing"),
        ("Basic eDp5", "auth.missing"),
        ("Bearer myo_short", "auth.invalid"),
        ("Bearer " + "x" * 54, "auth.invalid"),
        ("Bearer myo_" + "0" * 50, "auth.invalid"),
    ],
)
def test_who_has_no_key_is_refused_before_the_body_is_read(
    tmp_path: Path, key: str | None, code: str
) -> None:
    headers = {"Authorization": key} if key else {}
    with TestClient(create_app(Settings(data_dir=tmp_path)), base_url="http://127.0.0.1") as http:
        for method, path in (
            ("POST", "/v1/jobs"),
            ("POST", "/healthz"),
            ("PATCH", f"/v1/uploads/{SOMEBODY}"),
            ("PUT", "/v1/nothing"),
        ):
            answer = http.request(
                method, path, content=json.dumps([[]] * 300_000), headers={**JSON, **headers}
            )
            assert (answer.status_code, answer.json()["code"]) == (401, code), path
            assert answer.headers["connection"] == "close"
            assert answer.headers["www-authenticate"] == "Bearer"


def test_bodies_are_as_large_as_their_route_needs(studio: Studio) -> None:
    text = b'{"name": "' + b"x" * 65_536 + b'"}'
    answer = studio.http.post("/v1/subjects", content=text, headers=JSON)
    assert (answer.status_code, answer.json()["expected"]) == (413, 65_536)
    order = {"kind": "check_scan", "subject_id": SOMEBODY, "options": {"x": "x" * 100_000}}
    assert studio.http.post("/v1/jobs", json=order).status_code == 404
