"""Webhooks: told exactly what happened, signed, tried again, and never holding up anybody."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi import FastAPI
from sqlalchemy import update
from standardwebhooks.webhooks import Webhook as Verifier
from standardwebhooks.webhooks import WebhookVerificationError

from service.dependencies import part
from service.outbound import Sender
from service.queue import outbox, table
from service.secret import secret
from service.settings import Settings
from service.store.database import Store, clock
from service.store.models import Tenant, Webhook
from tests.receiver import LOOPBACK, Receiver, ok, receiving
from tests.servers.production import Production
from tests.service_client import Studio, eventually, running, served
from worker.deliver import Deliverer


@pytest.fixture(scope="module")
def settings(parts: Production | None, tmp_path_factory: pytest.TempPathFactory) -> Settings:
    return Settings(
        data_dir=tmp_path_factory.mktemp("webhooks"),
        webhook_allow=LOOPBACK,
        webhook_timeout=2,
        webhook_schedule=[0.1, 0.1, 0.1],
        webhook_workers=4,
    )


@pytest.fixture(scope="module")
def api(settings: Settings) -> Iterator[Studio]:
    with served(settings) as studio:
        yield studio


@pytest.fixture
def studio(api: Studio) -> Iterator[Studio]:
    yield api
    for hook in api.get("/v1/webhooks")["items"]:
        assert api.http.delete(f"/v1/webhooks/{hook['id']}").status_code == 204


def _store(studio: Studio) -> Store:
    store: Store = studio.http.app.state.store  # type: ignore[attr-defined]
    return store


@contextmanager
def delivering(studio: Studio, settings: Settings, sender: Sender | None = None) -> Iterator[None]:
    stopping = threading.Event()
    sender = sender or Sender(settings.webhook_timeout, settings.webhook_allow)
    deliverer = Deliverer(_store(studio), settings, secret(settings), sender, stopping)
    thread = threading.Thread(target=deliverer.run)
    thread.start()
    try:
        yield
    finally:
        stopping.set()
        thread.join()


def _hook(studio: Studio, port: int, **more: Any) -> Any:
    return studio.post("/v1/webhooks", url=f"http://127.0.0.1:{port}/in", **more)


def _log(studio: Studio, hook: Any) -> list[Any]:
    log: list[Any] = studio.get(f"/v1/webhooks/{hook['id']}/deliveries")["items"]
    return log


def _until(studio: Studio, hook: Any, state: str) -> Any:
    eventually(lambda: [each["state"] for each in _log(studio, hook)] == [state])
    return _log(studio, hook)[0]


def _refused(answer: httpx.Response, status: int, code: str) -> None:
    assert (answer.status_code, answer.json()["code"]) == (status, code), answer.text


def test_a_job_is_told_step_by_step_in_ids_and_signed(studio: Studio, settings: Settings) -> None:
    with receiving() as (port, got), delivering(studio, settings):
        hook = _hook(studio, port)
        subject = studio.subject()
        job = studio.submit("build_model", subject)
        studio.pretend(job, {})
        eventually(lambda: len(got) == 2)
        eventually(lambda: {each["state"] for each in _log(studio, hook)} == {"delivered"})
    told = [Verifier(hook["secret"]).verify(body, headers) for _, headers, body in got]
    assert {each["type"] for each in told} == {"job.started", "job.succeeded"}
    for each in told:
        data = each["data"]
        assert (data["job_id"], data["subject_id"], data["attempt"]) == (job, subject, 1)
        assert "Alex" not in json.dumps(each)
    ids = [headers["webhook-id"] for _, headers, _ in got]
    assert len(set(ids)) == 2
    log = _log(studio, hook)
    assert {each["event_id"] for each in log} == set(ids)
    assert all(each["status"] == 204 and each["attempt"] == 1 for each in log)


def test_a_change_that_is_rolled_back_is_not_told(studio: Studio, settings: Settings) -> None:
    with receiving() as (port, _):
        hook = _hook(studio, port)
        job = studio.submit("build_model", studio.subject())

        def claim_and_fail() -> None:
            with _store(studio).write() as session:
                assert table.take(session, job, "test", 10)
                raise RuntimeError("the transaction is lost")

        with pytest.raises(RuntimeError):
            claim_and_fail()
        assert _log(studio, hook) == []


def test_a_filter_by_event_and_kind(studio: Studio) -> None:
    with receiving() as (port, _):
        over = _hook(studio, port, events=["job.succeeded", "job.canceled"])
        fits = _hook(studio, port, kinds=["fit_geometry"])
        checks = _hook(studio, port, events=["scan.checked"])
        subject = studio.subject()
        job = studio.submit("build_model", subject)
        studio.pretend(job, {})
        studio.http.post(f"/v1/jobs/{studio.submit('build_model', subject)}/cancel")
        check = studio.submit("check_scan", subject, captures=[studio.raw(subject, "smile")])
        studio.pretend(check, {}, {"verdict": "usable"})
        assert [each["type"] for each in _log(studio, over)] == [
            "job.succeeded",
            "job.canceled",
            "job.succeeded",
        ]
        assert _log(studio, fits) == []
        [checked] = _log(studio, checks)
        assert checked["data"]["verdict"] == "usable"


def test_the_end_of_a_batch_is_told(studio: Studio) -> None:
    with receiving() as (port, _):
        hook = _hook(studio, port, events=["batch.finished"])
        scans = [
            {
                "name": name,
                "role": "neutral" if name == "neutral" else "expression",
                "registered": False,
                "upload_id": studio.upload(f"{name}.obj", f"# {name}".encode()),
            }
            for name in ("neutral", "smile")
        ]
        batch = studio.post("/v1/batches", subject={"name": "Alex"}, captures=scans)
        studio.post(f"/v1/batches/{batch['id']}/cancel")
        [told] = _log(studio, hook)
        assert told["data"] == {
            "batch_id": batch["id"],
            "subject_id": batch["subject_id"],
            "state": "canceled",
        }


def test_a_receiver_that_fails_is_tried_again_with_the_same_event(
    studio: Studio, settings: Settings
) -> None:
    answers = iter([500, 429, 204])

    def moody(receiver: Receiver) -> None:
        receiver.send_response(next(answers))
        receiver.end_headers()
        receiver.wfile.write(b"an explanation")

    with receiving(moody) as (port, got), delivering(studio, settings):
        hook = _hook(studio, port)
        studio.post(f"/v1/webhooks/{hook['id']}/test")
        delivery = _until(studio, hook, "delivered")
        assert studio.get(f"/v1/webhooks/{hook['id']}")["failing_since"] is None
    assert (delivery["attempt"], delivery["error"]) == (3, None)
    assert len({headers["webhook-id"] for _, headers, _ in got}) == 1
    assert len({body for _, _, body in got}) == 1


@pytest.mark.parametrize(("status", "is_heard"), [(429, True), (503, True), (500, False)])
def test_a_receiver_that_is_busy_says_when_to_come_back(
    studio: Studio, settings: Settings, status: int, is_heard: bool
) -> None:
    def busy(receiver: Receiver) -> None:
        receiver.send_response(status)
        receiver.send_header("Retry-After", "600")
        receiver.end_headers()

    with receiving(busy) as (port, _), delivering(studio, settings):
        hook = _hook(studio, port)
        studio.post(f"/v1/webhooks/{hook['id']}/test")
        eventually(lambda: _log(studio, hook)[0]["status"] == status)
        delivery = _log(studio, hook)[0]
        if is_heard:
            pause = datetime.fromisoformat(delivery["next_at"]) - datetime.now(UTC)
            assert timedelta(seconds=580) < pause <= timedelta(seconds=600)
        else:
            assert _until(studio, hook, "failed")["attempt"] == 4


def test_a_receiver_that_is_busy_is_left_alone_by_all_that_waits_for_it(
    studio: Studio, settings: Settings
) -> None:
    def busy(receiver: Receiver) -> None:
        receiver.send_response(429)
        receiver.send_header("Retry-After", "600")
        receiver.end_headers()

    with receiving(busy) as (port, got), receiving() as (other, told):
        hook = _hook(studio, port)
        ready = _hook(studio, other)
        for _ in range(6):
            studio.post(f"/v1/webhooks/{hook['id']}/test")
        with delivering(studio, settings):
            eventually(lambda: any(each["status"] for each in _log(studio, hook)))
            studio.post(f"/v1/webhooks/{ready['id']}/test")
            eventually(lambda: len(told) == 1)
        assert len(got) <= outbox.AT_ONCE_PER_WEBHOOK
        earliest = datetime.now(UTC) + timedelta(seconds=570)
        for each in _log(studio, hook):
            assert datetime.fromisoformat(each["next_at"]) > earliest


def test_a_receiver_can_put_a_try_off_for_a_day_at_most(studio: Studio) -> None:
    hook = _hook(studio, 1)
    studio.post(f"/v1/webhooks/{hook['id']}/test")
    with _store(studio).write() as session:
        [parcel] = outbox.take(session, [], threads=1, lease=10)
        wish = outbox.DeliveryOutcome(status=429, retry_after=1e9)
        outbox.settle(session, parcel, wish, pauses=[1.0])
    next_at = datetime.fromisoformat(_log(studio, hook)[0]["next_at"])
    assert timedelta(hours=23) < next_at - datetime.now(UTC) <= timedelta(days=1)


def test_after_the_last_try_it_has_failed_and_can_be_sent_again(
    studio: Studio, settings: Settings
) -> None:
    works = threading.Event()

    def script(receiver: Receiver) -> None:
        receiver.send_response(204 if works.is_set() else 500)
        receiver.end_headers()

    with receiving(script) as (port, got), delivering(studio, settings):
        hook = _hook(studio, port)
        studio.post(f"/v1/webhooks/{hook['id']}/test")
        failed = _until(studio, hook, "failed")
        assert (failed["attempt"], failed["status"], failed["error"]) == (4, 500, "answer.status")
        assert studio.get(f"/v1/webhooks/{hook['id']}")["failing_since"]
        works.set()
        again = studio.http.post(f"/v1/deliveries/{failed['id']}/redeliver")
        assert again.status_code == 202
        path = f"/v1/deliveries/{again.json()['id']}"
        eventually(lambda: studio.get(path)["state"] == "delivered")
        assert studio.get(path)["event_id"] == failed["event_id"]
    assert len({headers["webhook-id"] for _, headers, _ in got}) == 1


def test_a_receiver_that_is_gone_is_told_nothing_more(studio: Studio, settings: Settings) -> None:
    def gone(receiver: Receiver) -> None:
        receiver.send_response(410)
        receiver.end_headers()

    with receiving(gone) as (port, got), delivering(studio, settings):
        hook = _hook(studio, port)
        path = f"/v1/webhooks/{hook['id']}"
        studio.post(f"{path}/test")
        _until(studio, hook, "failed")
        shown = studio.get(path)
        assert (shown["active"], shown["disabled_reason"]) == (False, "gone")
        _refused(studio.http.post(f"{path}/test"), 409, "webhook.inactive")
        assert len(got) == 1
        assert studio.http.patch(path, json={"active": True}).json()["active"]


def test_a_receiver_that_fails_for_days_is_switched_off(studio: Studio, settings: Settings) -> None:
    def fails(receiver: Receiver) -> None:
        receiver.send_response(503)
        receiver.end_headers()

    with receiving(fails) as (port, _):
        hook = _hook(studio, port)
        with _store(studio).write() as session:
            since = clock(session) - timedelta(days=5, hours=1)
            session.execute(update(Webhook).values(failing_since=since))
        studio.post(f"/v1/webhooks/{hook['id']}/test")
        with delivering(studio, settings):
            _until(studio, hook, "failed")
        shown = studio.get(f"/v1/webhooks/{hook['id']}")
        assert (shown["active"], shown["disabled_reason"]) == (False, "failing")


def test_dead_receivers_hold_up_nobody(studio: Studio, settings: Settings) -> None:
    over = threading.Event()

    def silent(_receiver: Receiver) -> None:
        over.wait(6)

    settings = settings.model_copy(update={"webhook_timeout": 1})
    with receiving(silent) as (dead, _), receiving() as (port, got):
        hooks = [_hook(studio, dead, events=["batch.finished"]) for _ in range(3)]
        for hook in hooks:
            for _ in range(20):
                studio.post(f"/v1/webhooks/{hook['id']}/test")
        with delivering(studio, settings):
            for hook in hooks:
                path = f"/v1/webhooks/{hook['id']}"
                eventually(lambda path=path: studio.get(path)["failing_since"])  # type: ignore[misc]
            good = _hook(studio, port)
            started = time.monotonic()
            for _ in range(5):
                studio.post(f"/v1/webhooks/{good['id']}/test")
            eventually(lambda: len(got) == 5, seconds=6)
            assert time.monotonic() - started < 5
            over.set()


@pytest.fixture
def neighbour(api: Studio) -> Iterator[Webhook]:
    """Another tenant's webhook, without an address."""
    store = _store(api)
    with store.write() as session:
        session.add(other := Tenant(name="another studio"))
        session.flush()
        hook = Webhook(tenant_id=other.id, url="", events=[], kinds=[])
        session.add(hook)
    yield hook
    with store.write() as session:
        session.delete(session.get_one(Webhook, hook.id))


