"""What the API refuses, and how it says so."""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select

from service.settings import Settings
from service.store.models import Job, Upload
from tests.service_client import Studio, served

NOBODY = str(uuid.uuid4())


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[Studio]:
    """An API without broker and workers: jobs stay queued."""
    settings = Settings(data_dir=tmp_path)
    with served(settings) as studio:
        yield studio


def test_jobs_that_can_not_be(studio: Studio) -> None:
    empty = studio.post("/v1/subjects", name="Nobody yet")["id"]
    subject = studio.subject()
    other = studio.subject()
    neutral = studio.get(f"/v1/subjects/{subject}/captures")["items"][0]["id"]
    foreign = studio.capture(other, "smile")
    cases: list[tuple[dict[str, Any], int, str, str]] = [
        ({"kind": "build_model", "subject_id": NOBODY}, 404, "subject.unknown", NOBODY),
        ({"kind": "build_model", "subject_id": empty}, 409, "subject.no_neutral", "neutral"),
        ({"kind": "bake_bread", "subject_id": subject}, 422, "job.kind", "bake_bread"),
        ({"kind": "fit_geometry", "subject_id": subject}, 409, "subject.no_model", "build_model"),
        ({"kind": "fit_activations", "subject_id": subject}, 422, "job.missing", "rig_id"),
        (
            {"kind": "fit_activations", "subject_id": subject, "rig_id": NOBODY},
            404,
            "rig.unknown",
            NOBODY,
        ),
        (
            {"kind": "build_model", "subject_id": subject, "captures": [foreign]},
            422,
            "job.unexpected",
            "captures",
        ),
        ({"kind": "build_model", "subject_id": "../x"}, 422, "request.invalid", "an id is needed"),
        (
            {"kind": "build_model", "subject_id": subject, "option": {}},
            422,
            "request.invalid",
            "option",
        ),
    ]
    studio.pretend(studio.submit("build_model", subject), {"model.npz": "0" * 64})
    cases += [
        (
            {"kind": "fit_geometry", "subject_id": subject, "captures": [foreign]},
            404,
            "capture.unknown",
            foreign,
        ),
        (
            {"kind": "fit_geometry", "subject_id": subject, "captures": [neutral]},
            422,
            "capture.not_an_expression",
            "neutral",
        ),
        ({"kind": "fit_geometry", "subject_id": subject}, 422, "job.missing", "captures"),
    ]
    no_model = cases.pop(3)  # asked about the other subject, which has none
    cases.append(({**no_model[0], "subject_id": other}, *no_model[1:]))
    for body, status, code, named in cases:
        answer = studio.http.post("/v1/jobs", json=body)
        assert answer.headers["content-type"] == "application/problem+json"
        problem = answer.json()
        assert (answer.status_code, problem["code"]) == (status, code), problem
        assert named in problem["detail"], problem
    assert all(job["kind"] == "build_model" for job in studio.get("/v1/jobs")["items"])


def test_put_is_idempotent(studio: Studio) -> None:
    subject = studio.subject()
    path = f"/v1/jobs/{uuid.uuid4()}"
    body = {"kind": "build_model", "subject_id": subject}
    answers = [studio.http.put(path, json=body) for _ in range(3)]
    assert [answer.status_code for answer in answers] == [201, 200, 200]
    assert answers[0].json() == answers[2].json()
    other = studio.http.put(path, json={**body, "subject_id": studio.subject()})
    assert (other.status_code, other.json()["code"]) == (409, "job.conflict")
    assert len(studio.get("/v1/jobs")["items"]) == 1


def test_captures_that_can_not_be(studio: Studio) -> None:
    subject = studio.subject()
    half = studio.start_upload("half.obj", 10).rsplit("/", 1)[1]
    scan = studio.upload("a.obj", b"v 0 0 0")
    picture = studio.upload("a.png", b"PNG")
    cases = [
        ({"name": "smile", "role": "expression", "upload_id": NOBODY}, 404, "upload.unknown"),
        ({"name": "smile", "role": "expression", "upload_id": half}, 409, "upload.incomplete"),
        ({"name": "smile", "role": "expression", "upload_id": picture}, 422, "capture.format"),
        ({"name": "other", "role": "neutral", "upload_id": scan}, 409, "capture.neutral_exists"),
        ({"name": "neutral", "role": "expression", "upload_id": scan}, 409, "capture.name_taken"),
        ({"name": "Neutral", "role": "expression", "upload_id": scan}, 409, "capture.name_taken"),
        ({"name": "smile.", "role": "expression", "upload_id": scan}, 422, "capture.name"),
        ({"name": "a/b", "role": "expression", "upload_id": scan}, 422, "request.invalid"),
    ]
    for body, status, code in cases:
        answer = studio.http.post(f"/v1/subjects/{subject}/captures", json=body)
        assert (answer.status_code, answer.json()["code"]) == (status, code)
    assert len(studio.get(f"/v1/subjects/{subject}/captures")["items"]) == 1


