"""What the command line prints."""

from __future__ import annotations

import uuid

import pytest

from myoface.cli.console import show_table


def test_an_id_stays_whole_beside_a_long_error(capsys: pytest.CaptureFixture[str]) -> None:
    job, error = str(uuid.uuid4()), "[scan] " + "far off the neutral, " * 20
    show_table(("job", "attempt", "error"), [(job, None, error), (job, 2, "")])
    head, *rows = capsys.readouterr().out.splitlines()
    assert rows == [f"{job}           {error.rstrip()}", f"{job}  2"]
    assert head.index("error") == rows[0].index("[scan]")