def test_slow_receivers_of_one_tenant_hold_up_no_other_for_longer_than_an_answer(
    studio: Studio, settings: Settings, neighbour: Webhook
) -> None:
    answers = threading.Semaphore(0)
    order: list[str] = []

    def slow(receiver: Receiver) -> None:
        order.append("slow")
        answers.acquire(timeout=5)
        ok(receiver)

    def quick(receiver: Receiver) -> None:
        order.append("other")
        ok(receiver)

    settings = settings.model_copy(update={"webhook_timeout": 10})
    with receiving(slow) as (port, taken), receiving(quick) as (other, got):
        for _ in range(4):
            hook = _hook(studio, port)
            for _ in range(3):
                studio.post(f"/v1/webhooks/{hook['id']}/test")
        with delivering(studio, settings):
            eventually(lambda: len(taken) == 4)  # all threads, for nobody else needs one
            with _store(studio).write() as session:
                hook = session.get_one(Webhook, neighbour.id)
                hook.url = f"http://127.0.0.1:{other}/in"
                outbox.send(session, [hook], outbox.TEST, {})
            answers.release()
            eventually(lambda: len(got) == 1)
            answers.release(11)
    assert order[:5] == ["slow"] * 4 + ["other"]


def test_a_tenant_alone_has_all_threads_of_all_workers(studio: Studio, settings: Settings) -> None:
    over = threading.Event()

    def slow(receiver: Receiver) -> None:
        over.wait(5)
        ok(receiver)

    settings = settings.model_copy(update={"webhook_timeout": 10})
    with receiving(slow) as (port, taken):
        for _ in range(5):
            hook = _hook(studio, port)
            for _ in range(2):
                studio.post(f"/v1/webhooks/{hook['id']}/test")
        with delivering(studio, settings), delivering(studio, settings):
            eventually(lambda: len(taken) == 8, seconds=4)
            over.set()


