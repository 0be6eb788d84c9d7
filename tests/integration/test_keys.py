"""Keys over HTTP: made, rotated, revoked; and what a tenant learns of itself."""

from __future__ import annotations

import time
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest

from service.access import keys
from service.settings import Settings
from service.store.models import now
from tests.service_client import Studio, eventually, served


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[Studio]:
    with served(Settings(data_dir=tmp_path)) as studio:
        yield studio


def _status(studio: Studio, key: str, path: str = "/v1/subjects") -> int:
    headers = {"Authorization": f"Bearer {key}"}
    return studio.http.get(path, headers=headers).status_code


def test_a_key_is_told_once_and_lives_until_it_is_revoked(studio: Studio) -> None:
    made = studio.post("/v1/keys", name="station 2", scopes=["read", "write"])
    assert _status(studio, made["key"]) == 200
    assert _status(studio, made["key"], "/v1/keys") == 403
    eventually(lambda: studio.get("/v1/keys")["items"][0]["last_used_at"] is not None)
    listed = studio.get("/v1/keys")["items"]
    assert [each["name"] for each in listed] == ["station 2", "admin"]
    assert all("key" not in each for each in listed)
    for _ in range(2):
        assert studio.http.delete(f"/v1/keys/{made['id']}").status_code == 204
    assert _status(studio, made["key"]) == 401
    over = studio.http.post(f"/v1/keys/{made['id']}/rotate")
    assert (over.status_code, over.json()["code"]) == (409, "key.over")


def test_a_rotated_key_goes_on_for_a_grace(studio: Studio) -> None:
    until = (now() + timedelta(days=90)).isoformat()
    old = studio.post("/v1/keys", name="renderer", scopes=["read"], expires_at=until)
    kept = studio.post(f"/v1/keys/{old['id']}/rotate")
    assert [_status(studio, each["key"]) for each in (old, kept)] == [200, 200]
    assert (kept["scopes"], kept["expires_at"]) == (["read"], old["expires_at"])
    fresh = studio.post(f"/v1/keys/{kept['id']}/rotate", grace=0)
    assert [_status(studio, each["key"]) for each in (kept, fresh)] == [401, 200]


def test_the_last_admin_key_stays(studio: Studio) -> None:
    mine = studio.get("/v1/me")["key_id"]
    studio.post(
        "/v1/keys",
        name="short",
        scopes=["admin"],
        expires_at=(now() + timedelta(seconds=0.5)).isoformat(),
    )
    other = studio.post("/v1/keys", name="deputy", scopes=["admin", "read"])
    assert studio.http.delete(f"/v1/keys/{mine}").status_code == 204
    deputy = Studio(studio.http, other["key"])
    assert deputy.get("/v1/me") == {
        "tenant": "default",
        "key_id": other["id"],
        "scopes": ["admin", "read"],
    }
    time.sleep(0.6)
    refused = deputy.http.delete(f"/v1/keys/{other['id']}")
    assert (refused.status_code, refused.json()["code"]) == (409, "key.last_admin")


@pytest.mark.parametrize(
    "body",
    [
        {"name": "x", "scopes": []},
        {"name": "x", "scopes": ["root"]},
        {"name": "x", "scopes": ["read"], "expires_at": "2020-01-01T00:00:00Z"},
        {"name": "x", "scopes": ["read"], "expires_at": "2040-01-01T00:00:00"},
    ],
)
def test_keys_that_can_not_be(studio: Studio, body: dict[str, Any]) -> None:
    assert studio.http.post("/v1/keys", json=body).status_code == 422


def test_who_did_what_is_written_down(studio: Studio) -> None:
    key = studio.post("/v1/keys", name="Ada's laptop", scopes=["read"])
    studio.http.delete(f"/v1/keys/{key['id']}", headers={"X-Request-Id": "mine"})
    entries = studio.get(f"/v1/audit?object_id={key['id']}")["items"]
    assert [each["action"] for each in entries] == ["key.revoked", "key.created"]
    assert entries[0]["request_id"] == "mine"
    assert entries[0]["key_id"] == studio.get("/v1/me")["key_id"]
    assert "Ada" not in str(entries)
    first = studio.get("/v1/audit?limit=1")
    assert studio.get(f"/v1/audit?limit=1&cursor={first['next']}")["items"] == entries[1:]


