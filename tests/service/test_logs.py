"""Nothing that a stranger says does more in a log than be read."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path

import pytest
import structlog

from service.process import configure_logs
from service.settings import Settings
from tests.service_client import served


@pytest.fixture(autouse=True)
def own_logs() -> Iterator[None]:
    handlers = logging.getLogger().handlers
    before = structlog.get_config()
    yield
    logging.getLogger().handlers = handlers
    structlog.configure(**before)


@pytest.mark.parametrize("as_json", [False, True])
def test_control_characters_are_escaped(as_json: bool, capsys: pytest.CaptureFixture[str]) -> None:
    configure_logs(as_json)
    log = structlog.get_logger("test")
    log.warning("said", error="\x1b[31mred\x9b\u202e\0 and\nforged")
    try:
        raise ValueError("\x1b]0;title\x07")
    except ValueError:
        log.exception("failed")
    told = capsys.readouterr().err
    assert all(line.isprintable() for line in told.splitlines())
    assert "x1b[31mred" in told
    assert not [line for line in told.splitlines() if line.startswith("forged")]


@pytest.mark.long
def test_paths_are_logged_without_names_and_raw_characters(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    configure_logs(False)
    with served(Settings(data_dir=tmp_path)) as studio:
        subject = studio.subject()
        rig, _ = studio.pretend_rig(studio.submit("build_model", subject), subject)
        capsys.readouterr()
        for path in (
            f"/v1/rigs/{rig.id}/artifacts/fit_BiteLipLeft.png",
            f"/v1/subjects/{subject}",
            "/%1b[31mred",
            "/v1/jobs/%00%0a%e2%80%ae",
            "/" + "x" * 1000,
        ):
            studio.http.get(path)
        studio.http.request("H\x1bCK".replace("\x1b", ""), "/v1/jobs")
    told = capsys.readouterr()
    lines = [line for line in (told.err + told.out).splitlines() if " request " in line]
    assert len(lines) == 6
    assert all(line.isprintable() for line in lines)
    assert not [line for line in lines if "BiteLipLeft" in line or len(line) > 600]
    for known in (
        f"path=/v1/rigs/{rig.id}/artifacts/{{name}}",
        f"path=/v1/subjects/{subject}",
        "path=/%1B%5B31mred",
    ):
        assert [line for line in lines if known in line], (known, lines)