def _take(
    studio: Studio, under_way: list[outbox.ClaimedDelivery], threads: int
) -> list[outbox.ClaimedDelivery]:
    with _store(studio).write() as session:
        return outbox.take(session, under_way, threads, lease=10)


def _are_of(hook: Webhook, parcels: list[outbox.ClaimedDelivery]) -> list[bool]:
    return [parcel.tenant_id == hook.tenant_id for parcel in parcels]


def test_each_worker_counts_only_its_own_threads(studio: Studio, neighbour: Webhook) -> None:
    for hook in [_hook(studio, 1) for _ in range(6)]:
        studio.post(f"/v1/webhooks/{hook['id']}/test")

    with _store(studio).write() as session:
        for _ in range(2):
            outbox.send(session, [session.get_one(Webhook, neighbour.id)], outbox.TEST, {})
    first = _take(studio, [], 4)
    assert _are_of(neighbour, first) == [False, True, False, True]
    mine = [parcel for parcel in first if parcel.tenant_id != neighbour.tenant_id]
    rest = _take(studio, mine, 4)
    assert _are_of(neighbour, rest) == [False, False]  # nobody else has anything due any more
    more = _take(studio, [], 4)
    assert _are_of(neighbour, more) == [False, False]  # another worker, whose threads are free


def test_tenants_take_turns_the_one_with_least_under_way_first(
    studio: Studio, neighbour: Webhook
) -> None:
    for hook in [_hook(studio, 1) for _ in range(3)]:
        studio.post(f"/v1/webhooks/{hook['id']}/test")
    with _store(studio).write() as session:
        hook = session.get_one(Webhook, neighbour.id)
        outbox.send(session, [hook], outbox.TEST, {})
        outbox.send(session, [hook], outbox.TEST, {})

    [mine] = _take(studio, [], 1)
    assert _are_of(neighbour, [mine]) == [False]
    later = _take(studio, [mine], 5)
    assert _are_of(neighbour, later) == [True, False, True, False]
    assert _take(studio, [mine, *later], 9) == []


