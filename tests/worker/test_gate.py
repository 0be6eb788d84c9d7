"""What leaves the solver is short and plain; what one that was taken over leaves is refused."""

from __future__ import annotations

import json
import os
import resource
from pathlib import Path
from typing import Any

import pytest

from service.bounds import ERROR, MARK, SUMMARY, DocumentBounds, fit, fit_progress, shorten
from service.queue.table import Claim
from solver.errors import InputError
from solver.progress import Step, silent
from worker import solve
from worker.attempt import AttemptFolder
from worker.errors import InvalidOutputError
from worker.process import LONGEST_LINE, MOST_LINES, _Lines, _step

HOSTILE = "\x1b]0;owned\x07\x1b[8m\u202e\u009b"


def _claim() -> Claim:
    return Claim("job", "tenant", 1, "check_scan", "subject", [], {}, None, None, {}, {})


@pytest.fixture
def folder(tmp_path: Path) -> AttemptFolder:
    folder = AttemptFolder(tmp_path, _claim())
    folder.path.mkdir()
    return folder


def test_an_error_quotes_little(folder: AttemptFolder) -> None:
    path = folder.path / "inputs" / "0" / "a.obj"
    error = InputError(
        "template.format",
        f"{path}: the format is {'x' * 300_000}",
        file=str(path),
        found=[HOSTILE] * 10_000,
        deep=[[["y" * 1000] * 100] * 100],
    )
    solve._write(folder.path, solve.FAILURE, solve._describe_error(error, 0))
    assert (folder.path / "error.json").stat().st_size <= ERROR.size
    told = folder.error()
    assert told is not None
    assert (told["code"], told["file"], told[MARK]) == ("template.format", "a.obj", True)
    assert told["message"].startswith("a.obj: the format is xxx")
    assert len(told["message"]) == ERROR.text
    assert len(told["found"]) == ERROR.items
    assert all(each.isprintable() for each in told["found"])


def test_a_rig_without_fitted_muscles_has_the_expressions_that_it_shows(tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    fits: dict[str, Any] = {"smile": {"T": {}}, "kiss": {"B": {}}}
    for expressions, told in (({}, ["smile"]), ({"ah": {}}, ["ah"])):
        report.write_text(json.dumps({"system": "T", "systems": fits, "expressions": expressions}))
        assert solve._describe(report, is_rig=True)["expressions"] == told


def test_a_result_quotes_little_and_keeps_its_figures(folder: AttemptFolder) -> None:
    findings = [{"code": "scan.parts", "message": f"part {HOSTILE}" + "x" * 10_000}] * 3
    summary = {"verdict": "good", "findings": findings, "figures": {"mm": float("nan")}}
    formats = {"markers.json": 2, "rig.npz": "x" * 5000, "model.npz": 1e9, HOSTILE: 3}
    content = {"summary": summary, "expressions": ["smile"], "formats": formats}
    solve._write(folder.path, solve.RESULT, content)
    told = folder.result()
    assert told is not None
    assert told["expressions"] == ["smile"]
    assert told["formats"] == {"markers.json": 2}
    assert told["summary"]["verdict"] == "good"
    assert told["summary"]["figures"] == {"mm": None}
    for finding in told["summary"]["findings"]:
        assert len(finding["message"]) <= SUMMARY.text
        assert finding["message"].isprintable()
    large = {"verdict": "good", "values": {str(i): "z" * 490 for i in range(1900)}}
    many = {"verdict": "good", **{str(i): large["values"] for i in range(30)}}
    solve._write(folder.path, solve.RESULT, {"summary": many, "expressions": [], "formats": {}})
    assert (folder.path / "result.json").stat().st_size <= 1.1 * SUMMARY.size
    told = folder.result()
    assert told is not None
    assert (told["summary"]["verdict"], told["summary"][MARK]) == ("good", True)


def test_what_later_jobs_read_tells_its_format(
    folder: AttemptFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run_job(_kind: str, out: Path, **_order: Any) -> None:
        out.mkdir(exist_ok=True)
        (out / "markers.json").write_text('{"format": 1}')
        (out / "check.json").write_text('{"verdict": "good"}')

    monkeypatch.setattr(solve, "run_job", run_job)
    job = {"kind": "check_markers", "inputs": [], "options": {}, "resume": False}
    (folder.path / "job.json").write_text(json.dumps(job))
    told = solve.solve(folder.path, silent)
    solve._write(folder.path, solve.RESULT, told)
    assert folder.result() == {
        "summary": {"verdict": "good"},
        "expressions": [],
        "formats": {"markers.json": 1},
    }


@pytest.mark.parametrize(
    "content",
    [b'{"code": "' + b"x" * 5_000_000 + b'"}', b"{", b"[]", b"{}", b"[" * 60_000, b'{"code": 1}'],
)
def test_a_verdict_of_nobody_s_is_refused(folder: AttemptFolder, content: bytes) -> None:
    (folder.path / "error.json").write_bytes(content)
    with pytest.raises(InvalidOutputError):
        folder.error()
    (folder.path / "result.json").write_bytes(content)
    with pytest.raises(InvalidOutputError):
        folder.result()


def test_progress_is_short(capsys: pytest.CaptureFixture[str]) -> None:
    lines: list[str] = []
    step = Step("geometry", 0.5, 3, 0.1, message=HOSTILE + "x" * 100_000)
    solve.to_pipe(lines.append)(step)
    assert len(lines[0]) < LONGEST_LINE
    told = _step(lines[0])
    assert told is not None
    assert told["message"].isprintable()
    hostile = {"x": [1] * 900, "phase": "\x1b" + "p" * 900, "fraction": 10**300}
    told = _step(json.dumps(hostile))
    assert told == fit_progress(told)
    assert told["fraction"] == 1.0
    for line in ("", "{", "[]", "1", '{"phase": 1}', '{"phase": "a"}', "[" * 3000):
        assert _step(line) is None


def test_a_line_without_an_end_takes_no_room() -> None:
    reading, writing = os.pipe()
    lines = _Lines(os.fdopen(reading, "rb"))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with os.fdopen(writing, "wb") as pipe:
        for _ in range(200):
            pipe.write(b"x" * 1_000_000)
        pipe.write(b"\nend\n")
        pipe.write(b"again\n" * (MOST_LINES + 100))
    lines.join()
    taken, left_out = lines.take()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # kB
    assert (len(taken), left_out) == (MOST_LINES, 102)
    assert (len(taken[0]), taken[1]) == (LONGEST_LINE, "end")


def test_bounds_hold_whatever_comes() -> None:
    bounds = DocumentBounds(text=20, items=3, size=200)
    cases: list[dict[str, Any]] = [
        {"a": "x" * 100},
        {"a": ["\u2028" * 100] * 100},
        {str(i): "x" * 20 for i in range(100)},
        {"a": {"b": {"c": ["d"] * 9}}},
        {HOSTILE: HOSTILE},
    ]
    deep: Any = "x"
    for _ in range(900):
        deep = [deep]
    for case in [*cases, {"deep": deep}]:
        told = fit(case, bounds)
        assert len(json.dumps(told)) <= 200
        assert (MARK in told) == (case is not cases[-1])
    plain = {"a": [1, 2.5, None, True][:3], "b": "Zoë 😀"}
    assert fit(plain, bounds) == plain
    assert shorten("a\tb\x1b[1m") == "a\\tb\\x1b[1m"
