"""What earlier jobs left, named as inputs of later ones: found, fixed, and refused in words."""

from __future__ import annotations

import json
import uuid
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from sqlalchemy import delete, update

from service.settings import Settings
from service.store.database import Store
from service.store.models import DEFAULT_TENANT, Artifact, Job
from solver import jobs
from solver.jobs import Task
from solver.kinds import FILES, KINDS
from solver.progress import silent
from solver.scans.recordings import SIGNALS_FILE
from tests.service_client import Studio, served
from worker.solve import solve

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

    def note_format(self, job: str, name: str, number: int) -> None:
        """Say that a file of a job has another format, as a worker of another release would."""
        with self.store.write() as session:
            same = (Artifact.job_id == job, Artifact.name == name)
            session.execute(update(Artifact).where(*same).values(format=number))

    def sources(self, job: str) -> dict[str, str]:
        """Return of which capture or job each input is, by its role."""
        with self.store.read() as session:
            return {each["role"]: each["of"] for each in session.get_one(Job, job).inputs}

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
    take = [session.take]
    studio = session.studio
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


def test_a_file_of_a_newer_format_is_refused_by_job_file_and_format(session: Session) -> None:
    take = [session.take]
    check = session.left("check_markers", "markers.json", captures=take)
    handed = {"job": check, "artifact": "markers.json"}
    for number, status in ((1, 201), (2, 409)):
        session.note_format(check, "markers.json", number)
        answer = session.ask("fit_markers", handed, captures=take)
        assert answer.status_code == status, answer.text
    found = answer.json()
    assert found["detail"] == (f"markers.json of job {check} has format 2: this release reads 1")
    named = {name: found[name] for name in ("code", "job_id", "file", "found", "expected")}
    assert named == {
        "code": "artifact.format",
        "job_id": check,
        "file": "markers.json",
        "found": 2,
        "expected": [1],
    }
    assert found["member"] == "from_jobs.0"


def test_a_rig_of_a_newer_format_is_refused(session: Session) -> None:
    rig = session.add_rig()
    job = session.studio.get(f"/v1/rigs/{rig}")["job_id"]
    session.note_format(job, "rig.npz", 7)
    answer = session.ask("fit_markers", captures=[session.take], rig_id=rig)
    assert (answer.status_code, answer.json()["code"]) == (409, "artifact.format")
    assert (answer.json()["job_id"], answer.json()["found"]) == (job, 7)


def test_what_is_found_by_itself_is_of_a_format_that_is_read(session: Session) -> None:
    rig = session.add_rig()
    basis = "expression_basis.npz"
    old, new = (session.left("fit_markers", basis, rig=rig, captures=[session.take]) for _ in "ab")
    for number, expected in ((1, new), (2, old)):
        session.note_format(new, basis, number)
        job = session.ask("next_scan", rig_id=rig).json()["id"]
        assert session.sources(job)["expression_basis"] == expected


def test_a_sequence_is_no_asset_of_scenes_that_play_none(session: Session) -> None:
    fit = session.left("fit_markers", "sequence.npz", captures=[session.take])
    scene = {"options": {"scene": {"recording": {"asset": "sequence"}}}}
    answer = session.ask("animate", {"job": fit, "artifact": "sequence.npz"}, **scene)
    assert (answer.status_code, answer.json()["code"]) == (422, "artifact.not_an_input")


def test_a_job_cannot_read_what_itself_or_its_descendant_leaves(session: Session) -> None:
    """Only jobs that have succeeded hand files on, and what a job reads is fixed before it runs."""
    own = str(uuid.uuid4())
    body = {"kind": "fit_markers", "subject_id": session.subject, "rig_id": session.rig}
    body |= {"captures": [session.take], "from_jobs": [{"job": own, "artifact": "markers.json"}]}
    answer = session.studio.http.put(f"/v1/jobs/{own}", json=body)
    assert (answer.status_code, answer.json()["code"]) == (404, "job.unknown")


def test_jobs_are_listed_by_what_they_left_and_read(session: Session) -> None:
    studio = session.studio
    take = [session.take]
    check = session.left("check_markers", "markers.json", captures=take)
    handed = {"job": check, "artifact": "markers.json"}
    fit = session.ask("fit_markers", handed, captures=take).json()["id"]

    def listed(query: str) -> list[str]:
        found = studio.get(f"/v1/jobs?subject_id={session.subject}&{query}")["items"]
        return [each["id"] for each in found]

    assert check in listed("has=markers.json")
    assert fit not in listed("has=markers.json")
    assert listed(f"reads={check}") == [fit]
    assert {check, fit} <= set(listed(f"reads={session.take}"))
    assert listed(f"reads={fit}") == []
    assert studio.http.get("/v1/jobs?reads=%25").status_code == 422


def test_a_take_has_one_marker_set(session: Session) -> None:
    checks = [session.left("check_markers", "markers.json", captures=[session.take]) for _ in "ab"]
    files = [{"job": each, "artifact": "markers.json"} for each in checks]
    answer = session.ask("fit_markers", *files, captures=[session.take])
    assert (answer.status_code, answer.json()["code"]) == (422, "job.twice")


