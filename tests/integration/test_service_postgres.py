"""The job table's rules on PostgreSQL, with a server of the test's own."""

from __future__ import annotations

import getpass
import os
import shutil
import subprocess
import threading
import time
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import pytest

from service.access import bootstrap
from service.access.keys import Keyring
from service.secret import secret
from service.settings import Settings
from service.store import jobs, retention, sweep
from service.store.database import clock
from service.store.models import DEFAULT_TENANT, Job, Subject, Tenant
from service.store.store import Store
from service.store.transitions import State
from tests.service_client import running, served


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    if "MYOFACE_TEST_POSTGRES" in os.environ:
        yield os.environ["MYOFACE_TEST_POSTGRES"]
        return
    programs = _programs()
    if programs is None:
        pytest.skip("no PostgreSQL server here (initdb); set MYOFACE_TEST_POSTGRES to use another")
    folder = tmp_path_factory.mktemp("postgres")
    as_user: list[str] = []
    if os.geteuid() == 0:  # initdb refuses to run as root
        if shutil.which("runuser") is None:
            pytest.skip("PostgreSQL does not run as root, and there is no runuser")
        for parent in (folder, folder.parent, folder.parent.parent):
            parent.chmod(0o755)
        shutil.chown(folder, "postgres")
        as_user = ["runuser", "-u", "postgres", "--"]
    user = "postgres" if as_user else getpass.getuser()
    data, log = folder / "data", folder / "log"
    options = f"-c listen_addresses='' -c unix_socket_directories='{folder}' -c fsync=off"

    def control(*words: str) -> None:
        command = [*as_user, *words]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd=folder, timeout=60)

    control(str(programs / "initdb"), "-D", str(data), "-A", "trust", "-U", user)
    start = ["-D", str(data), "-l", str(log), "-o", options, "-w", "start"]
    control(str(programs / "pg_ctl"), *start)
    try:
        yield f"postgresql://{user}@/postgres?host={folder}"
    finally:
        control(str(programs / "pg_ctl"), "-D", str(data), "-m", "immediate", "stop")


def test_a_job_is_claimed_by_one_of_many(url: str, tmp_path: Path) -> None:
    store = _store(url, tmp_path)
    job_id = _queue(store)
    claims: list[jobs.Claim | None] = []
    ready = threading.Barrier(8)

    def claim(number: int) -> None:
        ready.wait()
        with store.write() as session:
            claims.append(jobs.claim(session, job_id, f"worker {number}", 30))

    threads = [threading.Thread(target=claim, args=(number,)) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [one.attempt for one in claims if one] == [1]
    store.close()


def test_a_lost_attempt_is_fenced_off(url: str, tmp_path: Path) -> None:
    store = _store(url, tmp_path)
    job_id = _queue(store)
    with store.write() as session:
        first = jobs.claim(session, job_id, "slow", 0.01)
    time.sleep(0.05)
    with store.write() as session:
        sweep.expire_leases(session)
    with store.write() as session:
        second = jobs.claim(session, job_id, "quick", 30)
    assert first
    assert second
    with store.write() as session:
        assert jobs.beat(session, job_id, first.attempt, 30) is None
        assert not jobs.succeed(session, job_id, first.attempt, [])
        assert jobs.succeed(session, job_id, second.attempt, [])
    with store.read() as session:
        job = session.get(Job, job_id)
        assert job
        assert job.state is State.SUCCEEDED
        assert abs(clock(session) - job.created_at) < timedelta(minutes=1)
    store.close()


@pytest.mark.slow
def test_the_whole_service_runs_on_it(url: str, tmp_path: Path) -> None:
    with running(tmp_path, database_url=url) as (_, studio):
        subject = studio.post("/v1/subjects", name="Alex")["id"]
        neutral, smile = studio.raw(subject, "neutral", "neutral"), studio.raw(subject, "smile")
        for capture in (neutral, smile):
            studio.done("check_scan", subject, captures=[capture])
            studio.done("register_scan", subject, captures=[capture])
        studio.done("build_model", subject)
        studio.done("fit_geometry", subject, captures=[smile])
        first = studio.get(f"/v1/jobs?subject_id={subject}&limit=4")
        rest = studio.get(f"/v1/jobs?subject_id={subject}&limit=4&cursor={first['next']}")
        assert [len(first["items"]), len(rest["items"]), rest["next"]] == [4, 2, None]
        shown = studio.get(f"/v1/subjects/{subject}/captures")["items"]
        assert [each["check"]["verdict"] for each in shown] == ["good", "good"]
        assert studio.http.delete(f"/v1/subjects/{subject}/captures/{smile}").status_code == 204
        assert studio.http.delete(f"/v1/subjects/{subject}").status_code == 204
        assert studio.get(f"/v1/jobs?subject_id={subject}")["items"] == []


def test_requests_that_cross_wait_for_one_another(url: str, tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path, database_url=url)
    store = _store(url, tmp_path / "files")
    bootstrap.admin_key(store, Keyring(store, secret(settings)), settings, only_first=False)
    with store.write() as session:
        session.get_one(Tenant, DEFAULT_TENANT).max_queued = 2
    with served(settings) as studio:
        subject = studio.subject()
        body = {"kind": "build_model", "subject_id": subject}
        answers: list[tuple[int, str]] = []
        ready = threading.Barrier(8)

        def submit(number: int) -> None:
            ready.wait()
            headers = {"Idempotency-Key": f"job {number % 4}".replace(" ", "-")}
            answer = studio.http.post("/v1/jobs", json=body, headers=headers)
            answers.append((answer.status_code, answer.json().get("code", "")))

        threads = [threading.Thread(target=submit, args=(number,)) for number in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        refused = {(409, "idempotency.in_flight"), (429, "quota.queued")}
        assert set(answers) <= {(201, ""), *refused}, answers
        assert len(studio.get(f"/v1/jobs?subject_id={subject}")["items"]) == 2
        assert studio.get("/v1/usage")["queued"] == {"used": 2, "limit": 2}
        receipt = studio.http.delete(f"/v1/subjects/{subject}?cancel=true").headers["Location"]
        retention.enforce(store, settings.model_copy(update={"retain_jobs": 1, "retain_rigs": 1}))
        assert studio.get(receipt)["rows_at"] is not None
        assert studio.get("/v1/audit")["items"][0]["action"] == "subject.deleted"
    with store.write() as session:
        session.get_one(Tenant, DEFAULT_TENANT).max_queued = None
    store.close()


def _programs() -> Path | None:
    """Return the folder of the server's programs, which Debian keeps off PATH."""
    on_path = shutil.which("initdb")
    if on_path:
        return Path(on_path).resolve().parent
    return next(iter(sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)), None)


def _store(url: str, folder: Path) -> Store:
    url = url.replace("postgresql://", "postgresql+psycopg://")
    store = Store(url, folder, f"redis+socket://{folder}/nobody")
    store.database.migrate()
    return store


def _queue(store: Store) -> str:
    with store.write() as session:
        subject = Subject(tenant_id=DEFAULT_TENANT, name="Alex")
        session.add(subject)
        session.flush()
        job = Job(
            tenant_id=DEFAULT_TENANT,
            subject_id=subject.id,
            kind="build_model",
            queue="short",
            request={"options": {}, "rig_id": None},
            inputs=[],
            max_attempts=3,
        )
        jobs.create(session, job)
        return job.id
