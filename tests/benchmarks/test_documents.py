from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from benchmarks import convergence, documents, report
from benchmarks.documents import Plot, Section, Table, cell

SECTION = Section(
    "Speed",
    "Ours against theirs.",
    [Table(["name", "ms", "same"], [["smile", 12.345, True], ["a|b", None, False]], "Times:")],
)


def stamped(name: str, *arguments: str) -> documents.Figures:
    return report.stamped({}, [f"/somewhere/benchmarks/{name}.py", *arguments])


def test_a_section_replaces_itself_and_nothing_else(tmp_path: Path) -> None:
    document = tmp_path / "benchmarks.md"
    document.write_text("# Title\n\n<!-- begin b -->\n<!-- end b -->\n\nThe end.\n")
    documents.write(stamped("b"), SECTION, document)
    once = document.read_text()
    documents.write(stamped("b"), SECTION, document)
    assert document.read_text() == once
    assert once.startswith("# Title\n\n<!-- begin b -->\n## Speed\n\nOurs against theirs.\n")
    assert once.endswith("<!-- end b -->\n\nThe end.\n")

    documents.write(stamped("new"), SECTION, document)
    assert document.read_text().startswith(once.rstrip())
    documents.write(stamped("b"), Section("Slow", "Other words.", []), document)
    text = document.read_text()
    assert "The end.\n\n<!-- begin new -->\n## Speed" in text
    assert text.count("## Speed") == text.count("## Slow") == 1


def test_a_section_has_tables_and_links_relative_to_the_document(tmp_path: Path) -> None:
    plot = Plot(tmp_path / "images" / "b-times.png", "Times")
    section = Section("Speed", "Ours.", [*SECTION.parts, plot])
    text = documents.rendered(stamped("b"), section, tmp_path)
    assert "Times:\n\n| name | ms | same |\n| --- | ---: | --- |\n| smile | 12.3 | yes |" in text
    assert "| a\\|b |  | no |" in text
    assert text.endswith("![Times](images/b-times.png)")


def test_the_command_shows_no_folder_of_this_machine() -> None:
    arguments = ("--json", "/secret/out.json", "--faces=/secret/faces", "--data", "../shared/data")
    run = stamped("b", *arguments)["run"]
    assert run["command"] == ("python -m benchmarks.b --json - --faces faces --data ../shared/data")


def test_an_earlier_run_is_laid_out_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    document = tmp_path / "docs" / "benchmarks.md"
    figures = tmp_path / "run.json"
    document.parent.mkdir()
    document.write_text("# Benchmarks\n")
    curve = {"objective": [3.0, 2.0, 1.0], "seconds": [0.0, 0.5, 1.0]}
    run = stamped("convergence") | {
        "expression": "kiss",
        "vertices": 2000,
        "tets": 6000,
        "solvers": {"A": curve, "IPOPT": curve},
        "rounds_mm": {"kiss": [1.0, 0.5]},
    }
    figures.write_text(json.dumps(run))
    monkeypatch.setattr(convergence, "IMAGES", document.parent / "images")
    monkeypatch.setattr(documents, "DOCUMENT", document)
    monkeypatch.setattr("sys.argv", ["report", "convergence", str(figures)])
    report.main()
    text = document.read_text()
    assert "| A | 2 | 1.00 | 1.00 |" in text
    pictures = re.findall(r"\]\((.*)\)", text)
    assert len(pictures) == 2
    assert all((document.parent / picture).exists() for picture in pictures)


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.45, "0.450"), (99.96, "100"), (1234.5, "1,234"), (4.3e-14, "4.3e-14"), (25920, "25,920")],
)
def test_numbers_have_three_significant_digits(value: float, text: str) -> None:
    assert cell(value) == text