def test_a_key_grants_no_more_than_it_has(studio: Studio) -> None:
    everything = studio.get("/v1/me")["scopes"]
    metrics = studio.post("/v1/keys", name="prometheus", scopes=["metrics"])
    others = [scope for scope in everything if scope != "metrics"]
    tenants = Studio(studio.http, studio.post("/v1/keys", name="studio", scopes=others)["key"])
    assert tenants.http.get("/v1/workers").status_code == 403
    for refused in (
        tenants.http.post("/v1/keys", json={"name": "x", "scopes": ["read", "metrics"]}),
        tenants.http.post(f"/v1/keys/{metrics['id']}/rotate"),
    ):
        assert (refused.status_code, refused.json()["code"]) == (403, "auth.scope")
        assert refused.json()["expected"] == ["metrics"]
    assert tenants.http.post("/v1/keys", json={"name": "x", "scopes": ["read"]}).status_code == 201


def test_a_tenant_has_a_hundred_keys(studio: Studio, monkeypatch: pytest.MonkeyPatch) -> None:
    assert keys.MOST_TENANT_KEYS == 100
    monkeypatch.setattr(keys, "MOST_TENANT_KEYS", 3)
    last = [studio.post("/v1/keys", name="x", scopes=["read"])["id"] for _ in range(2)][1]
    refused = studio.http.post("/v1/keys", json={"name": "x", "scopes": ["read"]})
    assert (refused.status_code, refused.json()["code"]) == (409, "key.too_many")
    refused = studio.http.post(f"/v1/keys/{last}/rotate", json={"grace": 60})
    assert (refused.status_code, refused.json()["code"]) == (409, "key.too_many")
    assert studio.http.delete(f"/v1/keys/{last}").status_code == 204
    studio.post("/v1/keys", name="x", scopes=["read"])


def test_a_tenant_s_keys_share_a_rate(tmp_path: Path) -> None:
    with served(Settings(data_dir=tmp_path, tenant_rate_per_minute=10)) as studio:
        made = [studio.post("/v1/keys", name="x", scopes=["read"])["key"] for _ in range(4)]
        answers = [_status(studio, key) for key in made for _ in range(3)]
        assert 5 <= answers.count(200) <= 7
        refused = studio.http.get("/v1/me")
        assert refused.status_code == 429
        assert refused.json()["detail"] == "the tenant has sent more than 10 requests a minute"
        assert refused.headers["RateLimit-Limit"] == "10"


def test_an_address_guesses_so_many_keys(tmp_path: Path) -> None:
    with served(Settings(data_dir=tmp_path, unknown_keys_per_minute=5)) as studio:
        assert studio.get("/v1/me")
        fresh = studio.post("/v1/keys", name="x", scopes=["read"])["key"]
        guessed = ["myo_" + f"{number}" * 44 for number in range(1, 9)]
        answers = [_status(studio, body + keys._checksum(body)) for body in guessed]
        assert answers.count(401) in (3, 4, 5)
        assert answers[-1] == 429
        assert studio.get("/v1/me")  # the key has worked before
        assert _status(studio, fresh) == 429
        assert _status(studio, "myo_mistyped") == 401  # needs no look into a table
        studio.http.app.state.keyring._lookups._tries._kept.clear()  # type: ignore[attr-defined]
        assert _status(studio, fresh) == 200
        [mine] = [each for each in studio.get("/v1/keys")["items"] if each["name"] == "x"]
        studio.http.delete(f"/v1/keys/{mine['id']}")
        assert [_status(studio, fresh) for _ in range(8)].count(429) >= 3  # it is unknown again


def test_jobs_and_landmarks_are_in_the_audit_log(studio: Studio) -> None:
    subject = studio.subject()
    smile = studio.raw(subject, "smile")
    marks = {"upload_id": studio.upload("smile.json", b"[1]")}
    path = f"/v1/subjects/{subject}/captures/{smile}/landmarks"
    assert studio.http.put(path, json=marks).status_code == 200
    job = studio.submit("check_scan", subject, captures=[smile])
    studio.post(f"/v1/jobs/{job}/cancel")
    again = studio.post(f"/v1/jobs/{job}/retry")["id"]
    for made in (job, again):
        entries = studio.get(f"/v1/audit?object_id={made}")["items"]
        assert entries[-1]["action"] == "job.created"
    entries = studio.get(f"/v1/audit?object_id={smile}")["items"]
    assert entries[0]["action"] == "capture.landmarks"


def test_no_path_leads_away_by_a_slash(studio: Studio) -> None:
    """A redirect would name a host and a scheme, and leave TLS."""
    for path in ("/v1/subjects/", "/v1/keys/", "/healthz/"):
        assert studio.http.get(path, follow_redirects=False).status_code == 404