def test_a_performance_is_for_a_sequence_alone(studio: Studio) -> None:
    subject = studio.subject()
    smile = studio.capture(subject, "smile")
    take = studio.performance(subject, "take")
    studio.pretend(studio.submit("build_model", subject), {"model.npz": "0" * 64})
    cases: list[tuple[str, list[str], str]] = [
        ("check_scan", [take], "capture.is_performance"),
        ("fit_geometry", [smile, take], "capture.is_performance"),
        ("fit_sequence", [take], "job.missing"),
    ]
    for kind, captures, code in cases:
        body = {"kind": kind, "subject_id": subject, "captures": captures}
        answer = studio.http.post("/v1/jobs", json=body)
        assert (answer.status_code, answer.json()["code"]) == (422, code)
    scan = studio.upload("a.obj", b"v 0 0 0")
    array = studio.upload("a.npy", b"NUMPY")
    body = {"name": "b", "role": "expression", "upload_id": array}
    refused = studio.http.post(f"/v1/subjects/{subject}/captures", json=body).json()
    assert "in the role performance" in refused["detail"]
    for upload, registered, code in (
        (scan, True, "capture.format"),
        (array, False, "capture.is_performance"),
    ):
        body = {"name": "b", "role": "performance", "upload_id": upload, "registered": registered}
        answer = studio.http.post(f"/v1/subjects/{subject}/captures", json=body)
        assert (answer.status_code, answer.json()["code"]) == (422, code)


def test_markers_are_a_take_with_a_set_beside_it(studio: Studio) -> None:
    subject = studio.subject()
    smile = studio.capture(subject, "smile")

    def add(name: str, file: str) -> dict[str, Any]:
        body = {"name": name, "role": "markers", "upload_id": studio.upload(file, file.encode())}
        return dict(studio.http.post(f"/v1/subjects/{subject}/captures", json=body).json())

    take = add("take", "a.C3D")
    other = add("other", "b.csv")
    its_set = add("set", "markers.json")
    assert take["registered"]
    assert add("movie", "a.mov")["code"] == "capture.format"
    for captures, code in (
        ([], "job.missing"),
        ([its_set["id"]], "job.missing"),
        ([smile], "capture.not_markers"),
        ([take["id"], other["id"]], "job.one_take"),
    ):
        body = {"kind": "check_markers", "subject_id": subject, "captures": captures}
        answer = studio.http.post("/v1/jobs", json=body)
        assert (answer.status_code, answer.json()["code"]) == (422, code)
    body = {"kind": "check_scan", "subject_id": subject, "captures": [take["id"]]}
    assert studio.http.post("/v1/jobs", json=body).json()["code"] == "capture.is_markers"
    body = {"kind": "check_markers", "captures": [take["id"], its_set["id"]], "subject_id": subject}
    job = studio.post("/v1/jobs", **body)
    assert job["state"] == "queued"
    with studio.http.app.state.store.read() as session:  # type: ignore[attr-defined]
        inputs = session.get_one(Job, job["id"]).inputs
    assert [(each["role"], each["filename"]) for each in inputs] == [
        ("markers", "a.C3D"),
        ("marker_set", "markers.json"),
    ]


def test_a_subject_is_deleted_with_all_that_is_its_own(studio: Studio) -> None:
    subject = studio.subject()
    job = studio.submit("build_model", subject)
    busy = studio.http.delete(f"/v1/subjects/{subject}")
    assert (busy.status_code, busy.json()["job_ids"]) == (409, [job])
    assert studio.post(f"/v1/jobs/{job}/cancel", reason="over")["state"] == "canceled"
    again = studio.http.post(f"/v1/jobs/{job}/cancel", json={})
    assert (again.status_code, again.json()["code"]) == (409, "job.finished")
    assert studio.http.delete(f"/v1/subjects/{subject}").status_code == 204
    for path in (f"/v1/subjects/{subject}", f"/v1/jobs/{job}", f"/v1/jobs/{job}/events"):
        assert studio.http.get(path).status_code == 404
    with studio.http.app.state.store.read() as session:  # type: ignore[attr-defined]
        assert session.scalars(select(Upload)).all() == []


