"""Texts that the service takes from strangers."""

from __future__ import annotations

import pytest
from pydantic import TypeAdapter, ValidationError

from service.schemas import Line

LINE: TypeAdapter[str] = TypeAdapter(Line)


@pytest.mark.parametrize(
    "character",
    [
        *map(chr, (*range(0x01, 0x20), *range(0x7F, 0xA0))),
        *"\u061c\u200e\u200f\u2028\u202e\u2066\u2069",
    ],
    ids=lambda character: f"U+{ord(character):04X}",
)
def test_a_name_has_no_character_that_acts_on_a_terminal(character: str) -> None:
    with pytest.raises(ValidationError, match="pattern"):
        LINE.validate_python(f"A{character}da")


@pytest.mark.parametrize("name", ["Ada", "Zoë", "微笑", "عليّ", "नमस्ते", "🙂", "می\u200cخواهم"])
def test_a_name_may_be_of_any_language(name: str) -> None:
    assert LINE.validate_python(name) == name
