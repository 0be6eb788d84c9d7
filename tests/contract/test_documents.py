"""What README and docs tell a reader to type, click or cite is there."""

from __future__ import annotations

import re
import shlex
import tomllib
from pathlib import Path

import pytest
import yaml

from myoface import __version__
from myoface.cli import app
from myoface.cli.commands import Command, Group, Runnable
from myoface.cli.operator import OperatorCommand

ROOT = Path(__file__).parents[2]
DOCUMENTS = [ROOT / "README.md", ROOT / "ARCHITECTURE.md", *sorted((ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(r"(?:^ {4,}\S.*\n)+", re.MULTILINE)
INLINE = re.compile(r"`([^`\n]+)`")


def lines(document: Path, command: str) -> list[str]:
    """Return what a document says after ``command``, in code."""
    text = document.read_text(encoding="utf-8")
    code = [line for block in BLOCK.findall(text) for line in block.splitlines()]
    code += INLINE.findall(text)
    found = (re.match(rf"\s*(?:\S*/)?{command} +(.*)", line) for line in code)
    return [match[1] for match in found if match]


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_make_targets_exist(document: Path) -> None:
    makefile = (ROOT / "Makefile").read_text()
    for line in lines(document, "make"):
        target = line.split()[0]
        assert re.search(rf"^{re.escape(target)}:", makefile, re.MULTILINE), line


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_myoface_commands_and_options_exist(document: Path) -> None:
    for line in lines(document, "myoface"):
        words = shlex.split(line, comments=True)
        command: Runnable = app
        while words and not words[0].startswith("-"):
            if isinstance(command, OperatorCommand):
                command = command.load()
            if not isinstance(command, Group):
                break
            assert words[0] in command.members, line
            command = command.members[words.pop(0)]
        if isinstance(command, OperatorCommand):
            command = command.load()
        known = {"--help", "--version"}
        if isinstance(command, Command):
            known |= command.parser("").option_strings
        asked = {word.split("=")[0] for word in words if word.startswith("-")}
        assert asked <= known, line


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", text):
        if "://" not in target:
            assert (document.parent / target).exists(), target


def test_the_citation_is_of_this_version() -> None:
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert cited["version"] == __version__
    assert cited["license"] == project["license"]
    for paper in cited["references"]:
        assert {"type", "title", "authors", "year"} <= paper.keys()
        assert all({"given-names", "family-names"} <= author.keys() for author in paper["authors"])


def test_the_ways_of_the_data_lead_through_functions_that_are_there() -> None:
    page = (ROOT / "docs/develop/follow-the-data.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\S+\.py)` \| (.+?) \|", page, re.MULTILINE)
    assert len(rows) > 50
    for file, functions in rows:
        text = (ROOT / file).read_text(encoding="utf-8")
        defined = set(re.findall(r"^\s*(?:def|class) (\w+)", text, re.MULTILINE))
        assert set(INLINE.findall(functions)) <= defined, file
