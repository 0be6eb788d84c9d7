"""What earlier jobs left, named as inputs of later ones: found, fixed, and refused in words."""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from service.settings import Settings
from service.store.database import Store
from service.store.models import DEFAULT_TENANT, Job
from solver.kinds import FILES, KINDS
from tests.service_client import Studio, served

SCENE = {"options": {"scene": {"performance": {"asset": "sequence"}}}}


class Session:
    """A person with a rig, and jobs of it that ended as a test says."""

    def __init__(self, studio: Studio) -> None:
        self.studio = studio
        store: Store = studio.http.app.state.store  # type: ignore[attr-defined]
        self.store = store.of(DEFAULT_TENANT)
        self.subject = studio.subject()
        self.rig = self.add_rig()
        self.take = studio._add(self.subject, "take", "markers", {})

    def stored(self, name: str) -> dict[str, str]:
        return {name: self.store.files.put(Path(__file__)).sha256}

    def add_rig(self) -> str:
        made = self.studio.submit("build_model", self.subject)
        self.studio.pretend(made, self.stored("model.npz"))
        smile = self.studio.capture(self.subject, f"smile-{made[:8]}", registered=True)
        job = self.studio.submit("fit_geometry", self.subject, captures=[smile])
        rig = {"subject_id": self.subject, "model_job_id": made}
        self.studio.pretend(job, self.stored("rig.npz"), rig=rig)
        return str(self.studio.job(job)["result"]["rig_id"])

    def left(self, kind: str, *names: str, rig: str | None = None, **more: Any) -> str:
        """Return a job of a kind that has left files of these names."""
        job = self.studio.submit(kind, self.subject, rig_id=rig or self.rig, **more)
        files: dict[str, str] = {}
        for name in names:
            files |= self.stored(name)
        self.studio.pretend(job, files)
        return job

    def ask(self, kind: str, *handed: dict[str, str], **more: Any) -> Any:
        body = {"kind": kind, "subject_id": self.subject, "rig_id": self.rig}
        body |= {"from_jobs": list(handed), **more}
        return self.studio.http.post("/v1/jobs", json={k: v for k, v in body.items() if v})

    def inputs(self, job: str) -> list[tuple[str, str, str]]:
        with self.store.read() as session:
            found = session.get(Job, job)
            assert found
            return [(each["role"], each["name"], each["filename"]) for each in found.inputs]


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    with served(Settings(data_dir=tmp_path_factory.mktemp("data"))) as studio:
        yield Session(studio)


@pytest.mark.long
def test_a_check_s_places_serve_the_fit_and_its_retry(session: Session) -> None:
    check = session.left("check_markers", "markers.json", captures=[session.take])
    handed = {"job": check, "artifact": "markers.json"}
    answer = session.ask("fit_markers", handed, captures=[session.take])
    assert answer.status_code == 201, answer.text
    fit = answer.json()["id"]
    assert ("marker_set", "markers", "markers.json") in session.inputs(fit)
    assert answer.json()["from_jobs"] == [{**handed, "name": None}]
    session.studio.pretend(fit, session.stored("sequence.npz"))
    again = session.studio.post(f"/v1/jobs/{fit}/retry")["id"]
    assert session.inputs(again) == session.inputs(fit)
    session.studio.post(f"/v1/jobs/{again}/cancel")


@pytest.mark.long
def test_takes_play_in_a_scene_under_their_names(session: Session) -> None:
    one, other = (
        session.left("fit_markers", "sequence.npz", captures=[session.take]) for _ in "ab"
    )
    files = [{"job": each, "artifact": "sequence.npz"} for each in (one, other)]
    job = session.ask("simulate", files[0], **SCENE).json()["id"]
    assert ("asset", "sequence", "sequence.npz") in session.inputs(job)
    other_name = session.ask("simulate", {**files[0], "name": "talk"}, **SCENE)
    assert (other_name.status_code, other_name.json()["code"]) == (422, "job.asset")
    assert other_name.json()["member"] == "options.scene.performance.asset"
    assert other_name.json()["expected"] == ["talk"]
    twice = session.ask("simulate", *files, **SCENE)
    assert (twice.status_code, twice.json()["code"]) == (422, "job.twice")
    assert twice.json()["member"] == "from_jobs.1"
    named = session.ask("simulate", files[0], {**files[1], "name": "second"}, **SCENE)
    assert ("asset", "second", "sequence.npz") in session.inputs(named.json()["id"])


