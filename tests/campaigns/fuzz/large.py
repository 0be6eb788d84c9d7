"""Large hostile inputs: spoilt ones of which a part is repeated until they have megabytes."""

from __future__ import annotations

import random
from collections.abc import Iterator

LARGEST = 8 << 20
FILLERS = [b" ", b"0", b"9", b"\n", b"\0", b"a", b"[", b"(", b'"', b"/", b"-", b"\\\n", b"1 ", b","]


def large_inputs(seeds: list[bytes], count: int, seed: int) -> Iterator[bytes]:
    """Give ``count`` inputs of one to eight megabytes, the last of them of all eight."""
    chance = random.Random(seed)
    for number in range(count):
        content = chance.choice(seeds)
        for _ in range(chance.randint(0, 3)):
            content = _spoil(content, chance)
        size = LARGEST if number == count - 1 else chance.randint(1 << 20, LARGEST)
        yield _swell(content, size, chance)


def _spoil(content: bytes, chance: random.Random) -> bytes:
    place = chance.randint(0, len(content))
    noise = chance.randbytes(chance.randint(1, 8))
    return content[:place] + noise + content[place + chance.choice([0, len(noise)]) :]


def _swell(content: bytes, size: int, chance: random.Random) -> bytes:
    """Repeat a line, a span, or what comes from nowhere, until there are ``size`` bytes."""
    lines = content.splitlines(keepends=True) or [b"\n"]
    line = chance.randrange(len(lines))
    start = chance.randint(0, len(content))
    end = min(len(content), start + chance.choice([1, 4, 16, 64, 512]))
    before, part, after = chance.choice(
        [
            (b"".join(lines[: line + 1]), lines[line], b"".join(lines[line + 1 :])),
            (content[:end], content[start:end] or b"\n", content[end:]),
            (content[:start], chance.choice(FILLERS), content[start:]),
            (content, content or b"\n", b""),
        ]
    )
    times = max(size - len(before) - len(after), 0) // len(part) + 1
    return (before + part * times + after)[:size]