def test_several_workers_send_everything_once(studio: Studio, settings: Settings) -> None:
    with receiving() as (port, got):
        hook = _hook(studio, port)
        for _ in range(30):
            studio.post(f"/v1/webhooks/{hook['id']}/test")
        with delivering(studio, settings), delivering(studio, settings):
            eventually(
                lambda: {each["state"] for each in _log(studio, hook)} == {"delivered"}, seconds=60
            )
        tries = sum(each["attempt"] for each in _log(studio, hook))
    ids = [headers["webhook-id"] for _, headers, _ in got]
    assert len(set(ids)) == 30
    assert len(ids) <= tries  # one whose answer came too late is sent again, by one of them


def test_a_worker_that_died_has_lost_its_delivery_and_is_fenced(studio: Studio) -> None:
    with receiving() as (port, _):
        hook = _hook(studio, port)
        studio.post(f"/v1/webhooks/{hook['id']}/test")
    store = _store(studio)

    def take(lease: float) -> list[outbox.ClaimedDelivery]:
        with store.write() as session:
            return outbox.take(session, [], threads=5, lease=lease)

    [first] = take(0.2)
    assert take(10) == []
    time.sleep(0.3)
    [second] = take(10)
    assert (second.delivery_id, second.attempt) == (first.delivery_id, 2)
    with store.write() as session:
        outbox.settle(session, first, outbox.DeliveryOutcome(status=204, ms=1), [])
    assert _log(studio, hook)[0]["state"] == "pending"
    with store.write() as session:
        outbox.settle(session, second, outbox.DeliveryOutcome(status=204, ms=1), [])
    assert _log(studio, hook)[0]["state"] == "delivered"


