"""What a supervisor does when the database does not answer, or the disk is full."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import textwrap
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import delete, select, text
from sqlalchemy.exc import OperationalError

from service.queue import table
from service.queue.states import State
from service.queue.table import Claim
from service.settings import Settings
from service.store import deletion
from service.store.database import Store
from service.store.models import DEFAULT_TENANT, Artifact, Job, LogLine, Subject, Tenant
from solver.kinds import kind
from tests.service_client import ROOT, eventually
from tests.stores import open_store
from worker import attempt, process, solve, supervise
from worker.abilities import abilities
from worker.attempt import FRAMES, KEPT, AttemptFolder
from worker.errors import InvalidOutputError, OutputSizeError, crash_error
from worker.orphans import remove_tree
from worker.supervise import Supervisor


class Talking:
    """A solver process that says one more line and phase each time it is asked."""

    def __init__(self) -> None:
        self.said = 0

    def steps(self) -> list[dict[str, object]]:
        self.said += 1
        return [{"phase": f"phase {self.said}", "fraction": 0.1 * self.said}]

    def lines(self) -> list[str]:
        return [f"line {self.said}"]


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(data_dir=tmp_path, beat=0.01)


@pytest.fixture
def store(settings: Settings) -> Iterator[Store]:
    with open_store(settings.data_dir, broker=settings.broker) as store:
        yield store


def _supervisor(store: Store, settings: Settings) -> Supervisor:
    """Return a supervisor whose lease does not run out."""
    supervisor = Supervisor(store, settings, abilities(settings), threading.Event())
    supervisor._renewed = float("inf")
    return supervisor


def _claimed(store: Store, kind: str = "build_model") -> Claim:
    with store.write() as session:
        session.add(subject := Subject(tenant_id=DEFAULT_TENANT, name="Alex"))
        session.flush()
        request = {"options": {}, "rig_id": None}
        job = Job(
            tenant_id=DEFAULT_TENANT,
            subject_id=subject.id,
            kind=kind,
            queue="short",
            request=request,
            inputs=[],
            max_attempts=3,
        )
        table.create(session, job)
        claim = table.take(session, job.id, "me", 30)
    assert claim is not None
    return claim


def test_what_was_said_during_an_outage_is_written_down_after_it(
    settings: Settings, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    claim = _claimed(store, "simulate")
    supervisor = _supervisor(store, settings)
    process = Talking()
    folder = AttemptFolder(settings.work, claim)
    frames = folder.path / "out" / FRAMES
    frames.mkdir(parents=True)
    (frames / "000000-000029.json").write_text("{}")

    def away() -> None:
        raise OperationalError("BEGIN", None, Exception("gone"))

    with monkeypatch.context() as outage:
        outage.setattr(store, "write", away)
        supervisor._beat(claim, process, folder)
        supervisor._beat(claim, process, folder)
    supervisor._beat(claim, process, folder)
    supervisor._beat(claim, process, folder)
    with store.write() as session:  # told once more, as after a commit whose answer was lost
        (kept,) = table.frames(session, claim.job_id)
        chunk = {name: getattr(kept, name) for name in ("first", "last", "size", "sha256")}
        table.beat(session, claim.job_id, claim.attempt, 30, chunks=[chunk])
    with store.read() as session:
        said = session.scalars(select(LogLine.text).order_by(LogLine.number)).all()
        assert said == ["line 1", "line 2", "line 3", "line 4"]
        assert [(chunk.first, chunk.last) for chunk in table.frames(session, claim.job_id)] == [
            (0, 29)
        ]
        assert session.get_one(Job, claim.job_id).progress["phase"] == "phase 4"


def test_a_lease_is_kept_while_files_are_stored(
    settings: Settings, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    claim = _claimed(store, "simulate")
    folder = AttemptFolder(settings.work, claim)
    frames = folder.path / "out" / FRAMES
    frames.mkdir(parents=True)
    (frames / "000000-000029.json").write_text("{}")
    put = store.files.put
    leases = []

    def slow(*about: Any) -> Any:
        for _ in range(2):
            leases.append(_lease(store, claim))
            eventually(lambda: _lease(store, claim) > leases[-1])
        return put(*about)

    monkeypatch.setattr(store.files, "put", slow)
    _supervisor(store, settings)._beat(claim, Talking(), folder)
    assert leases


def _lease(store: Store, claim: Claim) -> datetime:
    with store.read() as session:
        until = session.get_one(Job, claim.job_id).lease_until
    assert until is not None
    return until


def test_a_lease_that_was_renewed_meanwhile_is_not_over(settings: Settings, store: Store) -> None:
    claim = _claimed(store)
    supervisor = _supervisor(store, settings)
    supervisor._renewed = 0.0
    with supervisor._leased(claim):
        eventually(lambda: supervisor._renewed > 0.0)


def test_what_takes_minutes_is_kept_for_the_next_attempt(settings: Settings, store: Store) -> None:
    claim = _claimed(store)
    supervisor = Supervisor(store, settings, abilities(settings), threading.Event())
    process = Talking()
    folder = AttemptFolder(settings.work, claim)
    folder.stage(store)
    assert json.loads((folder.path / "job.json").read_text())["resume"] is False
    shapes = folder.path / "out" / KEPT[0]
    for content in ("five", "ten"):
        shapes.write_text(content)
        supervisor._beat(claim, process, folder)
        supervisor._beat(claim, process, folder)
    assert folder.new_kept(store.files) == {}
    another = AttemptFolder(settings.work, claim)
    another.measure()
    (kept,) = another.new_kept(store.files).values()
    with store.write() as session:  # told once more, as after a commit whose answer was lost
        table.beat(session, claim.job_id, claim.attempt, 30, kept=[kept])
        table.lose(session, claim.job_id, claim.attempt, {"code": "x"})
        again = table.take(session, claim.job_id, "me", 30)
    with store.write() as session:  # the one that lost its job
        assert table.beat(session, claim.job_id, claim.attempt, 30, kept=[kept]) is None
    assert again is not None
    supervisor._renewed = float("inf")
    folder = AttemptFolder(settings.work, again)
    folder.stage(store)
    shapes = folder.path / "out" / KEPT[0]
    assert shapes.read_text() == "ten"
    assert json.loads((folder.path / "job.json").read_text())["resume"] is True
    shapes.write_text("all")
    told = {"summary": {}, "expressions": [], "formats": {KEPT[0]: 4}}
    (folder.path / "result.json").write_text(json.dumps(told))
    supervisor._commit_outcome(again, folder, 0, 60)
    with store.read() as session:
        (artifact,) = session.get_one(Job, claim.job_id).artifacts
    assert store.files.read(artifact.sha256) == b"all"
    assert artifact.format == 4
    for _ in range(2):  # put aside, then removed
        deletion.collect_garbage(store, 0)
    assert [stored.sha256 for stored in store.files.list_stored()] == [artifact.sha256]
    assert list(store.files.list_aside()) == []


def test_a_result_is_written_down_when_the_database_is_back(
    settings: Settings, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    claim = _claimed(store)
    supervisor = _supervisor(store, settings)
    folder = AttemptFolder(settings.work, claim)
    (folder.path / "out").mkdir(parents=True)
    (folder.path / "out" / "model.npz").write_bytes(b"PK")
    (folder.path / "result.json").write_text(json.dumps({"summary": {}, "expressions": []}))
    write = store.write
    failures = [1, 2]

    @contextmanager
    def failing() -> Iterator[Any]:
        with write() as session:
            yield session
            if failures:
                raise OperationalError("COMMIT", None, Exception(f"gone {failures.pop()}"))

    monkeypatch.setattr(store, "write", failing)
    supervisor._commit_outcome(claim, folder, 0, 60)
    with store.read() as session:
        job = session.get_one(Job, claim.job_id)
        assert job.state is State.SUCCEEDED
        assert [artifact.name for artifact in job.artifacts] == ["model.npz"]


def test_a_solver_without_room_puts_its_job_off(
    settings: Settings, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    claim = _claimed(store)
    folder = AttemptFolder(settings.work, claim)
    folder.stage(store)
    reading, writing = os.pipe()
    process: dict[str, object] = {"parent": os.getppid(), "memory_bytes": 1 << 40}
    process |= {"cpu_seconds": 3600, "jobs": "solver.jobs", "confined": False}
    (folder.path / "process.json").write_text(json.dumps(process))

    def full(*_: object, **__: object) -> None:
        try:
            raise OSError(errno.ENOSPC, "No space left on device")
        except OSError as error:
            raise RuntimeError("could not save the model") from error

    monkeypatch.setattr(solve, "die_with_parent", lambda *_: None)
    monkeypatch.setattr(solve.resource, "setrlimit", lambda *_: None)
    monkeypatch.setattr(solve, "run_job", full)
    code = solve.main(folder.path, writing)
    os.close(reading)
    supervisor = _supervisor(store, settings)
    supervisor._commit_outcome(claim, folder, code, 60)
    with store.read() as session:
        job = session.get_one(Job, claim.job_id)
        assert (job.state, job.lost, job.attempts[0].outcome) == (State.QUEUED, 0, "postponed")
        assert job.not_before is not None


def test_what_a_solver_links_to_is_not_stored(settings: Settings, store: Store) -> None:
    folder = AttemptFolder(settings.work, _claimed(store, "simulate"))
    folder.stage(store)
    secret = settings.data_dir / "secret"
    out = folder.path / "out"
    secret.write_text("of the service")
    (out / "report.json").write_text("{}")
    (out / "link.json").symlink_to(secret)
    (out / "with space").write_text("x")
    (out / FRAMES).mkdir()
    (out / FRAMES / "0-x.json").write_text("{}")
    folder.measure()
    assert [each.name for each in folder.store(store.files, {})] == ["report.json"]
    assert folder.new_frames(store.files) == []
    (folder.path / "error.json").symlink_to(secret)
    with pytest.raises(InvalidOutputError):
        folder.error()
    os.mkfifo(folder.path / "result.json")
    with pytest.raises(InvalidOutputError):
        folder.result()
    out.rename(folder.path / "elsewhere")
    out.symlink_to(settings.data_dir)
    folder.measure()
    assert folder.store(store.files, {}) == []


@pytest.mark.long
def test_no_more_is_stored_than_was_measured(settings: Settings, store: Store) -> None:
    """Another process of the solver's goes on writing what is looked at and stored."""
    folder = AttemptFolder(settings.work, _claimed(store, "simulate"))
    folder.stage(store)
    frames = folder.path / "out" / FRAMES
    frames.mkdir()
    growing = [folder.path / "out" / KEPT[0], frames / "0-9.json"]
    for path in growing:
        path.write_bytes(b"x")
    assert folder.measure() == 2
    for path in growing:
        path.write_bytes(bytes(10_000_000))
    assert folder.new_kept(store.files) == {}  # as an honest one rewrites it: the next time
    with pytest.raises(InvalidOutputError):
        folder.new_frames(store.files)
    with pytest.raises(InvalidOutputError):
        folder.store(store.files, {})
    assert list(store.files.list_stored()) == []
    secret = settings.data_dir / "secret"
    secret.write_text("of the service")
    growing[0].unlink()
    growing[0].symlink_to(secret)
    with pytest.raises(OSError, match="symbolic"):
        store.files.put(growing[0])


