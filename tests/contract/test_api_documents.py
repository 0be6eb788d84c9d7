"""What docs/reference/api.md says of the operations and their scopes is what the service has."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from service.access.principal import Scope
from service.app import create_app
from service.settings import Settings
from service.store.models import DEFAULT_TENANT

DOCUMENT = Path(__file__).parents[2] / "docs" / "reference" / "api.md"
ROW = re.compile(r"^\| (`(?:GET|POST|PUT|HEAD|PATCH|DELETE).*?) \| (\w+) \|", re.MULTILINE)
METHODS = ("GET", "POST", "PUT", "HEAD", "PATCH", "DELETE")


def documented() -> dict[tuple[str, str], str]:
    """Return the scope of each operation that the table has."""
    found = {}
    for cell, scope in ROW.findall(DOCUMENT.read_text()):
        methods: list[str] = []
        for code in re.findall(r"`([^`]+)`", cell):
            word, _, path = code.partition(" ")
            methods.append(word)
            if path:
                found |= {(method, path.partition("?")[0]): scope for method in methods}
                methods = []
    return found


def test_every_operation_is_documented_with_its_scope(tmp_path: Path) -> None:
    app = create_app(Settings(data_dir=tmp_path))
    with TestClient(app, base_url="http://127.0.0.1") as http:
        with app.state.store.write() as session:
            _, text = app.state.keyring.mint(session, DEFAULT_TENANT, "powerless", [])
        needed: dict[tuple[str, str], str] = {}
        for path, operations in app.openapi()["paths"].items():
            for method in map(str.upper, operations):
                if method not in METHODS:
                    continue
                asked = re.sub(r"\{\w+\}", "8c1d3a52-0f4e-4c5b-9b39-1f3a4f1f6c11", path)
                headers = {"Authorization": f"Bearer {text}"}
                answer = http.request(method, asked, headers=headers)
                is_open = "security" not in operations[method.lower()]
                if method == "HEAD":
                    continue  # it has no body that says which scope it lacks
                needed[method, path] = "none" if is_open else answer.json()["expected"]
    known = {key: scope for key, scope in documented().items() if key[0] != "HEAD"}
    assert known == needed


@pytest.mark.parametrize("scope", Scope)
def test_every_scope_is_explained(scope: Scope) -> None:
    assert f"| `{scope}` |" in DOCUMENT.read_text()
