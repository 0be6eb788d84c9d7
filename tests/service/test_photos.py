"""Photographs as captures: sent with what is known of them, chosen for jobs, deleted."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from PIL import Image

from service.errors import Problem
from service.jobs.inputs import Inputs, resolve
from service.jobs.schemas import NewJob
from service.settings import Settings
from service.store import deletion
from service.store.database import Store
from service.store.integrity import holders
from service.store.models import DEFAULT_TENANT
from solver import jobs
from solver.errors import InputError
from solver.jobs import Task
from solver.jobs.photos import read_photos
from solver.kinds import KINDS, Kind
from solver.progress import silent
from tests.service_client import Studio, served
from worker import solve

FIT = KINDS["fit_photo"]
NEUTRAL = Kind("long", ("photos", "template"), leaves="neutral", name="neutral_from_photos")
FACTS = json.dumps(
    {"landmarks": {"33": [20, 30], "263": [70, 30], "61": [35, 60], "291": [55, 60]}}
)


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[Studio]:
    with served(Settings(data_dir=tmp_path)) as studio:
        yield studio


def _picture(shade: int = 90) -> bytes:
    stream = BytesIO()
    Image.new("RGB", (96, 96), (shade, 80, 70)).save(stream, "JPEG")
    return stream.getvalue()


def _mask() -> bytes:
    stream = BytesIO()
    mask = Image.new("L", (96, 96))
    mask.paste(255, (0, 0, 96, 50))
    mask.save(stream, "PNG")
    return stream.getvalue()


MASK = _mask()


def _photo(
    studio: Studio, subject: str, name: str, facts: str | None = FACTS, mask: bytes | None = None
) -> str:
    marks = facts and studio.upload(f"{name}.json", facts.encode())
    body = {
        "name": name,
        "role": "photo",
        "upload_id": studio.upload(f"{name}.JPG", _picture(len(name))),
        "landmarks_upload_id": marks,
        "mask_upload_id": mask and studio.upload(f"{name}.png", mask),
    }
    return str(studio.post(f"/v1/subjects/{subject}/captures", **body)["id"])


def _resolve(studio: Studio, kind: Kind, subject: str, captures: list[str], **more: Any) -> Inputs:
    store: Store = studio.http.app.state.store  # type: ignore[attr-defined]
    new = NewJob(kind=kind.name, subject_id=subject, captures=captures, **more)
    with store.of(DEFAULT_TENANT).read() as session:
        return resolve(session, kind, new)


def test_a_photograph_comes_with_what_is_known_of_it(studio: Studio) -> None:
    subject = studio.post("/v1/subjects", name="Alex")["id"]
    photo = _photo(studio, subject, "smile")
    path = f"/v1/subjects/{subject}/captures/{photo}"
    seen = studio.get(path)
    assert (seen["role"], seen["registered"], seen["landmarks"]) == ("photo", True, "smile.json")
    assert seen["mask"] is None
    masked = _photo(studio, subject, "masked", mask=MASK)
    assert studio.get(f"/v1/subjects/{subject}/captures/{masked}")["mask"] == "masked.png"
    other = {"upload_id": studio.upload("better.json", b"{}")}
    assert studio.http.put(f"{path}/landmarks", json=other).json()["landmarks"] == "better.json"
    (role,) = (each for each in studio.get("/v1/limits")["roles"] if each["role"] == "photo")
    assert role["formats"] == role["own_formats"] == [".jpg", ".jpeg", ".png"]
    assert (role["landmarks"], role["masks"], role["is_scan"]) == ([".json"], [".png"], False)


@pytest.mark.long
@pytest.mark.parametrize("name", ["clip.MP4", "clip.webm"])
def test_a_film_is_one_file_or_many_pictures(studio: Studio, name: str) -> None:
    subject = studio.post("/v1/subjects", name="Alex")["id"]
    upload = studio.upload(name, b"a film")
    path = f"/v1/subjects/{subject}/captures"
    film = studio.post(path, name="clip", role="film", upload_id=upload)["id"]
    as_film: dict[str, Any] = {"options": {"sequence": True}}
    (file,) = _resolve(studio, NEUTRAL, subject, [film], **as_film).files
    assert (file["role"], file["filename"]) == ("film", name)
    pictures = [_photo(studio, subject, f"p{number:02d}", None) for number in range(17)]
    files = _resolve(studio, NEUTRAL, subject, pictures, **as_film).files
    assert [each["role"] for each in files] == 17 * ["photo"]
    for captures, more, code in (
        (pictures, {}, "job.photos"),
        ([film], {}, "capture.not_a_photo"),
        ([film, pictures[0]], as_film, "capture.not_a_photo"),
    ):
        with pytest.raises(Problem) as refused:
            _resolve(studio, NEUTRAL, subject, captures, **more)
        assert refused.value.code == code


def test_what_is_no_photograph_is_refused(studio: Studio) -> None:
    subject = studio.post("/v1/subjects", name="Alex")["id"]
    path = f"/v1/subjects/{subject}/captures"
    picture, heic, table = (
        studio.upload(name, _picture()) for name in ("a.png", "a.heic", "facts.csv")
    )
    body = {"name": "smile", "role": "photo", "upload_id": picture}
    cases = [
        ({**body, "upload_id": heic}, "capture.format"),
        ({**body, "role": "expression"}, "capture.format"),
        ({**body, "landmarks_upload_id": table}, "landmarks.format"),
        ({**body, "role": "markers", "landmarks_upload_id": table}, "capture.format"),
        ({**body, "mask_upload_id": table}, "capture.format"),
        (
            {**body, "role": "asset", "upload_id": table, "mask_upload_id": picture},
            "capture.is_asset",
        ),
    ]
    for each, code in cases:
        answer = studio.http.post(path, json=each)
        assert (answer.status_code, answer.json()["code"]) == (422, code)
    hint = studio.http.post(path, json={**body, "role": "expression"}).json()["detail"]
    assert hint.endswith("add it in the role photo")
    photo = _photo(studio, subject, "smile")
    body = {"kind": "check_scan", "subject_id": subject, "captures": [photo]}
    answer = studio.http.post("/v1/jobs", json=body)
    assert (answer.status_code, answer.json()["code"]) == (422, "capture.is_photo")


def test_a_model_goes_on_from_photographs_where_there_is_no_scan(studio: Studio) -> None:
    subject = studio.post("/v1/subjects", name="Alex")["id"]
    with pytest.raises(Problem) as caught:
        _resolve(studio, KINDS["build_model"], subject, [])
    assert caught.value.code == "subject.no_neutral"
    photo = _photo(studio, subject, "smile")
    job = studio.submit("neutral_from_photos", subject, captures=[photo])
    studio.pretend(job, {"neutral.ply": "a" * 64, "neutral.json": "b" * 64})
    (neutral,) = _resolve(studio, KINDS["build_model"], subject, []).files
    assert (neutral["role"], neutral["sha256"], neutral["of"]) == ("neutral", "a" * 64, job)
    scan = studio.capture(subject, "neutral", "neutral")
    (neutral,) = _resolve(studio, KINDS["build_model"], subject, []).files
    assert neutral["of"] == scan


@pytest.mark.long
def test_a_job_reads_the_photographs_that_are_chosen(studio: Studio) -> None:
    subject = studio.subject()
    smile = _photo(studio, subject, "smile", mask=MASK)
    plain = _photo(studio, subject, "plain", None)
    found = _resolve(studio, NEUTRAL, subject, [smile, plain, smile])
    assert [(each["role"], each["name"]) for each in found.files] == [
        ("photo", "smile"),
        ("facts", "smile"),
        ("mask", "smile"),
        ("photo", "plain"),
    ]
    assert [each["of"] for each in found.files] == [smile, smile, smile, plain]
    with pytest.raises(Problem) as caught:
        _resolve(studio, FIT, subject, [smile])
    assert caught.value.code == "subject.no_model"
    neutral = next(
        each["id"]
        for each in studio.get(f"/v1/subjects/{subject}/captures")["items"]
        if each["role"] == "neutral"
    )
    many = [_photo(studio, subject, f"p{number}", None) for number in range(17)]
    for chosen, code in (
        ([], "job.photos"),
        (many, "job.photos"),
        ([neutral], "capture.not_a_photo"),
    ):
        with pytest.raises(Problem) as caught:
            _resolve(studio, NEUTRAL, subject, chosen)
        assert caught.value.code == code


def test_a_fit_reads_the_rig_or_else_the_newest_model(studio: Studio) -> None:
    store: Store = studio.http.app.state.store  # type: ignore[attr-defined]
    stored = store.of(DEFAULT_TENANT).files.put(Path(__file__)).sha256
    subject = studio.subject()
    model = studio.submit("build_model", subject)
    studio.pretend(model, {"model.npz": stored})
    smile = _photo(studio, subject, "face")
    found = _resolve(studio, FIT, subject, [smile])
    assert [each["role"] for each in found.files] == ["model", "photo", "facts"]
    scan = studio.capture(subject, "scan", registered=True)
    fit = studio.submit("fit_geometry", subject, captures=[scan])
    rig = {"subject_id": subject, "model_job_id": model}
    studio.pretend(fit, {"rig.npz": stored}, rig=rig)
    tracks = studio.submit("build_tracks", subject)
    studio.pretend(tracks, {"tracks.npz": stored})
    rig_id = studio.job(fit)["result"]["rig_id"]
    found = _resolve(studio, FIT, subject, [smile], rig_id=rig_id)
    assert [each["role"] for each in found.files] == ["rig", "photo", "facts", "tracks"]


def test_photographs_go_with_their_person(studio: Studio) -> None:
    """The picture, what was known of it, and its mask; until then each is known to be theirs."""
    store: Store = studio.http.app.state.store  # type: ignore[attr-defined]
    subject = studio.post("/v1/subjects", name="Alex")["id"]
    _photo(studio, subject, "smile", mask=MASK)
    stored = [each.sha256 for each in store.files.list_stored()]
    assert len(stored) == 3
    assert studio.get("/v1/usage")["bytes"]["used"] == len(_picture(5)) + len(FACTS) + len(MASK)
    with store.of(DEFAULT_TENANT).read() as session:
        held = holders(session, stored)
    known = {words.split(" ")[0] for each in held.values() for words in each}
    assert known >= {"capture", "landmarks", "mask"}
    assert studio.http.delete(f"/v1/subjects/{subject}").status_code == 204
    for _ in range(2):  # uploads first, then what they had kept
        deletion.collect_garbage(store, age=-60)
    assert [*store.files.list_stored()] == []


ENDINGS = {"photo": "jpg", "facts": "json", "mask": "png"}


def _order(folder: Path, files: dict[tuple[str, str], bytes]) -> None:
    """Write a job as a worker does, each file in a folder of its own."""
    items = []
    for number, ((role, name), content) in enumerate(files.items()):
        path = folder / "inputs" / str(number) / f"face.{ENDINGS[role]}"
        path.parent.mkdir(parents=True)
        path.write_bytes(content)
        items.append({"role": role, "name": name, "path": str(path)})
    job = {"kind": "fit_tracks", "inputs": items, "options": {}, "resume": False}
    (folder / "job.json").write_text(json.dumps(job))


@pytest.fixture
def photos(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What a job reads of its photographs."""
    found: list[Any] = []

    def run(task: Task[Any]) -> list[Path]:
        found.extend(read_photos(task))
        (task.out / KINDS["fit_tracks"].report).write_text("{}")
        return []

    monkeypatch.setattr(jobs, "import_module", lambda _name: SimpleNamespace(run=run))
    return found