def test_named_muscles_stand_instead_of_the_newest(session: Session) -> None:
    first = session.left("fit_fibres", "fibre_muscles.npz")
    session.left("fit_fibres", "fibre_muscles.npz")
    named = {"job": first, "artifact": "fibre_muscles.npz"}
    job = session.ask("fit_markers", named, captures=[session.take]).json()["id"]
    roles = [role for role, _, _ in session.inputs(job)]
    assert roles.count("fibre_muscles") == 1
    of_another = session.ask(
        "fit_markers", named, captures=[session.take], rig_id=session.add_rig()
    )
    assert (of_another.status_code, of_another.json()["code"]) == (409, "artifact.other_rig")


def test_expressions_that_an_earlier_fit_solved_are_found(session: Session) -> None:
    session.left("fit_markers", "expression_basis.npz", captures=[session.take])
    job = session.ask("fit_markers", captures=[session.take]).json()["id"]
    assert "expression_basis" in [role for role, _, _ in session.inputs(job)]
    other = session.ask("fit_markers", captures=[session.take], rig_id=session.add_rig())
    assert "expression_basis" not in [role for role, _, _ in session.inputs(other.json()["id"])]


def test_the_newest_expressions_are_found_whichever_job_solved_them(session: Session) -> None:
    rig = session.add_rig()
    clip = session.studio._add(session.subject, "clip", "asset", {})
    scene = {"options": {"scene": {"recording": {"asset": "clip"}}}, "captures": [clip]}

    def expressions(kind: str, **more: Any) -> str | None:
        job = session.ask(kind, rig_id=rig, **more).json()["id"]
        with session.store.read() as rows:
            inputs = rows.get_one(Job, job).inputs
        return next((each["sha256"] for each in inputs if each["role"] == "expression_basis"), None)

    assert expressions("next_scan") is None
    basis = "expression_basis.npz"
    session.left("fit_markers", basis, rig=rig, captures=[session.take])
    fitted = expressions("next_scan")
    assert expressions("animate", **scene) == fitted is not None
    job = session.studio.submit("animate", session.subject, rig_id=rig, **scene)
    session.studio.pretend(job, {basis: session.store.files.put(Path(pytest.__file__)).sha256})
    played = expressions("next_scan")
    assert played != fitted
    assert expressions("fit_markers", captures=[session.take]) == played


def test_what_cannot_be_handed_on_is_told(session: Session) -> None:
    take, studio = [session.take], session.studio
    check = session.left("check_markers", captures=take)
    waiting = studio.submit("check_markers", session.subject, captures=take, rig_id=session.rig)
    fit = session.left("fit_markers", "sequence.npz", "sequence.json", captures=take)

    def refused(job: str, artifact: str, kind: str = "fit_markers") -> tuple[int, str]:
        more = {"fit_markers": {"captures": take}, "simulate": SCENE}.get(kind, {})
        answer = session.ask(kind, {"job": job, "artifact": artifact}, **more)
        return answer.status_code, answer.json()["code"]

    assert refused(waiting, "markers.json") == (409, "artifact.not_left")
    assert refused(check, "markers.json") == (404, "artifact.unknown")
    assert refused(str(uuid.uuid4()), "markers.json") == (404, "job.unknown")
    assert refused(fit, "sequence.json", "simulate") == (422, "artifact.not_an_input")
    assert refused(fit, "sequence.npz", "next_scan") == (422, "artifact.not_an_input")
    answer = session.ask("simulate", {"job": fit, "artifact": "sequence.glb"}, **SCENE)
    assert answer.json()["expected"] == ["sequence.npz"]
    assert answer.json()["member"] == "from_jobs.0"
    studio.post(f"/v1/jobs/{waiting}/cancel")
    assert refused(waiting, "markers.json") == (409, "artifact.not_left")
    other = Session(studio)
    handed = other.left("check_markers", "markers.json", captures=[other.take])
    assert refused(handed, "markers.json") == (409, "artifact.other_subject")


def test_a_take_has_one_marker_set(session: Session) -> None:
    checks = [session.left("check_markers", "markers.json", captures=[session.take]) for _ in "ab"]
    files = [{"job": each, "artifact": "markers.json"} for each in checks]
    answer = session.ask("fit_markers", *files, captures=[session.take])
    assert (answer.status_code, answer.json()["code"]) == (422, "job.twice")


def test_every_file_that_is_handed_on_is_an_input_of_some_kind() -> None:
    read = {each for kind in KINDS.values() for each in kind.reads}
    left = {name for kind in KINDS.values() for name in kind.hands_on}
    assert left <= set(FILES)
    assert {FILES[name].input for name in left} <= read
