"""Every setting is explained where one looks for it."""

from __future__ import annotations

from pathlib import Path

from service.settings import Settings

DOCUMENT = Path(__file__).parents[2] / "docs" / "operate" / "service.md"
OWN = {"stack_pid"}
"""What the launcher tells its children, and nobody else sets."""


def test_every_setting_is_documented() -> None:
    text = DOCUMENT.read_text()
    names = {f"MYOFACE_{name.upper()}" for name in Settings.model_fields if name not in OWN}
    assert {name for name in names if f"`{name}`" not in text} == set()