def test_a_worker_hands_photographs_to_their_job(tmp_path: Path, photos: list[Any]) -> None:
    """Two files may be called alike, as cameras do; the captures' names tell them apart."""
    _order(
        tmp_path,
        {
            ("photo", "smile"): _picture(),
            ("facts", "smile"): FACTS.encode(),
            ("photo", "plain"): _picture(),
            ("mask", "plain"): MASK,
        },
    )
    solve.solve(tmp_path, silent)
    assert [each.name for each in photos] == ["smile", "plain"]
    assert photos[0].landmarks["33"].tolist() == [20.0, 30.0]
    assert photos[1].landmarks == {}
    assert photos[0].mask is None
    assert photos[1].mask.sum() == 96 * 50


def test_faults_of_all_photographs_are_told(tmp_path: Path, photos: list[Any]) -> None:
    bad = {("photo", "a"): b"GIF89a", ("photo", "b"): _picture(), ("facts", "b"): b"{"}
    _order(tmp_path, {**bad, ("photo", "c"): _picture()})
    with pytest.raises(InputError) as caught:
        solve.solve(tmp_path, silent)
    assert caught.value.code == "photo.several"
    faults = caught.value.context["faults"]
    assert [(each["code"], each["photo"]) for each in faults] == [
        ("photo.format", "a"),
        ("photo.facts_unreadable", "b"),
    ]


def test_what_lies_beside_no_photograph_is_refused(tmp_path: Path) -> None:
    options = KINDS["fit_tracks"].read({})
    alone = Task(tmp_path, options, captures={"a": tmp_path}, facts={"b": tmp_path})
    many = replace(alone, captures={str(number): tmp_path for number in range(17)}, facts={})
    for task, code in (
        (alone, "photo.alone"),
        (many, "photo.too_many"),
        (Task(tmp_path, options), "job.missing"),
    ):
        with pytest.raises(InputError) as caught:
            read_photos(task)
        assert caught.value.code == code