def test_known_activations_lie_beside_what_is_fitted(session: Session) -> None:
    emg, other = (
        session.studio._add(session.subject, name, "activations", {}) for name in ("emg", "other")
    )
    smile = session.studio.capture(session.subject, "smile-known", registered=True)
    for kind, captures, fitted in (
        ("fit_activations", [emg, smile], {"capture": smile}),
        ("fit_markers", [session.take, emg], {"markers": session.take}),
    ):
        job = session.ask(kind, captures=captures).json()
        assert job["captures"] == captures
        assert session.sources(job["id"]).items() >= {"activations": emg, **fitted}.items()
        twice = session.ask(kind, captures=[*captures, other])
        assert (twice.status_code, twice.json()["code"]) == (422, "job.one_table")
        alone = session.ask(kind, captures=[emg])
        assert (alone.status_code, alone.json()["code"]) == (422, "job.missing")
    checked = session.ask("check_scan", captures=[emg], rig_id=None)
    assert (checked.status_code, checked.json()["code"]) == (422, "capture.is_activations")


def test_what_a_live_session_sent_reaches_the_jobs_of_its_takes(session: Session) -> None:
    live = session.left("live_session", "live_takes.npz")
    sent = {"job": live, "artifact": "live_takes.npz"}
    clip = session.studio._add(session.subject, "clip-live", "asset", {})
    played = {"options": {"scene": {"recording": {"asset": "clip-live"}}}, "captures": [clip]}
    dense = session.studio._add(session.subject, "dense-live", "performance", {})
    for kind, more in (
        ("fit_markers", {"captures": [session.take]}),
        ("fit_sequence", {"captures": [dense]}),
        ("animate", played),
    ):
        assert "live_takes" not in session.sources(session.ask(kind, **more).json()["id"])
        job = session.ask(kind, sent, **more).json()["id"]
        assert session.sources(job)["live_takes"] == live


def test_what_was_measured_of_a_video_is_a_recording_of_later_jobs(session: Session) -> None:
    clip = session.studio._add(session.subject, "filmed", "asset", {})
    filmed = {"options": {"scene": {"recording": {"asset": "filmed"}}}, "captures": [clip]}
    first = session.left("animate", "signals.csv", "animation.glb", **filmed)
    signals = {"job": first, "artifact": "signals.csv"}
    scene = {"options": {"scene": {"recording": {"asset": "signals", "gain": 1.3}}}}
    answer = session.ask("animate", signals, **scene)
    assert answer.status_code == 201, answer.text
    assert ("asset", "signals", "signals.csv") in session.inputs(answer.json()["id"])
    refused = session.ask("simulate", signals, options={"scene": {}})
    assert refused.json()["code"] == "artifact.not_an_input"
    assert KINDS["animate"].hands_on[-1] == SIGNALS_FILE


def test_every_file_that_is_handed_on_is_an_input_of_some_kind() -> None:
    read = {each for kind in KINDS.values() for each in kind.reads}
    left = {name for kind in KINDS.values() for name in kind.hands_on}
    assert left <= set(FILES)
    assert {FILES[name].input for name in left} <= read


def test_the_texture_of_the_neutral_s_registration_is_found(session: Session) -> None:
    subject = session.studio.post("/v1/subjects", name="Alex")["id"]
    raw = session.studio.raw(subject, "neutral-in-colour", role="neutral")
    images = session.stored("registered.ply") | session.stored("texture.png")
    register = session.studio.submit("register_scan", subject, captures=[raw])
    session.studio.pretend(register, images)
    made = session.studio.submit("build_model", subject)
    session.studio.pretend(made, session.stored("model.npz"))
    smile = session.studio.capture(subject, "smile-in-colour", registered=True)
    fit = session.studio.submit("fit_geometry", subject, captures=[smile])
    told = {"subject_id": subject, "model_job_id": made}
    session.studio.pretend(fit, session.stored("rig.npz"), rig=told)
    rig = session.studio.job(fit)["result"]["rig_id"]
    # a newer one is of no model yet, and may be named
    newer = session.studio.submit("register_scan", subject, captures=[raw])
    session.studio.pretend(newer, images)
    job = session.studio.submit("build_studio_rig", subject, rig_id=rig)
    assert session.sources(job)["texture"] == register
    named = [{"job": newer, "artifact": "texture.png"}]
    job = session.studio.submit("build_studio_rig", subject, rig_id=rig, from_jobs=named)
    assert session.sources(job)["texture"] == newer
    # where the model's own left none, the same scan registered again has it
    with session.store.write() as rows:
        same = (Artifact.job_id == register, Artifact.name == "texture.png")
        rows.execute(delete(Artifact).where(*same))
    job = session.studio.submit("build_studio_rig", subject, rig_id=rig)
    assert session.sources(job)["texture"] == newer
    # a person whose neutral came registered has none
    other = session.ask("build_studio_rig", rig_id=session.rig).json()["id"]
    assert "texture" not in session.sources(other)