def test_a_new_secret_and_the_old_one_sign_for_a_day(studio: Studio, settings: Settings) -> None:
    with receiving() as (port, got), delivering(studio, settings):
        hook = _hook(studio, port)
        path = f"/v1/webhooks/{hook['id']}"
        rotated = studio.post(f"{path}/rotate")
        assert rotated["secret"] != hook["secret"]
        studio.post(f"{path}/test")
        eventually(lambda: len(got) == 1)
        for each in (hook["secret"], rotated["secret"]):
            Verifier(each).verify(got[0][2], got[0][1])
        with _store(studio).write() as session:
            before = clock(session) - timedelta(days=1, seconds=1)
            session.execute(update(Webhook).values(rotated_at=before))
        studio.post(f"{path}/test")
        eventually(lambda: len(got) == 2)
        Verifier(rotated["secret"]).verify(got[1][2], got[1][1])
        with pytest.raises(WebhookVerificationError):
            Verifier(hook["secret"]).verify(got[1][2], got[1][1])
    assert "secret" not in studio.get(path)


@pytest.mark.parametrize(
    "url",
    [
        "http://10.0.0.1/",
        "https://169.254.169.254/latest/meta-data",
        "http://[::ffff:10.0.0.1]/",
        "http://192.168.0.1:6379/",
        "http://0xa000001/",
        "http://8.8.8.8:22/",
    ],
)
def test_addresses_inside_the_network_are_refused_at_once(studio: Studio, url: str) -> None:
    answer = studio.http.post("/v1/webhooks", json={"url": url})
    _refused(answer, 422, "webhook.url")
    assert "MYOFACE_WEBHOOK_ALLOW" in answer.json()["detail"]
    with receiving() as (port, _):
        hook = _hook(studio, port)
    _refused(studio.http.patch(f"/v1/webhooks/{hook['id']}", json={"url": url}), 422, "webhook.url")


