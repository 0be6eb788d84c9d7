"""What the example of a capture station takes for a refusal, and what it waits for."""

from __future__ import annotations

import os
import re
import runpy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from myoface.errors import ApiError

EXAMPLE = Path(__file__).parents[2] / "docs/examples/station.py"
CHECKED = SimpleNamespace(check=SimpleNamespace(verdict="good"))


class Service:
    """A client whose scans fail in turn with what is given."""

    def __init__(self, *faults: Exception) -> None:
        self.faults = list(faults)
        self.sent: list[str] = []

    def create_subject(self, _name: str) -> Any:
        return SimpleNamespace(id="1")

    def ensure_capture(self, _subject: str, path: Path, **_: Any) -> Any:
        self.sent.append(path.stem)
        if self.faults:
            raise self.faults.pop(0)
        return CHECKED


def station(folder: Path, service: Service, *names: str) -> Any:
    """Return a station at a folder with scans."""
    for name in names:
        path = folder / "Ada" / name
        path.parent.mkdir(exist_ok=True)
        path.write_text("x")
        os.utime(path, (1000, 1000))
    return runpy.run_path(str(EXAMPLE))["Station"](service, folder)


def test_a_check_is_told_the_unit_and_tells_what_it_did_not_judge(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[dict[str, Any]] = []

    class Checking(Service):
        def ensure_capture(self, *_: Any, **__: Any) -> Any:
            return SimpleNamespace(check=None, id="7")

        def run(self, *_: Any, **given: Any) -> Any:
            asked.append(given["options"])
            unseen = {"about": "eyes", "judged": False, "words": "a vertex every 4 mm"}
            summary = {"verdict": "good", "findings": [], "judged": [unseen]}
            return SimpleNamespace(result=SimpleNamespace(summary=summary))

    here = station(tmp_path, Checking(), "smile.obj")
    here.options = {"unit": 22.9}
    here.look()
    assert asked == [{"unit": 22.9}]
    assert "not judged: eyes: a vertex every 4 mm" in capsys.readouterr().out


def test_the_station_in_powershell_takes_no_path_for_a_wildcard() -> None:
    """``Jörg [1]`` is a folder's name; there is no PowerShell here that could be asked."""
    calls = re.findall(
        r"(?:Test-Path|Get-Content|Set-Content|Get-FileHash|Get-ChildItem) \S+",
        EXAMPLE.with_suffix(".ps1").read_text(encoding="utf-8"),
    )
    assert len(calls) >= 5
    assert [call for call in calls if not call.endswith("-LiteralPath")] == []


def test_the_station_in_powershell_is_done_with_what_is_refused() -> None:
    """For good is what the station in C# takes for it, and all that PowerShell's throws itself."""
    text = EXAMPLE.with_suffix(".ps1").read_text(encoding="utf-8")
    throws = re.findall(r"throw \S*", text)
    assert len(throws) >= 5
    assert {
        each for each in throws if not each.startswith("throw [ApplicationException]::new(")
    } == set()
    statuses = r"404(?:, \d{3})+"
    in_c_sharp = re.search(statuses, EXAMPLE.with_suffix(".cs").read_text(encoding="utf-8"))
    assert in_c_sharp is not None
    assert re.findall(statuses, text) == [in_c_sharp[0]]
    loop = text[text.index("\ndo {") :]
    assert re.search(
        r"catch \{.*Test-Refusal \$_.*\$Done\[\$file\.FullName\] = \$saved", loop, re.DOTALL
    )


def refusal(status: int | None, code: str) -> ApiError:
    return ApiError({"code": code, "detail": "so", **({"status": status} if status else {})})


@pytest.mark.parametrize(
    "error",
    [refusal(each, "x.x") for each in (404, 409, 410, 413, 422)]
    + [refusal(None, "client.name"), refusal(None, "scan.nan"), refusal(None, "job.canceled")],
    ids=str,
)
def test_a_refused_file_is_done(
    error: ApiError, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    service = Service(error)
    here = station(tmp_path, service, "smile.obj")
    here.look()
    here.look()
    assert service.sent == ["smile"]
    assert "Ada/smile: refused" in capsys.readouterr().out


@pytest.mark.parametrize(
    "error",
    [refusal(each, "http.x") for each in (308, 401, 403, 407, 429, 500, 502, 503)]
    + [refusal(None, "client.unreachable"), refusal(None, "client.proxy")],
    ids=str,
)
def test_what_passes_is_waited_for(error: ApiError, tmp_path: Path) -> None:
    service = Service(error)
    here = station(tmp_path, service, "smile.obj")
    with pytest.raises(ApiError):
        here.look()
    here.look()
    assert service.sent == ["smile", "smile"]


@pytest.mark.parametrize(
    "error", [PermissionError(13, "in use"), refusal(409, "subject.busy")], ids=str
)
def test_a_file_that_cannot_be_had_keeps_no_other_back(
    error: Exception, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    service = Service(error, error)
    here = station(tmp_path, service, "frown.obj", "smile.obj")
    here.look()
    here.look()
    assert service.sent == ["frown", "smile", "frown", "smile"]
    assert capsys.readouterr().out.count("waiting: ") == 2
