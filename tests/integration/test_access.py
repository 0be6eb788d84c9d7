"""Who comes in: keys, their scopes, and doors that stay shut."""

from __future__ import annotations

import os
import subprocess
import sys
from datetime import timedelta
from pathlib import Path

import httpx
import pytest
from sqlalchemy import update

from service.access import bootstrap
from service.access.keys import Keyring
from service.access.principal import Scope
from service.secret import secret
from service.settings import Settings
from service.store.database import Store
from service.store.models import DEFAULT_TENANT, ApiKey, now
from tests.service_client import Studio, eventually, served

OPEN = {"/healthz", "/readyz"}
NOBODY = "8c1d3a52-0f4e-4c5b-9b39-1f3a4f1f6c11"


def _keyring(studio: Studio) -> tuple[Store, Keyring]:
    state = studio.http.app.state  # type: ignore[attr-defined]
    return state.store, state.keyring


def _mint(studio: Studio, *scopes: Scope, **more: object) -> tuple[str, str]:
    store, keyring = _keyring(studio)
    with store.write() as session:
        key, text = keyring.mint(session, DEFAULT_TENANT, "test", scopes, **more)
    return key.id, text


def _ask(studio: Studio, key: str | None, path: str, method: str = "GET") -> httpx.Response:
    headers = {"Authorization": f"Bearer {key}" if key else ""}
    return studio.http.request(method, path, headers=headers)


def test_every_operation_needs_a_key_of_its_scope(tmp_path: Path) -> None:
    with served(Settings(data_dir=tmp_path)) as studio:
        paths = studio.get("/openapi.json")["paths"]
        _, powerless = _mint(studio)
        for path, operations in paths.items():
            for method, operation in operations.items():
                asked = path.format(**dict.fromkeys(_parameters(path), NOBODY))
                if path in OPEN:
                    assert "security" not in operation
                    continue
                nobody = _ask(studio, None, asked, method.upper())
                assert nobody.status_code == 401, (method, path)
                assert nobody.headers["WWW-Authenticate"] == "Bearer"
                answer = _ask(studio, powerless, asked, method.upper())
                assert answer.status_code == 403, (method, path)
                assert {"401", "403"} <= set(operation["responses"]), (method, path)
        _, reader = _mint(studio, Scope.READ)
        assert _ask(studio, reader, "/v1/subjects").status_code == 200
        refused = _ask(studio, reader, f"/v1/subjects/{NOBODY}", "DELETE")
        assert (refused.status_code, refused.json()["expected"]) == (403, "delete")


def _parameters(path: str) -> list[str]:
    return [part[1:-1] for part in path.split("/") if part.startswith("{")]


def test_keys_that_open_nothing(tmp_path: Path) -> None:
    with served(Settings(data_dir=tmp_path)) as studio:
        store, keyring = _keyring(studio)
        _, text = _mint(studio, Scope.READ)
        _, expired = _mint(studio, Scope.READ, expires_at=now() - timedelta(seconds=1))
        revoked_id, revoked = _mint(studio, Scope.READ)
        assert _ask(studio, revoked, "/v1/subjects").status_code == 200
        with store.write() as session:
            session.execute(update(ApiKey).where(ApiKey.id == revoked_id).values(revoked_at=now()))
        _ = keyring
        unknown = Keyring(store, b"another service's secret")
        with store.write() as session:
            _, foreign = unknown.mint(session, DEFAULT_TENANT, "x", [Scope.READ])
        mistyped = text[:-8] + ("A" if text[-8] != "A" else "B") + text[-7:]
        for key, code in (
            (mistyped, "auth.invalid"),
            ("myo_short", "auth.invalid"),
            (foreign, "auth.invalid"),
            (expired, "auth.expired"),
            (revoked, "auth.expired"),
        ):
            answer = _ask(studio, key, "/v1/subjects")
            assert (answer.status_code, answer.json()["code"]) == (401, code)
            assert key not in answer.text

        def used() -> bool:
            with store.read() as session:
                return session.get_one(ApiKey, revoked_id).last_used_at is not None

        eventually(used)
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert not [path for path in files if text.encode() in path.read_bytes()]


def test_the_first_start_makes_one_key_that_only_its_owner_reads(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    with served(settings) as studio:
        first = studio.key
    with served(settings) as studio:
        assert studio.key == first
        assert studio.get("/v1/subjects")["items"] == []
    for path in (settings.admin_key, settings.data_dir / "secret"):
        assert path.stat().st_mode & 0o777 == 0o600
    assert secret(settings) == secret(settings)


def test_it_does_not_listen_to_others_without_a_key_and_names(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "service"],
        env=os.environ | {"MYOFACE_DATA_DIR": str(tmp_path), "MYOFACE_HOST": "0.0.0.0"},
        stderr=subprocess.PIPE,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 1
    assert "MYOFACE_ALLOWED_HOSTS" in done.stderr
    settings = Settings(data_dir=tmp_path)
    store = Store(settings.database, settings.files, settings.broker)
    keyring = Keyring(store, secret(settings))
    named = Settings(data_dir=tmp_path, host="0.0.0.0", allowed_hosts=["faces.example"])
    with pytest.raises(bootstrap.OpenDoorError, match="make a key first"):
        bootstrap.prepare(store, keyring, named)
    bootstrap.admin_key(store, keyring, settings, only_first=False)
    beyond = settings.model_copy(update={"host": "0.0.0.0"})
    with pytest.raises(bootstrap.OpenDoorError, match="ALLOWED_HOSTS"):
        bootstrap.prepare(store, keyring, beyond)
    bootstrap.prepare(store, keyring, named)
    store.close()
