"""The calls of docs/reference/api-by-task.md, in its order, against a running service."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from myoface.client.credentials import KEY_VARIABLE
from myoface.errors import ApiError
from tests.service_client import running

DOCUMENT = Path(__file__).parents[2] / "docs" / "reference" / "api-by-task.md"
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
KEY_OF_THE_SHELL = '$(cat "${MYOFACE_DATA_DIR:-$HOME/.local/share/myoface}/admin.key")'
TRAP = "set -Eo pipefail; trap 'echo \"FAILED in line $LINENO: $BASH_COMMAND\" >&2' ERR\n"

pytestmark = pytest.mark.slow


def _blocks(language: str) -> list[str]:
    return [code for kind, code in BLOCK.findall(DOCUMENT.read_text()) if kind == language]


@pytest.fixture
def service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    session = tmp_path / "session"
    session.mkdir()
    (tmp_path / "take.trc").write_text("# take\n")
    (tmp_path / "clip.mp4").write_text("#! frames 2\n")
    scans = (tmp_path / "neutral.obj", tmp_path / "smile.obj", session / "frown.obj")
    for path in (*scans, tmp_path / "front.jpg"):
        path.write_text(f"# {path.stem}\n")
    with running(tmp_path / "data") as (stack, _):
        monkeypatch.setenv(KEY_VARIABLE, stack.key)
        monkeypatch.setenv("MYOFACE_CACHE", str(tmp_path / "cache"))
        monkeypatch.chdir(tmp_path)
        yield stack.url


def test_the_shell_s_calls_go_through(service: str) -> None:
    if not all(map(shutil.which, ("curl", "jq"))):
        pytest.skip("curl and jq are not both here")
    code = "".join(_blocks("sh")).replace("http://127.0.0.1:8765", service)
    code = code.replace(KEY_OF_THE_SHELL, f"${KEY_VARIABLE}")
    # a job that is stopped may be over already
    code = re.sub(r"(?m)^(api .*/cancel .*)$", r"\1 || true", code)
    done = subprocess.run(
        ["bash", "-c", TRAP + code],
        capture_output=True,
        text=True,
        timeout=180,
        env=os.environ,
        check=False,
    )
    assert "FAILED" not in done.stderr, done.stderr + done.stdout
    assert Path("rig.glb").stat().st_size > 0
    assert '"object_id"' in done.stdout


def test_python_s_calls_go_through(service: str) -> None:
    names: dict[str, Any] = {}
    for code in _blocks("python"):
        code = code.replace("http://127.0.0.1:8765", service)
        try:
            exec(compile(code, str(DOCUMENT), "exec"), names)
        except ApiError as error:
            if error.code != "job.finished":  # a job that is stopped may be over already
                raise
    assert names["client"].deletion(names["receipt"]).object_id == names["subject"].id
    assert list(Path("rig").iterdir())