def test_a_name_is_not_looked_up_while_somebody_waits(studio: Studio, settings: Settings) -> None:
    looked_up: list[str] = []

    def resolver(host: str, _port: int) -> list[str]:
        looked_up.append(host)
        return ["10.0.0.1"]

    sender = Sender(2, resolver=resolver)
    app: FastAPI = studio.http.app  # type: ignore[attr-defined]
    app.dependency_overrides[part("sender")] = lambda: sender
    try:
        hook = studio.post("/v1/webhooks", url="https://hooks.studio.example/")
        path = f"/v1/webhooks/{hook['id']}"
        changed = studio.http.patch(path, json={"url": "https://other.example/"})
    finally:
        app.dependency_overrides.clear()
    assert (changed.status_code, looked_up) == (200, [])
    studio.post(f"{path}/test")
    with delivering(studio, settings, sender):
        refused = _until(studio, hook, "failed")
        assert refused["error"] == "address.private"
        assert refused["excerpt"].endswith("MYOFACE_WEBHOOK_ALLOW")
    assert set(looked_up) == {"other.example"}


@pytest.mark.parametrize(
    "body",
    [
        {"url": "ftp://a/"},
        {"url": "https://user:secret@a/"},
        {"url": "https://a/", "events": ["job.eaten"]},
        {"url": "https://a/", "kinds": ["no_such_kind"]},
        {"url": "https://a/", "secret": "mine"},
    ],
)
def test_webhooks_that_can_not_be(studio: Studio, body: dict[str, Any]) -> None:
    _refused(studio.http.post("/v1/webhooks", json=body), 422, "request.invalid")


def test_switched_off_by_its_owner_it_is_told_nothing(studio: Studio) -> None:
    with receiving() as (port, _):
        hook = _hook(studio, port)
        path = f"/v1/webhooks/{hook['id']}"
        studio.post(f"{path}/test")
        shown = studio.http.patch(path, json={"active": False}).json()
        assert (shown["active"], shown["disabled_reason"]) == (False, "by_user")
        assert [each["state"] for each in _log(studio, hook)] == ["failed"]
        studio.pretend(studio.submit("build_model", studio.subject()), {})
        assert len(_log(studio, hook)) == 1
        _refused(studio.http.patch(path, json={"url": None}), 422, "request.invalid")
        assert studio.http.delete(path).status_code == 204
        assert studio.http.get(path).status_code == 404


@pytest.mark.slow
def test_a_worker_of_the_stack_delivers_and_takes_its_place_again(tmp_path: Path) -> None:
    more = {"webhook_allow": LOOPBACK, "webhook_workers": 2}
    with receiving() as (port, got), running(tmp_path, **more) as (stack, studio):
        hook = _hook(studio, port, events=["job.succeeded"])
        subject = studio.subject()
        studio.done("build_model", subject)
        eventually(lambda: len(got) == 1)
        assert (
            Verifier(hook["secret"]).verify(got[0][2], got[0][1])["data"]["subject_id"] == subject
        )
        os.kill(stack.pid("webhooks"), signal.SIGKILL)
        studio.done("build_model", subject)
        eventually(lambda: len(got) == 2, seconds=30)


def test_nothing_but_so_many(studio: Studio) -> None:
    with receiving() as (port, _):
        for _ in range(20):
            _hook(studio, port)
        answer = studio.http.post("/v1/webhooks", json={"url": f"http://127.0.0.1:{port}/"})
        _refused(answer, 409, "webhook.too_many")
        answer = studio.http.post("/v1/webhooks", json={"url": "http://10.0.0.1/"})
        _refused(answer, 409, "webhook.too_many")  # first, before the address costs anything
