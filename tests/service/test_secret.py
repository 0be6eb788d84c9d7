"""The service's secret: made once by the API, never by somebody who only signs with it."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from service.secret import secret, wait_for_secret
from service.settings import Settings


def test_who_only_signs_waits_for_the_apis_secret(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    with pytest.raises(TimeoutError, match="MYOFACE_SECRET_KEY"):
        wait_for_secret(settings, 0.2)
    assert not (tmp_path / "secret").exists()
    api = threading.Timer(0.2, secret, [settings])
    api.start()
    assert wait_for_secret(settings, 10) == secret(settings)
    api.join()


def test_a_configured_secret_needs_no_file(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path, secret_key="s" * 32)
    assert wait_for_secret(settings, 0) == b"s" * 32
    assert not (tmp_path / "secret").exists()


def test_secrets_come_from_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = {
        "secret_key": "s" * 32,
        "database_url": "postgresql://u:p@h/n",
        "broker_url": "redis://",
    }
    for name, value in kept.items():
        (tmp_path / name).write_text(f"{value}\n")
        monkeypatch.setenv(f"MYOFACE_{name.upper()}_FILE", str(tmp_path / name))
    settings = Settings(data_dir=tmp_path)
    assert secret(settings) == b"s" * 32
    assert settings.database == "postgresql+psycopg://u:p@h/n"
    assert settings.broker == "redis://"
    monkeypatch.setenv("MYOFACE_BROKER_URL", "redis://here")  # says so itself: that counts
    assert Settings(data_dir=tmp_path).broker == "redis://here"
