"""What the command line prints."""

from __future__ import annotations

import uuid

import pytest

from myoface.cli import console
from myoface.cli.console import JobView, show_table
from solver.progress import Step


def test_an_id_stays_whole_beside_a_long_error(capsys: pytest.CaptureFixture[str]) -> None:
    job, error = str(uuid.uuid4()), "[scan] " + "far off the neutral, " * 20
    show_table(("job", "attempt", "error"), [(job, None, error), (job, 2, "")])
    head, *rows = capsys.readouterr().out.splitlines()
    assert rows == [f"{job}           {error.rstrip()}", f"{job}  2"]
    assert head.index("error") == rows[0].index("[scan]")


def test_a_log_has_news_of_a_long_phase_now_and_then(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [100.0]
    monkeypatch.setattr(console.time, "monotonic", lambda: now[0])
    with JobView("simulate") as view:
        view(Step("read", 0.0, message="[model].npz"))
        for number in range(1, 31):
            view(Step("simulate", number / 40, message=f"frame {number} of 30"))
            now[0] += 1.0
        now[0] += 60.0
        view(Step("simulate", 0.75, message="frame 21 of 30"))
        view(Step("export", 0.9))
    assert capsys.readouterr().out.splitlines() == [
        "simulate: read · [model].npz",
        "simulate: simulate · frame 1 of 30",
        "simulate: simulate · frame 11 of 30",
        "simulate: simulate · frame 21 of 30",
        "simulate: export",
    ]
    assert view.phases["simulate"] == 90.0
