"""The end of every benchmark: one JSON object, and its section of the document."""

from __future__ import annotations

import argparse
import importlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Collection, Iterable
from datetime import UTC, datetime
from pathlib import Path

from benchmarks import documents, pieces
from benchmarks.documents import Figures, SectionOf


def parser(description: str) -> argparse.ArgumentParser:
    """Return a parser with the options all benchmarks share."""
    arguments = argparse.ArgumentParser(description=description)
    arguments.add_argument("--json", required=True, help="file to write, - for standard output")
    arguments.add_argument("--quick", action="store_true", help="a smaller run of the same code")
    arguments.add_argument(
        "--document",
        action="store_true",
        help="write the section in docs/science/benchmarks.md too",
    )
    return arguments


def add_list(arguments: argparse.ArgumentParser, option: str, known: Iterable[str]) -> None:
    """Add an ``option`` that chooses among ``known`` names, such as the parts of a benchmark."""
    names = list(known)
    words = f"some of {', '.join(names)}, joined by commas (default: all)"
    read = list_of(names)
    arguments.add_argument(option, type=read, default=names, metavar="LIST", help=words)


def list_of(known: Collection[str] | None = None) -> Callable[[str], list[str]]:
    """Return a reader of names joined by commas, ``known`` ones if those are given."""

    def read(text: str) -> list[str]:
        names = list(dict.fromkeys(word.strip() for word in text.split(",") if word.strip()))
        if not names:
            raise argparse.ArgumentTypeError("at least one name")
        for name in names:
            if known is not None and name not in known:
                message = f"{name} is none of {', '.join(known)}"
                raise argparse.ArgumentTypeError(message)
        return names

    return read


def part_true(answers: Iterable[bool]) -> float | None:
    """Return the part that is true; None of nothing."""
    listed = list(answers)
    return sum(listed) / len(listed) if listed else None


def finish(figures: Figures, options: argparse.Namespace, section: SectionOf) -> None:
    """Write the figures where ``--json`` says and, with ``--document``, their section."""
    text = _write(stamped(figures, sys.argv), options.json)
    if options.document:
        _document(text, section)


def _write(figures: Figures, place: str) -> str:
    """Write figures to a file, or to standard output for -, and return what was written."""
    text = json.dumps(figures, indent=2, allow_nan=False) + "\n"
    if place == "-":
        sys.stdout.write(text)
    else:
        Path(place).write_text(text, encoding="utf-8")
    return text


def _document(text: str, section: SectionOf) -> None:
    figures = json.loads(text)
    documents.write(figures, section(figures), documents.DOCUMENT)


def stamped(figures: Figures, arguments: list[str]) -> Figures:
    """Return the figures with the machine's size, the date and the command line beside them."""
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    path = Path(arguments[0])
    name = path.parent.name if path.stem == "__main__" else path.stem
    return {
        **figures,
        "machine": {"cores": os.cpu_count(), "memory_gib": round(memory)},
        "run": {
            "benchmark": name,
            "date": datetime.now(UTC).date().isoformat(),
            "commit": _commit(),
            "command": f"python -m benchmarks.{name} {' '.join(_public(arguments[1:]))}",
        },
    }


def _commit() -> str | None:
    """Return the commit of this tree, "+" where files were changed since; None outside of git."""
    words = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty=+"]
    try:
        done = subprocess.run([*words, "--exclude=*"], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()


def _public(arguments: list[str]) -> list[str]:
    """Return the arguments without this machine's folders, and with ``--json -``."""
    words = [part for word in arguments for part in word.split("=", 1)]
    return [
        "-" if before == "--json" else Path(word).name if Path(word).is_absolute() else word
        for before, word in zip(["", *words], words, strict=False)
    ]


def main() -> None:
    """Write a section from the figures of an earlier run, or of its pieces."""
    arguments = argparse.ArgumentParser(
        description="a benchmark's section, from the JSON files of one run or of its pieces"
    )
    arguments.add_argument("name", help="of the benchmark")
    arguments.add_argument("json", type=Path, nargs="+", help="files that its --json wrote")
    arguments.add_argument("--merge", metavar="FILE", help="where the joined figures go, too")
    options = arguments.parse_args()
    try:
        figures = pieces.merged(options.name, options.json)
    except pieces.PieceError as fault:
        raise SystemExit(str(fault)) from None
    text = _write(figures, options.merge) if options.merge else json.dumps(figures)
    _document(text, importlib.import_module(f"benchmarks.{options.name}").section)


if __name__ == "__main__":
    main()
