"""The certificate's page: it stands alone, says what is known, and trusts no name."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from solver.errors import make_warning
from solver.fitting.face import Face
from solver.rig import ExpressionFit, Rig
from solver.rig.report import report
from solver.rig.report.certificate import certify
from solver.rig.report.web_page import write_page
from tests.solver.block import block_model, divided_block

EVIL = "<b>sad & 'so'"
VOID = {"meta", "img", "path", "circle"}


class Reader(HTMLParser):
    """Collects what a page refers to, and whether its tags are closed in order."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.text: list[str] = []
        self.tags: set[str] = set()
        self.images: list[dict[str, str | None]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self.tags.add(tag)
        self.ids += [value for value in [found.get("id")] if value]
        self.links += [value for key in ("href", "src") if (value := found.get(key))]
        if tag == "img":
            self.images.append(found)
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def fit(face: Face, name: str, error: float) -> ExpressionFit:
    skin = face.model.skin.vertices
    pose = face.rest_pose()
    seen = np.full(len(skin), error)
    seen[::4] = np.nan
    return ExpressionFit(
        name, "test", pose.a, pose.b, skin, skin, seen, 0, 3, 0.5, error**2, face.model.rest
    )


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Reader:
    folder = tmp_path_factory.mktemp("rig")
    face = Face(block_model())
    told = (make_warning("muscle.no_share", "left has <no> flesh"),)
    noticed = replace(
        fit(face, "ah", 0.2), status="stopped", notices=(make_warning("x", "half & half"),)
    )
    fits = (replace(fit(face, EVIL, 0.7), role="train"), noticed)
    rig = Rig(face.model, face.model.weights, fits, {}, told)
    Image.new("RGB", (1600, 1188)).save(folder / "fit_ah.png")
    write_page(folder / "report.html", report(rig, certify(face, rig, {"rounds": 12})))
    return read(folder / "report.html")


def read(path: Path) -> Reader:
    reader = Reader()
    reader.feed(path.read_text(encoding="utf-8"))
    assert reader.open == []
    return reader


def test_it_stands_alone(page: Reader) -> None:
    assert not page.tags & {"script", "link", "iframe", "object"}
    assert not [link for link in page.links if re.match(r"(https?:)?//", link)]
    anchors = {link[1:] for link in page.links if link.startswith("#")}
    assert anchors <= set(page.ids)
    assert len(set(page.ids)) == len(page.ids)
    assert [image["alt"] for image in page.images] == [
        "ah: scan, fit and the distance between them, from the front and from the side"
    ]
    assert str(page.images[0]["src"]).startswith("data:image/jpeg;base64,")


def test_names_are_text(page: Reader) -> None:
    assert EVIL in page.text
    assert not re.search(r"\bnan\b", " ".join(page.text).lower())


def test_it_says_what_to_look_at(page: Reader) -> None:
    words = " ".join(" ".join(page.text).split())
    assert "Mean distance : 0.7 mm in" in words
    assert "Face that the scan shows : 73.3 % in" in words
    assert "Usable" in words
    assert "not tried" in words  # no round trip
    assert "left has <no> flesh" in words
    assert "fit this expression again with rounds 24 instead of 12." in words
    assert "Ready for animation. " in words
    assert "Warnings : 2 in ah : left has <no> flesh; half & half." in words
    assert "#e1-warnings" in page.links
    assert "half & half x" in words  # with its code
    assert "Fits that ended early : 1 in ah : after 3 steps by reduced." in words
    assert "determine 0 of 2 muscles" in words


def test_it_marks_what_contradicts_the_name(tmp_path: Path) -> None:
    model = replace(block_model(), muscle_names=("left zygomaticus major", "right mentalis"))
    model = replace(model, fibres=np.tile([0.0, 1.0, 0.0], (len(model.weights.data), 1)))
    face = Face(model)
    a = np.array([[1.0, 0.0, 0.0, 1.07, 0.0, 1.0], [1.0, 0.0, 0.0, 0.8, 0.0, 1.0]])
    smile = replace(fit(face, "mouthSmileLeft", 0.2), activations=a, x=None)
    rig = Rig(model, model.weights, (smile, replace(smile, name="look")))
    figures = report(rig, certify(face, rig, {}))
    write_page(tmp_path / "report.html", figures)
    movers = figures["expressions"]["mouthSmileLeft"]["movers"]
    assert movers["contractions"] == [
        {"muscle": "right mentalis", "contraction": 0.2},
        {"muscle": "left zygomaticus major", "contraction": -0.07},
    ]
    [action] = movers["actions"]
    assert (action["unit"], action["side"], action["rank"]) == ("AU 12", "left", None)
    [check] = [each for each in figures["checks"] if each["code"] == "muscles.movers"]
    assert check["failed"] == ["mouthSmileLeft"]
    page = read(tmp_path / "report.html")
    # the sentence about effort leads to the muscles of the expression
    assert figures["limits"][0]["expression"] == "mouthSmileLeft"
    assert {"#e0-muscles", "#muscles.movers"} <= set(page.links)
    assert {link[1:] for link in page.links if link.startswith("#")} <= set(page.ids)
    words = " ".join(" ".join(page.text).split())
    assert "By its name: AU 12 lip corner puller." in words
    assert "left zygomaticus major −7 % makes AU 12; lengthens in AU 12" in words
    assert "The expression's name speaks for no action unit" in words


def test_compartments_fold_under_their_whole(tmp_path: Path) -> None:
    face = Face(divided_block())
    wholes = list(dict.fromkeys(face.model.muscle_groups))
    lengths = np.array([0.8, 0.9, 1.0, 1.2])
    a = np.array([[f, 0.0, 0.0, f**-0.5, 0.0, f**-0.5] for f in lengths])
    smile = replace(fit(face, "smile", 0.2), activations=a, x=None)
    rig = Rig(face.model, face.model.weights, (smile,))
    figures = report(rig, certify(face, rig, {}))
    write_page(tmp_path / "report.html", figures)
    table = read_rows(tmp_path / "report.html", "muscles")
    assert [row[0] for row in table] == [
        *(wholes[0], "lower", "upper"),
        *(wholes[1], "lower", "upper"),
    ]
    shown = [row[1] for row in table]
    for number, parts in enumerate((slice(0, 2), slice(2, 4))):
        most = 1.0 - lengths[parts].min()
        assert shown[3 * number] == (f"{100.0 * most:.0f}" if most else "·")
    assert [shown[1], shown[2], shown[4], shown[5]] == ["20", "10", "·", "−20"]
    words = " ".join(" ".join(read(tmp_path / "report.html").text).split())
    assert f"{wholes[1]}.upper pushes: its fibres lengthen to 120 %" in words


def read_rows(path: Path, table: str) -> list[list[str]]:
    """Return the texts of the body's cells of the table of a class."""
    markup = path.read_text(encoding="utf-8").split(f'<table class="{table}">')[1]
    body = markup.split("</thead>")[1].split("</table>")[0]
    rows = re.findall(r"<tr.*?</tr>", body, re.DOTALL)
    cells = [re.findall(r"<t[hd].*?</t[hd]>", row, re.DOTALL) for row in rows]
    return [[re.sub(r"<.*?>", "", cell) for cell in row] for row in cells]
