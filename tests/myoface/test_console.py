"""What the command line prints."""

from __future__ import annotations

import io
import uuid

import pytest

from myoface.cli import console
from myoface.cli.console import (
    JobDisplay,
    Painted,
    complain,
    show_outcome,
    show_registration,
    show_table,
    show_verdict,
    transfer_bar,
)
from solver.progress import Step
from solver.registration.units import ADVICE


def test_an_id_stays_whole_beside_a_long_error(capsys: pytest.CaptureFixture[str]) -> None:
    job = str(uuid.uuid4())
    error = "[scan] " + "far off the neutral, " * 20
    show_table(("job", "attempt", "error"), [(job, None, error), (job, 2, "")])
    head, *rows = capsys.readouterr().out.splitlines()
    assert rows == [f"{job}           {error.rstrip()}", f"{job}  2"]
    assert head.index("error") == rows[0].index("[scan]")


def test_a_log_has_news_of_a_long_phase_now_and_then(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [100.0]
    monkeypatch.setattr(console.time, "monotonic", lambda: now[0])
    with JobDisplay("simulate") as view:
        view(Step("read", 0.0, message="[model].npz"))
        for number in range(1, 31):
            view(Step("simulate", number / 40, message=f"frame {number} of 30"))
            now[0] += 1.0
        now[0] += 60.0
        view(Step("simulate", 0.75, message="frame 21 of 30"))
        view(Step("export", 0.9))
    assert capsys.readouterr().out.splitlines() == [
        "simulate: read · [model].npz",
        "simulate: simulate · frame 1 of 30 · 2%",
        "simulate: simulate · frame 11 of 30 · 28%, about 26 s left",
        "simulate: simulate · frame 21 of 30 · 52%, about 18 s left",
        "simulate: export · 90%, about 10 s left",
    ]
    assert view.phases["simulate"] == 90.0


HOSTILE = "smile\x1b]0;owned\x07\x1b[8m\x9b31m\u202e\u2066\r\ud800"


def test_a_stranger_s_text_does_nothing_to_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    finding = {"message": HOSTILE, "advice": HOSTILE}
    complain(HOSTILE)
    show_table(("name",), [(HOSTILE,)])
    show_verdict(HOSTILE, {"verdict": "bad", "findings": [finding]})
    show_registration(HOSTILE, {"coverage": 1.0, "mean_mm": None, "findings": [finding]})
    with JobDisplay(HOSTILE) as view:
        view(Step(HOSTILE, 0.0, message=HOSTILE))
    with transfer_bar(HOSTILE) as progress:
        progress(1, 2)
    told = capsys.readouterr()
    lines = (told.out + told.err).splitlines()
    assert len(lines) > 8
    assert [line for line in lines if not line.isprintable()] == []
    assert r"smile\x1b]0;owned\x07\x1b[8m\x9b31m\u202e\u2066" in told.err


def test_a_fit_of_a_bad_take_ends_as_its_check_does(capsys: pytest.CaptureFixture[str]) -> None:
    notice = {"message": "another person's"}
    finding = {"message": "half was rejected"}
    report = {"verdict": "bad", "notices": [notice], "findings": [finding]}
    assert show_outcome("fit_markers", report, "take.c3d") == console.BAD
    told = capsys.readouterr().out
    assert told.startswith("take.c3d: bad")
    assert "another person's" in told
    assert "half was rejected" in told
    assert show_outcome("fit_markers", {**report, "verdict": "usable"}) == 0
    assert show_outcome("fit_markers", {"frames": 3}) == 0  # of a release without verdicts


def test_colours_are_still_the_command_line_s_own(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = io.StringIO()
    monkeypatch.setattr(terminal, "isatty", lambda: True)
    monkeypatch.setattr("sys.stdout", terminal)
    monkeypatch.delenv("NO_COLOR", raising=False)
    console.out.print(Painted("bad", "red"), " \x1b[8m")
    assert terminal.getvalue() == "\x1b[31mbad\x1b[0m \\x1b[8m\n"


def test_a_bar_is_written_over_and_goes(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = io.StringIO()
    monkeypatch.setattr(terminal, "isatty", lambda: True)
    monkeypatch.setattr("sys.stdout", terminal)
    with transfer_bar("scan.obj") as progress:
        progress(1_000_000, 4_000_000)
        console.out.print("between")
        progress(4_000_000, 4_000_000)
    *_, last = terminal.getvalue().split("\r")
    assert last == ""
    assert "4.0/4.0 MB" in terminal.getvalue()
    assert "\rbetween\n" in terminal.getvalue()


def test_text_of_other_languages_stays_as_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    console.out.print("Zoë 微笑 🙂\nund mehr")
    assert capsys.readouterr().out == "Zoë 微笑 🙂\nund mehr\n"


def test_advice_names_the_options_that_are_typed(capsys: pytest.CaptureFixture[str]) -> None:
    finding = {"message": "size unknown", "advice": ADVICE["scan.unit_unknown"]}
    show_verdict("scan", {"verdict": "usable", "findings": [finding]})
    told = capsys.readouterr().out
    assert "--eye-distance" in told
    assert "eye_distance_mm" not in told