def test_a_deleted_scan_leaves_no_upload(studio: Studio) -> None:
    subject = studio.subject()
    smile = studio.capture(subject, "smile")
    assert studio.http.delete(f"/v1/subjects/{subject}/captures/{smile}").status_code == 204
    assert [each["name"] for each in studio.get(f"/v1/subjects/{subject}/captures")["items"]] == [
        "neutral"
    ]
    with studio.http.app.state.store.read() as session:  # type: ignore[attr-defined]
        assert [each.filename for each in session.scalars(select(Upload))] == [
            "neutral of Alex.obj"
        ]


def test_openapi_describes_every_route(studio: Studio) -> None:
    document = studio.get("/openapi.json")
    assert "HTTPValidationError" not in str(document)
    assert "code" in document["components"]["schemas"]["ProblemDocument"]["required"]
    for path, methods in document["paths"].items():
        for method, operation in methods.items():
            assert operation["summary"], (method, path)
            assert operation["tags"], (method, path)
            for status, answer in operation["responses"].items():
                if status >= "400" and path != "/readyz":
                    assert "application/problem+json" in answer["content"], (method, path, status)


def test_foreign_host_names_are_refused(studio: Studio) -> None:
    for host in ("evil.example", "evil:abc", "evil.example@127.0.0.1", ""):
        answer = studio.http.get("/healthz", headers={"Host": host})
        assert (answer.status_code, answer.json()["code"]) == (421, "request.host"), host
    assert studio.http.get("/healthz", headers={"Host": "LocalHost:8765"}).status_code == 200


@pytest.mark.parametrize(
    ("body", "status", "code"),
    [
        (b'{"name": "Alex"', 422, "request.json"),
        (b'{"name": "' + b"x" * 2_000_000 + b'"}', 413, "request.too_large"),
        (b'["Alex"]', 422, "request.invalid"),
        (b'{"name": " "}', 422, "request.invalid"),
    ],
)
def test_bodies_that_can_not_be(studio: Studio, body: bytes, status: int, code: str) -> None:
    headers = {"Content-Type": "application/json"}
    answer = studio.http.post("/v1/subjects", content=body, headers=headers)
    assert (answer.status_code, answer.json()["code"]) == (status, code)


def test_a_fault_names_the_member_or_parameter(studio: Studio) -> None:
    scan = {"name": "a/b", "role": "expression", "upload_id": NOBODY}
    for answer, detail in (
        (studio.http.post("/v1/subjects", json={"name": " "}), "name: String should have at least"),
        (studio.http.post("/v1/subjects", json={}), "name: this is needed, and it is not there"),
        (
            studio.http.post("/v1/subjects", json={"name": "x", "nam": 1}),
            "nam: there is no such member",
        ),
        (
            studio.http.post("/v1/batches", json={"subject_id": NOBODY, "captures": [scan]}),
            "captures[0].name: a name is needed",
        ),
        (studio.http.get("/v1/jobs?limit=0"), "limit: Input should be greater"),
        (studio.http.get("/v1/jobs/x"), "job_id: an id is needed"),
    ):
        assert answer.json()["detail"].startswith(detail), answer.text
        where = answer.json()["errors"][0]["where"]
        assert where == detail.partition(":")[0]


def test_options_are_checked_before_the_job_is_queued(studio: Studio) -> None:
    subject = studio.subject()
    unknown = "options.edge: build_model has no such option; it has edge_mm"
    for options, code, named in (
        ('{"edge_mm": NaN}', "request.json", "NaN"),
        ('{"edge_mm": "\\ud800"}', "request.json", ""),
        ('{"edge": 9}', "job.options", unknown),
    ):
        body = f'{{"kind": "build_model", "subject_id": "{subject}", "options": {options}}}'
        headers = {"Content-Type": "application/json"}
        answer = studio.http.post("/v1/jobs", content=body, headers=headers)
        assert (answer.status_code, answer.json()["code"]) == (422, code)
        assert named in answer.json()["detail"]
    assert studio.get("/v1/jobs")["items"] == []


def test_lists_go_on_where_a_page_ends(studio: Studio) -> None:
    names = [f"subject {number}" for number in range(5)]
    ids = [studio.post("/v1/subjects", name=name)["id"] for name in names]
    first = studio.get("/v1/subjects?limit=2")
    studio.http.delete(f"/v1/subjects/{ids[3]}")  # the last that was shown
    second = studio.get(f"/v1/subjects?limit=2&cursor={first['next']}")
    third = studio.get(f"/v1/subjects?limit=2&cursor={second['next']}")
    pages = [[each["name"] for each in page["items"]] for page in (first, second, third)]
    assert pages == [names[:2:-1], names[2:0:-1], names[:1]]
    assert third["next"] is None
    for cursor in ("x", "bm9uc2Vuc2UgeA==", "ä"):
        answer = studio.http.get("/v1/jobs", params={"cursor": cursor})
        assert (answer.status_code, answer.json()["code"]) == (422, "request.cursor")
