"""``docs/science/benchmarks.md``: every benchmark writes its own section, between its own markers.

A benchmark needs a function from its figures (the object that ``--json`` writes) to a section, and
ends with it; ``--document`` then writes the section::

    def section(figures: dict[str, Any]) -> Section:
        rows = [[e["name"], e["train_mean_mm"], e["inverted"]] for e in figures["expressions"]]
        plot = documents.IMAGES / "fit_quality-errors.png"
        plots.errors(plot, "Mean distance to the scan", {"S": [...], "P": [...]}, names)
        return Section(
            title="Fit quality",
            compared="What is compared with what, in a sentence or two of Markdown.",
            parts=[
                Table(["expression", "mean, mm", "inverted tets"], rows),
                Plot(plot, "Mean distance to the scan of every expression"),
            ],
        )

    report.finish(run(options), options, section)

The date, the command line and the machine's size are added here. ``python -m benchmarks.report NAME
FILE...`` writes the section from the JSON of an earlier run, or of the pieces of one
(:mod:`.pieces`), without running anything.
"""

from __future__ import annotations

import os
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

DOCUMENT = Path(__file__).parents[1] / "docs" / "science" / "benchmarks.md"
IMAGES = DOCUMENT.parents[1] / "images" / "benchmarks"
"""Where plots go, named BENCHMARK-WHAT.png."""

Figures = dict[str, Any]


@dataclass(frozen=True)
class Table:
    """Rows of text, numbers, yes or no, or None where there is no value; ``caption`` above it."""

    header: Sequence[str]
    rows: Sequence[Sequence[Any]]
    caption: str = ""


@dataclass(frozen=True)
class Plot:
    """A picture in :data:`IMAGES`, and what it shows."""

    path: Path
    caption: str


@dataclass(frozen=True)
class Section:
    """One benchmark in the document; texts are paragraphs of Markdown without line breaks."""

    title: str
    compared: str
    parts: Sequence[Table | Plot | str]


SectionOf = Callable[[Figures], Section]


def write(figures: Figures, section: Section, document: Path) -> None:
    """Put the section of ``figures`` in place of the one before, or at the ``document``'s end.

    ``figures`` are stamped by :func:`benchmarks.report.stamped`.
    """
    begin, end = markers(figures["run"]["benchmark"])
    text = document.read_text(encoding="utf-8")
    if begin not in text:
        text = f"{text.rstrip()}\n\n{begin}\n{end}\n"
    before, rest = text.split(begin)
    _, after = rest.split(end)
    body = rendered(figures, section, document.parent)
    document.write_text(f"{before}{begin}\n{body}\n{end}{after}", encoding="utf-8")


def markers(benchmark: str) -> tuple[str, str]:
    """Return the lines before and after a benchmark's section."""
    return f"<!-- begin {benchmark} -->", f"<!-- end {benchmark} -->"


def rendered(figures: Figures, section: Section, folder: Path) -> str:
    """Return the section as Markdown, links relative to ``folder``."""
    run = figures["run"]
    machine = figures["machine"]
    ran = (
        f"{run['date']}, {machine['cores']} cores, {machine['memory_gib']} GiB of memory:\n\n"
        f"    {run['command']}"
    )
    parts = [_part(part, folder) for part in section.parts]
    return "\n\n".join([f"## {section.title}", _paragraph(section.compared), ran, *parts])


def _part(part: Table | Plot | str, folder: Path) -> str:
    if isinstance(part, str):
        return _paragraph(part)
    if isinstance(part, Plot):
        return f"![{part.caption}]({Path(os.path.relpath(part.path, folder)).as_posix()})"
    rule = [
        "---:" if any(_is_number(row[column]) for row in part.rows) else "---"
        for column in range(len(part.header))
    ]
    rows = [part.header, rule, *([cell(value) for value in row] for row in part.rows)]
    table = "\n".join(f"| {' | '.join(row)} |" for row in rows)
    return f"{_paragraph(part.caption)}\n\n{table}" if part.caption else table


def _paragraph(text: str) -> str:
    return textwrap.fill(text, 100, break_long_words=False, break_on_hyphens=False)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def cell(value: Any) -> str:
    """Return a table's text: numbers with three significant digits, whole ones in full."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        size = abs(value)
        if size >= 100.0:
            return f"{value:,.0f}"
        return f"{value:.2g}" if size < 1e-3 else f"{value:#.3g}".rstrip(".")
    return str(value).replace("|", "\\|")
