"""The table of faults, read from ``faults.toml``."""

from __future__ import annotations

import shlex
import tomllib
from dataclasses import dataclass
from pathlib import Path

TABLE = Path(__file__).with_name("faults.toml")


@dataclass(frozen=True)
class Selection:
    """Part of a suite: the tests in some ``places`` (all by default) that ``keywords`` name."""

    text: str
    suite: str
    places: tuple[str, ...]
    keywords: str

    @classmethod
    def parse(cls, text: str) -> Selection:
        """Read ``suite: place ... -k 'expression'``."""
        suite, _, rest = text.partition(":")
        words = shlex.split(rest)
        keywords = ""
        if "-k" in words:
            at = words.index("-k")
            words, keywords = words[:at], words[at + 1]
        return cls(text, suite.strip(), tuple(words), keywords)


@dataclass(frozen=True)
class Fault:
    """One fault: pairs of (what stands there, what is planted), of which one has to fit.

    ``twins`` says that it may stand in a file and in the one that is generated from it.
    """

    name: str
    room: str
    wrong: str
    changes: tuple[tuple[str, str], ...]
    selections: tuple[Selection, ...]
    twins: bool = False


def load(only: list[str]) -> list[Fault]:
    """Return the faults, or ``only`` those whose names contain one of the words given."""
    rows = tomllib.loads(TABLE.read_text())["fault"]
    faults = [
        Fault(
            row["name"],
            row["room"],
            row["wrong"],
            tuple((old, new) for old, new in row["change"]),
            tuple(map(Selection.parse, row["suites"])),
            row.get("twins", False),
        )
        for row in rows
    ]
    names = [fault.name for fault in faults]
    if len(set(names)) < len(names):
        raise ValueError("two faults have one name")
    return [fault for fault in faults if not only or any(word in fault.name for word in only)]