def test_a_file_takes_its_own_place_in_the_quota(settings: Settings, store: Store) -> None:
    folder = AttemptFolder(settings.work, _claimed(store, "simulate"))
    folder.stage(store)
    shapes = folder.path / "out" / KEPT[0]
    for size, new in ((600, 600), (900, 300), (100, 0)):
        shapes.write_bytes(bytes(size))
        folder.measure()
        assert folder.unstored_bytes() == new
        assert folder.new_kept(store.files)


def test_two_jobs_that_end_at_once_share_a_quota(
    settings: Settings, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    claim = _claimed(store)
    supervisor = _supervisor(store, settings)
    folder = AttemptFolder(settings.work, claim)
    folder.stage(store)
    (folder.path / "out" / "model.npz").write_bytes(bytes(600))
    (folder.path / "result.json").write_text(json.dumps({"summary": {}, "expressions": []}))
    put = store.files.put

    def meanwhile(*given: Any) -> Any:
        with store.write() as session:
            session.get_one(Tenant, DEFAULT_TENANT).max_bytes = 500
        return put(*given)

    monkeypatch.setattr(store.files, "put", meanwhile)
    with pytest.raises(OutputSizeError):
        supervisor._commit_outcome(claim, folder, 0, 60)
    with store.read() as session:
        assert session.get_one(Job, claim.job_id).state is State.RUNNING


def test_a_solver_that_cannot_be_noted_is_ended(
    settings: Settings, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = AttemptFolder(settings.work, _claimed(store))
    folder.stage(store)
    started = []

    def full(_: Path, leader: int) -> None:
        started.append(leader)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(process, "note_session", full)
    with pytest.raises(OSError, match="No space"):
        process.SolverProcess(folder.path, settings, DEFAULT_TENANT, 60.0)
    with pytest.raises(ProcessLookupError):
        os.killpg(started[0], 0)


def test_a_database_s_words_are_not_the_customer_s() -> None:
    error = OperationalError("SELECT secret", None, Exception("at db.internal:5432"))
    told = crash_error(error)
    assert told == {"code": "worker.crash", "message": "the worker failed: OperationalError"}


@pytest.fixture
def outside() -> Iterator[Path]:
    """A folder that is removed even after a failure: pytest cannot remove folders this deep."""
    folder = Path(tempfile.mkdtemp())
    yield folder
    subprocess.run(["rm", "-rf", folder], check=True)


def test_an_attempt_goes_however_deep_its_folders_are(outside: Path) -> None:
    here = os.open(outside, os.O_RDONLY)
    for _ in range(2500):
        os.mkdir("deep", dir_fd=here)
        below = os.open("deep", os.O_RDONLY, dir_fd=here)
        os.close(here)
        here = below
    os.close(here)
    remove_tree(outside / "deep")
    assert not (outside / "deep").exists()


class Jobs:
    """Jobs of a package of their own, claimed and done by a supervisor with real processes."""

    def __init__(
        self, folder: Path, settings: Settings, store: Store, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (folder / "made").mkdir()
        (folder / "made" / "__init__.py").touch()
        self._made = folder / "made"
        self._settings = settings.model_copy(
            update={"jobs": "made", "lease": 2.0, "beat": 0.2, "solver_threads": 1}
        )
        self._store = store
        monkeypatch.setenv("PYTHONPATH", f"{folder}:{ROOT}")

    def add(
        self, code: str, inputs: Sequence[dict[str, Any]] = (), kind: str = "build_model"
    ) -> str:
        """Queue a job that does what ``code`` says; returns its id."""
        body = textwrap.indent(textwrap.dedent(code), "    ")
        (self._made / f"{kind}.py").write_text(f"import os, time\n\ndef run(task):\n{body}\n")
        with self._store.write() as session:
            session.add(subject := Subject(tenant_id=DEFAULT_TENANT, name="Alex"))
            session.flush()
            job = Job(
                tenant_id=DEFAULT_TENANT,
                subject_id=subject.id,
                kind=kind,
                queue="short",
                request={"options": {}, "rig_id": None},
                inputs=list(inputs),
                max_attempts=3,
            )
            table.create(session, job)
            return job.id

    def run_next(self) -> Supervisor:
        """Do the next job."""
        can = abilities(self._settings)
        supervisor = Supervisor(self._store, self._settings, can, threading.Event())
        assert supervisor.run_next("short")
        return supervisor

    def state(self, job_id: str) -> tuple[State, int, str | None]:
        """Return a job's state, how many attempts were lost, and the code of its error."""
        with self._store.read() as session:
            job = session.get_one(Job, job_id)
            return job.state, job.lost, (job.error or {}).get("code")


@pytest.fixture
def jobs(tmp_path: Path, settings: Settings, store: Store, monkeypatch: pytest.MonkeyPatch) -> Jobs:
    return Jobs(tmp_path, settings, store, monkeypatch)


SUCCEED = """
    (task.out / "model.json").write_text("{}")
    (task.out / "model.npz").write_bytes(bytes(600))
"""


@pytest.mark.parametrize(
    ("quota", "bound", "code"), [(1000, 4000, "quota.bytes"), (None, 1000, "solver.output")]
)
def test_nothing_of_what_is_too_much_is_stored(
    jobs: Jobs,
    store: Store,
    monkeypatch: pytest.MonkeyPatch,
    quota: int | None,
    bound: int,
    code: str,
) -> None:
    monkeypatch.setitem(kind.QUEUE_BYTES, "short", bound)
    with store.write() as session:
        session.get_one(Tenant, DEFAULT_TENANT).max_bytes = quota
    more = '    (task.out / "more.npz").write_bytes(bytes(600))'
    too_much = jobs.add(SUCCEED + more)
    jobs.run_next()
    assert jobs.state(too_much) == (State.FAILED, 0, code)
    assert list(store.files.list_stored()) == []
    fitting = jobs.add(SUCCEED)
    jobs.run_next()
    assert jobs.state(fitting)[0] is State.SUCCEEDED
    assert len(list(store.files.list_stored())) == 2


@pytest.mark.long
def test_frames_are_too_much_while_they_come(
    jobs: Jobs, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(kind.QUEUE_BYTES, "long", 10_000)
    endless = """
    (task.out / "frames").mkdir()
    for number in range(1000):
        (task.out / "frames" / f"{number:06d}-{number:06d}.json").write_bytes(bytes(1000))
        time.sleep(0.1)
    """
    job = jobs.add(endless, kind="fit_sequence")
    jobs.run_next()
    assert jobs.state(job) == (State.FAILED, 0, "solver.output")
    assert len(list(store.files.list_stored())) <= 10


def test_files_without_end_are_too_many(
    jobs: Jobs, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(attempt, "MOST_NAMES", 40)
    empty = """
    (task.out / "frames").mkdir()
    for number in range(50):
        (task.out / "frames" / f"{number}-{number}.json").touch()
    time.sleep(60)
    """
    job = jobs.add(empty)
    jobs.run_next()
    assert jobs.state(job) == (State.FAILED, 0, "solver.verdict")
    assert list(store.files.list_stored()) == []


def test_frames_are_of_kinds_that_leave_them(settings: Settings, store: Store) -> None:
    folder = AttemptFolder(settings.work, _claimed(store))
    folder.stage(store)
    (folder.path / "out" / FRAMES).mkdir()
    (folder.path / "out" / FRAMES / "0-9.json").write_text("{}")
    folder.measure()
    assert folder.new_frames(store.files) == []


@pytest.mark.parametrize(
    ("wasteful", "code"),
    [
        ('open(task.out.parent / "tmp" / "x", "wb").write(bytes(3_000_000))', "solver.output"),
        ('[(task.out.parent / "cache" / str(n)).touch() for n in range(400)]', "solver.verdict"),
    ],
)
def test_what_a_solver_writes_anywhere_is_bounded(
    jobs: Jobs,
    store: Store,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    wasteful: str,
    code: str,
) -> None:
    monkeypatch.setenv("MYOFACE_CACHE", str(tmp_path / "installed"))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "compiled"))
    monkeypatch.setitem(kind.QUEUE_BYTES, "short", 1_000_000)
    monkeypatch.setattr(supervise, "SCRATCH", 1_000_000)
    monkeypatch.setattr(supervise, "COUNT_EVERY", 2)
    monkeypatch.setattr(attempt, "MOST_ENTRIES", 300)
    source = tmp_path / "scan.obj"
    source.write_bytes(bytes(5_000_000))  # what was staged is not the solver's
    scan = {"role": "neutral", "name": "scan", "filename": "scan.obj"}
    scan["sha256"] = store.files.put(source).sha256
    job = jobs.add(f"\n    {wasteful}\n    time.sleep(60)\n", inputs=[scan])
    jobs.run_next()
    assert jobs.state(job) == (State.FAILED, 0, code)


WAIT_FOR_FAULT = """
begun = task.out / "begun"
begun.touch()
while begun.exists():
    time.sleep(0.05)
"""


def _remove_work(settings: Settings, _: Store) -> None:
    eventually(lambda: any(settings.work.glob("*.1/out/begun")), seconds=30)
    shutil.rmtree(settings.work, ignore_errors=True)


def _drop_artifacts(settings: Settings, store: Store) -> None:
    eventually(lambda: any(settings.work.glob("*.1/out/begun")), seconds=30)
    with store.write() as session:
        session.execute(text("DROP TABLE artifacts"))
    for begun in settings.work.glob("*.1/out/begun"):
        begun.unlink()


@pytest.mark.parametrize("fault", [None, _remove_work, _drop_artifacts])
def test_a_worker_goes_on_whatever_happens(
    jobs: Jobs, settings: Settings, store: Store, fault: Callable[[Settings, Store], None] | None
) -> None:
    """A row of another release, a work folder that is removed, a database that is spoilt."""
    code = WAIT_FOR_FAULT + textwrap.dedent(SUCCEED)
    job = jobs.add(code, inputs=[{"role": "neutral"}] if fault is None else ())
    if fault is not None:
        threading.Thread(target=fault, args=[settings, store], daemon=True).start()
    jobs.run_next()
    state, lost, _ = jobs.state(job)
    assert (state, lost) == (State.QUEUED, 1)
    with store.write() as session:
        session.execute(delete(Job).where(Job.id == job))
        Artifact.__table__.create(session.connection(), checkfirst=True)  # type: ignore[attr-defined]
    next_one = jobs.add(SUCCEED)
    jobs.run_next()
    assert jobs.state(next_one)[0] is State.SUCCEEDED


@pytest.mark.skipif(sys.platform != "linux", reason="the signal of the limit is Linux's")
def test_the_system_ends_a_job_whose_supervisor_does_not(
    jobs: Jobs, settings: Settings, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process, "CPU_MARGIN", 2.0)
    spinning = """
    import signal
    (task.out / "begun").touch()
    while True:
        pass
    """
    job = jobs.add(spinning)
    with store.write() as session:
        claim = table.take(session, job, "me", 60)
    assert claim is not None
    folder = AttemptFolder(settings.work, claim)
    folder.stage(store)
    solver = process.SolverProcess(folder.path, jobs._settings, DEFAULT_TENANT, 1.0)
    try:
        code = solver.wait(60)  # as long as nobody looks at the clock
        assert code == -signal.SIGXCPU
    finally:
        solver.finish()
    assert (folder.path / "out" / "begun").exists()
    supervisor = _supervisor(store, settings)
    supervisor._commit_outcome(claim, folder, code, 60)
    assert jobs.state(job) == (State.FAILED, 0, "job.timeout")
