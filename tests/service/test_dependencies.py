"""The parts that routes ask for by name."""

from __future__ import annotations

from pathlib import Path

import pytest

from service import dependencies
from service.app import create_app
from service.settings import Settings


def test_a_part_that_the_application_lacks_is_told_at_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dependencies, "_asked_for", set(dependencies._asked_for))
    dependencies.part("no_such_part")
    with pytest.raises(LookupError, match="no_such_part"):
        create_app(Settings(data_dir=tmp_path))