def test_normals_and_wrinkles_of_the_rig_s_expressions_are_found(session: Session) -> None:
    subject = session.studio.post("/v1/subjects", name="Alex")["id"]
    raw = session.studio.raw(subject, "neutral-in-detail", role="neutral")
    register = session.studio.submit("register_scan", subject, captures=[raw])
    session.studio.pretend(
        register, session.stored("registered.ply") | session.stored("normals.png")
    )
    smile = session.studio.raw(subject, "smile-in-detail", role="expression")
    moved = session.studio.submit("register_scan", subject, captures=[smile])
    assert session.sources(moved)["normals"] == register
    session.studio.pretend(
        moved, session.stored("registered.ply") | session.stored("wrinkle_normals.png")
    )
    made = session.studio.submit("build_model", subject)
    session.studio.pretend(made, session.stored("model.npz"))
    fit = session.studio.submit("fit_geometry", subject, captures=[smile])
    told = {"subject_id": subject, "model_job_id": made}
    told["expressions"] = ["smile-in-detail"]
    session.studio.pretend(fit, session.stored("rig.npz"), rig=told)
    rig = session.studio.job(fit)["result"]["rig_id"]
    wrinkle = "wrinkle_normals.png"
    leaves = session.stored("registered.ply") | session.stored(wrinkle)

    def left(scan: str) -> str:
        job: str = session.studio.submit("register_scan", subject, captures=[scan])
        session.studio.pretend(job, leaves)
        return job

    def maps(*named: dict[str, str]) -> list[tuple[str, str]]:
        made = session.studio.submit("build_studio_rig", subject, rig_id=rig, from_jobs=[*named])
        assert session.sources(made)["normals"] == register
        with session.store.read() as rows:
            inputs = rows.get_one(Job, made).inputs
        return [(each["name"], each["of"]) for each in inputs if each["role"] == "wrinkles"]

    assert maps() == [("smile-in-detail", moved)]
    newer = left(smile)
    frown = left(session.studio.raw(subject, "frown-in-detail", role="expression"))
    assert maps() == [("smile-in-detail", newer)]  # no other expression is the rig's
    # what is named stands instead
    named = [
        {"job": each, "artifact": wrinkle, "name": name}
        for each, name in ((moved, "smile-in-detail"), (frown, "browDownLeft"))
    ]
    assert maps(*named) == [("smile-in-detail", moved), ("browDownLeft", frown)]
    assert maps(named[1]) == [("browDownLeft", frown)]
    # a neutral that is registered again is no longer what those lie upon
    session.studio.pretend(
        session.studio.submit("register_scan", subject, captures=[raw]),
        {"registered.ply": session.store.files.put(Path(pytest.__file__)).sha256},
    )
    left(smile)
    assert maps() == [("smile-in-detail", newer)]


def test_a_worker_hands_wrinkle_maps_to_their_job_by_their_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: dict[str, Path] = {}

    def run(task: Task[Any]) -> list[Path]:
        seen.update(task.captures)
        (task.out / KINDS["build_studio_rig"].report).write_text("{}")
        return []

    monkeypatch.setattr(jobs, "import_module", lambda _name: SimpleNamespace(run=run))
    items = []
    for name in ("smile", "frown"):
        path = tmp_path / name / "wrinkle_normals.png"
        path.parent.mkdir()
        path.touch()
        role = FILES[path.name].role
        items.append({"role": role, "name": name, "path": str(path)})
    job = {"kind": "build_studio_rig", "inputs": items, "options": {}, "resume": False}
    (tmp_path / "job.json").write_text(json.dumps(job))
    solve(tmp_path, silent)
    assert seen == {each["name"]: Path(each["path"]) for each in items}


def test_tracks_are_built_with_the_registered_scans_that_are_named(session: Session) -> None:
    smile = session.studio.capture(session.subject, "own-smile", registered=True)
    job = session.studio.submit("build_tracks", session.subject, captures=[smile])
    assert session.sources(job)["capture"] == smile
    plain = session.studio.submit("build_tracks", session.subject)
    assert "capture" not in session.sources(plain)
    raw = session.studio.raw(session.subject, "own-raw", role="expression")
    refused = session.ask("build_tracks", rig_id=None, captures=[raw])
    assert refused.status_code == 409
    assert "register it first" in refused.text


def test_tracks_of_the_rig_s_model_are_found_by_its_scenes(session: Session) -> None:
    rig = session.add_rig()
    tracks = session.studio.submit("build_tracks", session.subject)
    session.studio.pretend(tracks, session.stored("tracks.npz"))
    scene = {"options": {"scene": {"drive": "tracks", "keys": [{"time": 0}]}}}
    job = session.ask("simulate", rig_id=rig, **scene).json()["id"]
    assert session.sources(job)["tracks"] == tracks
    # and by fits of them, with the registered scans
    smile = session.studio.capture(session.subject, "smile-by-tracks", registered=True)
    fit = session.ask("fit_tracks", rig_id=rig, captures=[smile]).json()["id"]
    assert session.sources(fit)["tracks"] == tracks
    assert session.sources(fit)["capture"] == smile
    # another model's rig has none of them
    other = session.ask("simulate", rig_id=session.add_rig(), **scene).json()["id"]
    assert "tracks" not in session.sources(other)
