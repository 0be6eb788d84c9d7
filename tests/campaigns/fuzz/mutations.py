"""Hypothesis strategies that make hostile inputs out of valid ones."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable

from hypothesis import strategies as st

Draw = Callable[[st.SearchStrategy], int]
LARGEST = 1 << 16
NUMBER = re.compile(rb"-?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
NUMBERS = (
    [b"nan", b"inf", b"-inf", b"1e999", b"-1", b"0", b"-0", b"00", b"1e-400", b"0x10", b"1_0", b""]
    + [b"%d" % (2**bits + more) for bits in (7, 8, 15, 16, 31, 32, 53, 63, 64) for more in (-1, 0)]
    + [b"9" * 400, b"9" * 5000, "\u0663".encode(), b"1,5", b".", b"+-1"]
)
INTEGERS = [0, 1, 2, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF]
WORDS = (
    [struct.pack(f"{order}I", number) for order in "<>" for number in INTEGERS]
    + [struct.pack("<f", number) for number in (float("nan"), float("inf"), -1e38, 1e-45)]
    + [struct.pack("<Q", 2**64 - 1), b"\0", b"\xff", b"\n", b"\r", b"\\\n", b'"', b"\xed\xa0\x80"]
)


@st.composite
def mutated(draw: st.DrawFn, seeds: list[bytes]) -> bytes:
    """Draw a seed that was spoilt in one to five ways, at most 64 KB long."""
    content = draw(st.sampled_from(seeds))
    for _ in range(draw(st.integers(1, 5))):
        spoil = draw(st.sampled_from(WAYS))
        content = spoil(draw, content, seeds)[:LARGEST]
    return content


def _place(draw: st.DrawFn, content: bytes) -> int:
    return draw(st.integers(0, len(content)))


def _span(draw: st.DrawFn, content: bytes) -> tuple[int, int]:
    start = _place(draw, content)
    return start, min(len(content), start + draw(st.sampled_from([1, 2, 4, 16, 64, 512])))


def _replace_number(draw: st.DrawFn, content: bytes, _: list[bytes]) -> bytes:
    found = [match.span() for match in NUMBER.finditer(content[:4096])]
    if not found:
        return content
    start, end = draw(st.sampled_from(found))
    return content[:start] + draw(st.sampled_from(NUMBERS)) + content[end:]


def _overwrite(draw: st.DrawFn, content: bytes, _: list[bytes]) -> bytes:
    place = _place(draw, content)
    word = draw(st.sampled_from(WORDS))
    return content[:place] + word + content[place + len(word) :]


def _insert(draw: st.DrawFn, content: bytes, _: list[bytes]) -> bytes:
    place = _place(draw, content)
    return content[:place] + draw(st.binary(max_size=16)) + content[place:]


def _flip(draw: st.DrawFn, content: bytes, _: list[bytes]) -> bytes:
    if not content:
        return content
    place = draw(st.integers(0, len(content) - 1))
    changed = content[place] ^ (1 << draw(st.integers(0, 7)))
    return content[:place] + bytes([changed]) + content[place + 1 :]


def _cut(draw: st.DrawFn, content: bytes, _: list[bytes]) -> bytes:
    start, end = _span(draw, content)
    return content[:start] + content[end:]


def _repeat(draw: st.DrawFn, content: bytes, _: list[bytes]) -> bytes:
    start, end = _span(draw, content)
    return content[:end] + content[start:end] * draw(st.sampled_from([1, 3, 300])) + content[end:]


def _truncate(draw: st.DrawFn, content: bytes, _: list[bytes]) -> bytes:
    return content[: _place(draw, content)]


def _splice(draw: st.DrawFn, content: bytes, seeds: list[bytes]) -> bytes:
    other = draw(st.sampled_from(seeds))
    return content[: _place(draw, content)] + other[_place(draw, other) :]


WAYS = [
    _replace_number,
    _replace_number,
    _overwrite,
    _overwrite,
    _insert,
    _flip,
    _cut,
    _repeat,
    _truncate,
    _splice,
]
