"""Videos and photographs that no living worker can look at, refused when they are submitted."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import delete

from service.settings import Settings
from service.store.database import clock
from service.store.models import Worker
from solver import landmarker
from tests.service.test_handed_on import Session
from tests.service_client import served
from worker import abilities

SCENE = {"scene": {"recording": {"asset": "talk"}}}


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    with served(Settings(data_dir=tmp_path_factory.mktemp("data"))) as studio:
        yield Session(studio)


FILMS = {"talk.mp4": b"\0\0\0\x14ftypqt  ", "talk.webm": b"\x1a\x45\xdf\xa3"}


@pytest.fixture
def video(session: Session, request: pytest.FixtureRequest) -> Iterator[str]:
    """A video as an asset; there is no worker."""
    name = getattr(request, "param", "talk.mp4")
    upload = session.studio.upload(name, FILMS[name])
    path = f"/v1/subjects/{session.subject}/captures"
    made = session.studio.post(path, name="talk", role="asset", upload_id=upload)["id"]
    yield made
    with session.store.write() as rows:
        rows.execute(delete(Worker))
    session.studio.http.delete(f"{path}/{made}")


def hire(session: Session, name: str, lacks: list[str] | None, **more: Any) -> None:
    with session.store.write() as rows:
        seen = clock(rows) - more.pop("ago", timedelta())
        kinds = ["animate", "fit_photo", "neutral_from_photos"]
        rows.add(Worker(name=name, kinds=kinds, lacks=lacks, seen_at=seen, slots=1, **more))


def answer(session: Session, video: str) -> tuple[int, str | None]:
    told = session.ask("animate", captures=[video], options=SCENE)
    if told.status_code == 201:
        session.studio.post(f"/v1/jobs/{told.json()['id']}/cancel")
    return told.status_code, told.json().get("code")


@pytest.mark.parametrize("video", FILMS, indirect=True)
def test_a_video_is_refused_where_no_worker_can_look_at_it(session: Session, video: str) -> None:
    assert answer(session, video) == (201, None)  # nobody lives: it waits
    hire(session, "short", [], queue="short")
    hire(session, "dead", [], queue="long", ago=timedelta(hours=1))
    hire(session, "poor", ["av", "mediapipe", "landmarker"], queue="long")
    assert answer(session, video) == (409, "video.extra")
    hire(session, "better", ["landmarker"], queue="long")
    assert answer(session, video) == (409, "video.model")
    hire(session, "able", [], queue="long")
    assert answer(session, video) == (201, None)


def test_a_worker_that_does_not_say_is_taken_for_able(session: Session, video: str) -> None:
    hire(session, "older", None, queue="long")
    hire(session, "poor", ["mediapipe"], queue="long")
    assert answer(session, video) == (201, None)


@pytest.mark.usefixtures("video")
def test_a_photograph_needs_no_film_reader_and_with_landmarks_nothing(session: Session) -> None:
    subject = session.subject
    front = session.studio._add(subject, "front", "photo", {})
    upload, marks = session.studio.upload("left.jpg", b"#"), session.studio.upload("l.json", b"{}")
    path = f"/v1/subjects/{subject}/captures"
    more = {"name": "left", "role": "photo", "upload_id": upload, "landmarks_upload_id": marks}
    left = session.studio.post(path, **more)["id"]
    for name in ("one", "two"):
        hire(session, name, ["av"], queue=("short", "long")[name == "two"])
    assert session.ask("fit_photo", captures=[front]).status_code == 201
    with session.store.write() as rows:
        rows.execute(delete(Worker))
    hire(session, "poor", ["mediapipe"], queue="short")
    told = session.ask("fit_photo", captures=[left, front])
    assert (told.status_code, told.json()["code"]) == (409, "landmarks.extra")
    assert told.json()["found"] == "front"
    assert session.ask("fit_photo", captures=[left]).status_code == 201
    # of a film only the frames that are fitted have to be told
    hire(session, "poor too", ["mediapipe"], queue="long")
    film = {"options": {"sequence": True}}
    assert session.ask("fit_photo", captures=[left, front], **film).status_code == 201
    told = session.ask("fit_photo", captures=[front], **film)
    assert (told.status_code, told.json()["code"]) == (409, "landmarks.extra")


def test_workers_of_the_solver_s_own_jobs_say_what_they_lack(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MYOFACE_CACHE", str(tmp_path))
    monkeypatch.delenv(landmarker.VARIABLE, raising=False)
    monkeypatch.setattr(landmarker, "PACKAGES", ("numpy", "no_such_package"))
    settings = Settings(data_dir=tmp_path)
    assert abilities.lacking(settings) == ["no_such_package", "landmarker"]
    (tmp_path / landmarker.FILE).touch()
    assert abilities.lacking(settings) == ["no_such_package"]
    assert abilities.lacking(settings.model_copy(update={"jobs": "tests.standin.jobs"})) == []
