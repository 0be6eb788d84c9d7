"""What a studio calls its subjects, scans and rigs, and how it finds them again."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from myoface.names import DEVICES, as_name
from service.captures import service
from service.http import takes_gzip
from service.settings import Settings
from service.store.integrity import LostFileError
from service.templates.service import SKIN, count_vertices
from solver.kinds import BUILTIN_VERTICES
from tests.servers.production import Production
from tests.service_client import Studio, served

# The ways of packing that Python unpacks, by their names in the tests
PACKED = {"stored": zipfile.ZIP_STORED, "bzip2": zipfile.ZIP_BZIP2, "LZMA": zipfile.ZIP_LZMA}


@pytest.fixture(scope="module")
def studio(parts: Production | None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    """An API without broker and workers: jobs stay queued, and batches where they are."""
    with ExitStack() as stack:
        if parts is not None:
            patch = stack.enter_context(pytest.MonkeyPatch.context())
            for name, value in parts.fresh().items():
                patch.setenv(name, value)
        settings = Settings(data_dir=tmp_path_factory.mktemp("names"), beat=600.0)
        yield stack.enter_context(served(settings))


def change(studio: Studio, path: str, **body: Any) -> Any:
    answer = studio.http.patch(path, json=body)
    assert answer.status_code == 200, answer.text
    assert answer.json() == studio.get(path)
    return answer.json()


def refusal(studio: Studio, path: str, **body: Any) -> tuple[int, str, str]:
    """Return how a change is refused; what it was about is as before."""
    before = studio.get(path)
    answer = studio.http.patch(path, json=body)
    assert studio.get(path) == before
    problem = answer.json()
    return answer.status_code, problem["code"], problem["detail"]


def test_subjects_scans_and_rigs_are_called_and_found_as_the_studio_likes(studio: Studio) -> None:
    subject, rig_id = studio_with_rig(studio)
    (smile,) = (each for each in captures_of(studio, subject) if each["name"] == "smile")
    assert (smile["title"], smile["labels"]) == ("smile of Alex", {})
    paths = {
        "subject": f"/v1/subjects/{subject}",
        "capture": f"/v1/subjects/{subject}/captures/{smile['id']}",
        "rig": f"/v1/rigs/{rig_id}",
    }
    labels = {"session": "Monday: early", "actor": "17"}
    for what, path in paths.items():
        assert change(studio, path, labels=labels)["labels"] == labels
        found = change(studio, path, labels={"actor": None, "draft": "Jürgen's"})
        assert found["labels"] == {"session": "Monday: early", "draft": "Jürgen's"}
        entries = studio.get(f"/v1/audit?object_id={found['id']}")["items"]
        assert entries[0]["action"] == f"{what}.changed"
    assert change(studio, paths["subject"], name="  Zoë ")["name"] == "Zoë"
    scan = change(studio, paths["capture"], name="Smile_02", title="Lächeln 2")
    assert (scan["name"], scan["title"], scan["filename"]) == (
        "Smile_02",
        "Lächeln 2",
        "smile of Alex.obj",
    )
    assert change(studio, paths["rig"], name="hero")["name"] == "hero"
    assert change(studio, paths["rig"], name="")["name"] == ""
    other = studio.post("/v1/subjects", name="Alex", labels={"session": "Tuesday"})["id"]
    lists = {
        "/v1/subjects": subject,
        f"/v1/subjects/{subject}/captures": smile["id"],
        "/v1/rigs": rig_id,
    }
    for path, identifier in lists.items():
        for query, is_found in (
            ("label=session", True),
            ("label=session:Monday%3A%20early", True),
            ("label=session&label=draft:J%C3%BCrgen%27s", True),
            ("label=session:Monday", False),
            ("label=session&label=actor", False),
            ("label=session:", False),
        ):
            ids = {each["id"] for each in studio.get(f"{path}?{query}")["items"]}
            assert (identifier in ids) is is_found, (path, query)
    (found,) = studio.get("/v1/subjects?label=session:Tuesday")["items"]
    assert found["id"] == other
    for wrong in ("label=:x", "label=$.x:1", 'label=a"b:1', "label=" + "x" * 65):
        assert studio.http.get(f"/v1/subjects?{wrong}").status_code == 422, wrong


@pytest.mark.parametrize(
    ("change", "status", "code"),
    [
        ({"name": "   "}, 422, "request.invalid"),
        ({"name": None}, 422, "request.invalid"),
        ({"title": "  "}, 422, "request.invalid"),
        ({"name": "NEUTRAL"}, 409, "capture.name_taken"),
        ({"name": "grin."}, 422, "capture.name"),
        ({"name": "Com1"}, 422, "capture.name"),
        ({"name": "with blank"}, 422, "request.invalid"),
        ({"role": "neutral"}, 409, "capture.neutral_exists"),
        ({"role": "performance"}, 422, "request.invalid"),
        ({"labels": {"a b": "x"}}, 422, "request.invalid"),
        ({"labels": {"a": " "}}, 422, "request.invalid"),
        ({"labels": {"a": "x\u202ey"}}, 422, "request.invalid"),
        ({"labels": {f"l{i}": "x" for i in range(33)}}, 422, "labels.too_many"),
        ({"labels": {f"l{i}": "x" for i in range(65)}}, 422, "request.invalid"),
        ({"sha256": "0" * 64}, 422, "request.invalid"),
    ],
)
def test_a_change_that_cannot_be_is_refused_whole(
    studio: Studio, change: dict[str, Any], status: int, code: str
) -> None:
    subject = studio.subject()
    path = f"/v1/subjects/{subject}/captures/{studio.raw(subject, 'smile')}"
    assert refusal(studio, path, **{"title": "new", **change})[:2] == (status, code)


@pytest.mark.parametrize("name", ["smile.", "nul", "Com1", "NUL.v2"])
def test_a_scan_that_no_file_can_be_called_like_is_not_added(studio: Studio, name: str) -> None:
    assert as_name(name) != name  # the clients have the same rule
    assert DEVICES == service.DEVICES
    subject = studio.post("/v1/subjects", name="Alex")["id"]
    scan = {"name": name, "role": "expression", "upload_id": upload(studio, "smile")}
    for path, body in (
        (f"/v1/subjects/{subject}/captures", scan),
        ("/v1/batches", {"subject_id": subject, "then": [], "captures": [scan]}),
    ):
        answer = studio.http.post(path, json=body)
        assert (answer.status_code, answer.json()["code"]) == (422, "capture.name"), answer.text
    assert captures_of(studio, subject) == []


def test_a_scan_that_a_job_reads_keeps_its_name_and_role(studio: Studio) -> None:
    subject = studio.subject()
    smile = studio.raw(subject, "smile")
    path = f"/v1/subjects/{subject}/captures/{smile}"
    job = studio.submit("check_scan", subject, captures=[smile])
    for given in ({"name": "grin"}, {"name": "grin", "labels": {"a": "b"}}):
        status, code, words = refusal(studio, path, **given)
        assert (status, code) == (409, "subject.busy"), words
    change(studio, path, title="Grin", labels={"take": "2"}, name="smile", role="expression")
    studio.post(f"/v1/jobs/{job}/cancel")
    assert change(studio, path, name="grin")["name"] == "grin"
    batch = studio.post(
        "/v1/batches",
        subject_id=subject,
        then=[],
        captures=[{"name": "kiss", "role": "expression", "upload_id": upload(studio, "kiss")}],
    )
    for each in studio.get(f"/v1/jobs?batch_id={batch['id']}")["items"]:
        studio.post(f"/v1/jobs/{each['id']}/cancel")
    assert refusal(studio, path, name="smirk")[1] == "subject.busy"  # the batch may go on
    studio.post(f"/v1/batches/{batch['id']}/cancel")
    assert change(studio, path, name="smirk")["name"] == "smirk"


def test_a_scan_in_another_role_is_judged_anew(studio: Studio) -> None:
    subject = studio.post("/v1/subjects", name="Alex")["id"]
    scan = studio.raw(subject, "relaxed", "expression")
    path = f"/v1/subjects/{subject}/captures/{scan}"
    job = studio.submit("check_scan", subject, captures=[scan])
    studio.pretend(job, {}, {"verdict": "good", "findings": []})
    assert studio.get(path)["check"]["verdict"] == "good"
    assert change(studio, path, role="neutral")["check"] is None
    job = studio.submit("register_scan", subject, captures=[scan])
    studio.pretend(job, {"registered.ply": "a" * 64})
    assert studio.get(path)["registration"]["sha256"] == "a" * 64
    assert studio.submit("build_model", subject)
    for each in studio.get(f"/v1/jobs?state=queued&subject_id={subject}")["items"]:
        studio.post(f"/v1/jobs/{each['id']}/cancel")
    changed = change(studio, path, role="expression")
    assert (changed["check"]["verdict"], changed["registration"]) == ("good", None)


def test_a_performance_stays_one(studio: Studio) -> None:
    subject = studio.subject()
    take = studio.performance(subject, "take")
    path = f"/v1/subjects/{subject}/captures/{take}"
    assert studio.get(path)["registered"] is True
    assert refusal(studio, path, role="expression")[:2] == (422, "capture.is_performance")
    assert change(studio, path, name="take_1")["name"] == "take_1"


def test_a_scan_is_raw_unless_it_is_said_to_be_registered(studio: Studio) -> None:
    subject = studio.post("/v1/subjects", name="Alex")["id"]
    given = {"name": "neutral", "role": "neutral", "upload_id": upload(studio, "neutral")}
    added = studio.post(f"/v1/subjects/{subject}/captures", **given)
    assert added["registered"] is False
    answer = studio.http.post("/v1/jobs", json={"kind": "build_model", "subject_id": subject})
    assert answer.json()["code"] == "capture.not_registered"


@pytest.mark.parametrize("fault", [None, "busy", "taken", "twice"])
def test_a_batch_replaces_scans_in_one_step_or_not_at_all(
    studio: Studio, fault: str | None
) -> None:
    subject = studio.post("/v1/subjects", name="Alex")["id"]
    neutral = studio.raw(subject, "neutral", "neutral")
    smile = studio.raw(subject, "smile")
    kiss = studio.raw(subject, "kiss")
    new = [
        {"name": "rest", "role": "neutral", "replaces": neutral},
        {"name": "smile", "role": "expression", "replaces": smile},
        {"name": "frown", "role": "expression"},
    ]
    if fault == "busy":
        studio.submit("check_scan", subject, captures=[kiss])
    elif fault == "taken":
        new[2]["name"] = "Kiss"
    elif fault == "twice":
        new[2]["replaces"] = smile
    body = {
        "subject_id": subject,
        "then": ["register"],
        "captures": [{**each, "upload_id": upload(studio, each["name"])} for each in new],
    }
    before = captures_of(studio, subject)
    answers = [
        studio.http.post("/v1/batches", json=body, headers={"Idempotency-Key": subject})
        for _ in range(2)
    ]
    if fault:
        expected = {
            "busy": "subject.busy",
            "taken": "capture.name_taken",
            "twice": "capture.unknown",
        }
        assert [each.json()["code"] for each in answers] == [expected[fault]] * 2
        assert captures_of(studio, subject) == before
        assert studio.get(f"/v1/batches?subject_id={subject}")["items"] == []
        return
    assert [each.status_code for each in answers] == [201, 201]
    after = {each["name"]: each["id"] for each in captures_of(studio, subject)}
    assert set(after) == {"rest", "smile", "frown", "kiss"}
    assert (after["kiss"], smile in after.values()) == (kiss, False)
    receipts = {each["object_id"] for each in studio.get("/v1/deletions")["items"]}
    assert {neutral, smile} <= receipts
    for gone in (neutral, smile):
        actions = [each["action"] for each in studio.get(f"/v1/audit?object_id={gone}")["items"]]
        assert actions == ["capture.deleted", "capture.created"]


def test_lists_show_rigs_and_jobs_in_short(studio: Studio) -> None:
    subject, rig_id = studio_with_rig(studio)
    (rig,) = studio.get(f"/v1/rigs?subject_id={subject}")["items"]
    whole = studio.get(f"/v1/rigs/{rig_id}")
    assert {"summary", "artifacts"} == set(whole) - set(rig)
    assert {key: whole[key] for key in rig} == rig
    assert (rig["subject_name"], rig["verdict"], rig["mean_mm"]) == ("Alex", "usable", 0.25)
    assert rig["seconds"] >= 0
    for job in studio.get(f"/v1/jobs?subject_id={subject}")["items"]:
        whole = studio.job(job["id"])
        assert {"options", "memory_mb", "deadline_s"} == set(whole) - set(job)
        assert set(job["result"]) == {"rig_id", "verdict"}
        assert (job["subject_name"], job["seconds"] >= 0) == ("Alex", True)
    assert job["kind"] == "build_model"


def test_json_is_packed_for_who_can_unpack_it_and_files_are_not(studio: Studio) -> None:
    subject, rig_id = studio_with_rig(studio)
    for number in range(30):
        studio.raw(subject, f"scan_{number}")
    path = f"/v1/subjects/{subject}/captures"
    plain = studio.http.get(path, headers={"Accept-Encoding": "identity"})
    packed = studio.http.get(path)  # asks for gzip
    assert "content-encoding" not in plain.headers
    assert packed.headers["content-encoding"] == "gzip"
    assert packed.headers["vary"] == "Accept-Encoding"
    assert packed.json() == plain.json()
    assert int(packed.headers["content-length"]) * 4 < len(plain.content)
    file = studio.http.get(f"/v1/rigs/{rig_id}/artifacts/report.json")
    assert "content-encoding" not in file.headers
    assert len(file.content) == int(file.headers["content-length"]) > 2000
    assert "content-encoding" not in studio.http.get("/healthz").headers


@pytest.mark.parametrize(
    ("accepted", "takes"),
    [
        ("gzip", True),
        ("br, GZIP ; q=0.8", True),
        ("gzip;q=0.001", True),
        ("gzip;q=0", False),
        ("br;q=1.0, gzip; q=0.000, identity", False),
        ("x-gzip", False),
        ("", False),
    ],
)
def test_gzip_is_sent_to_nobody_who_refuses_it(accepted: str, takes: bool) -> None:
    assert takes_gzip(accepted) is takes


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        (None, 4866),
        ("no archive", None),
        ("no skin", None),
        ("cut off", None),
        ("a pickle", None),
        ("many members", None),
        ("bzip2", None),
        ("LZMA", None),
    ],
)
def test_a_template_s_vertices_are_counted(
    studio: Studio, fault: str | None, expected: int | None
) -> None:
    content = archive(fault)
    template = studio.post("/v1/templates", name="mine", upload_id=studio.upload("t.npz", content))
    assert template["vertices"] == expected
    assert studio.get("/v1/limits")["builtin_vertices"] == BUILTIN_VERTICES


class Failing:
    """A store whose file ends, or fails, after its list of members was read."""

    def __init__(self, content: bytes, error: Exception | None) -> None:
        self._content = content
        self._error = error

    def open(self, _sha256: str, start: int, end: int) -> Iterator[bytes]:
        name = self._content.index(SKIN.encode())
        if name < end and start < len(self._content) // 2:
            if self._error is not None:
                raise self._error
            self._content = self._content[: name + len(SKIN)]
        yield self._content[start:end]


@pytest.mark.parametrize("error", [None, LostFileError("ab", "damaged")])
def test_a_template_whose_file_fails_is_not_counted(error: Exception | None) -> None:
    content = archive("stored")
    files: Any = Failing(content, error)
    assert count_vertices(files, "ab", len(content)) is None


def archive(fault: str | None) -> bytes:
    """Return a template's file, as far as its count of vertices goes."""
    name = "bones_vertices" if fault == "no skin" else "skin_vertices"
    stream = io.BytesIO()
    if fault == "a pickle":
        np.savez_compressed(stream, skin_vertices=np.array([{}, 3], dtype=object))
    else:
        np.savez_compressed(stream, header=np.zeros(3), **{name: np.zeros((4866, 3))})
    if fault == "many members":
        with zipfile.ZipFile(stream, "a") as large:
            for number in range(20_000):
                large.writestr(f"{number:060}.npy", b"")
    if fault in PACKED:
        with zipfile.ZipFile(stream) as packed:
            skin = packed.read(SKIN)
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w", PACKED[fault]) as packed:
            packed.writestr(SKIN, skin)
    content = stream.getvalue()
    if fault == "no archive":
        return b"PK\5\6" + content[:-40]
    return content[:-40] if fault == "cut off" else content


def studio_with_rig(studio: Studio) -> tuple[str, str]:
    """Return a subject and its rig, which no worker has made."""
    subject = studio.subject()
    smile = studio.capture(subject, "smile")
    model = studio.submit("build_model", subject)
    files = studio.http.app.state.store.files  # type: ignore[attr-defined]
    report = files.put(Path(__file__)).sha256
    studio.pretend(model, {"model.npz": report}, {"tets": 3})
    fit = studio.submit("fit_geometry", subject, captures=[smile])
    summary = {"verdict": "usable", "train_mean_mm": 0.25, "warnings": ["x" * 100]}
    rig = {"subject_id": subject, "model_job_id": model, "summary": summary}
    studio.pretend(fit, {"rig.npz": report, "report.json": report}, summary, rig=rig)
    return subject, str(studio.job(fit)["result"]["rig_id"])


def captures_of(studio: Studio, subject: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = studio.get(f"/v1/subjects/{subject}/captures")["items"]
    return found


def upload(studio: Studio, name: str) -> str:
    return studio.upload(f"{name}.obj", f"# {name}".encode())
