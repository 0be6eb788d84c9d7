"""The client whose calls block is made from the one whose calls are awaited, and has all of it."""

from __future__ import annotations

import inspect
import subprocess
import sys
from pathlib import Path

import pytest

from myoface.client import AsyncClient, Client
from myoface.client.credentials import key_for
from service.settings import Settings

ROOT = Path(__file__).parents[2]


def test_the_generated_files_are_up_to_date() -> None:
    command = [sys.executable, "scripts/unasync.py", "--check"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_both_clients_have_the_same_calls() -> None:
    def calls(client: type) -> dict[str, list[str]]:
        return {
            name: list(inspect.signature(function).parameters)
            for name, function in inspect.getmembers(client, inspect.isfunction)
            if not name.startswith("_")
        }

    assert calls(Client) == calls(AsyncClient)
    assert len(calls(Client)) > 40


def test_the_key_is_looked_for_where_the_service_leaves_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("MYOFACE_API_KEY", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    for folder in ("", str(tmp_path / "data")):
        if folder:
            monkeypatch.setenv("MYOFACE_DATA_DIR", folder)
        else:
            monkeypatch.delenv("MYOFACE_DATA_DIR", raising=False)
        path = Settings().admin_key if folder else Path.home() / ".local/share/myoface/admin.key"
        path.parent.mkdir(parents=True)
        path.write_text("myo_key")
        assert key_for("http://127.0.0.1:8765") == "myo_key"
        assert key_for("https://studio.example") is None
        path.unlink()
