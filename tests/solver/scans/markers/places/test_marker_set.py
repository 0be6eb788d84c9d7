"""Marker sets: written, read back, and refused with the place of what is wrong."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from solver.errors import InputError
from solver.scans.markers.places.bind import rest_places
from solver.scans.markers.places.marker_set import Marker, MarkerSet
from solver.similarity import Similarity
from solver.surface import Surface

MIRROR = Similarity(1.0, np.diag([-1.0, 1.0, 1.0]), np.array([1.0, 2.0, 3.0]))
MARKERS = (
    Marker("LBRO1", (4, 8, 15), (0.25, 0.5, 0.25), 2.5, "face", 0.7),
    Marker("HEAD1", height_mm=3.0, part="head", place_mm=(1.0, 2.0, 3.0)),
    Marker("CHEST", part="ignore"),
)
SET = MarkerSet(MARKERS, MIRROR, "ab" * 32)


def test_a_set_is_read_as_it_was_written(tmp_path: Path) -> None:
    SET.save(tmp_path / "set.json")
    read = MarkerSet.load(tmp_path / "set.json")
    assert read.markers == MARKERS
    assert np.linalg.det(read.session.rotation) < 0
    assert read.model_sha256 == SET.model_sha256
    np.testing.assert_array_equal(read.session(np.eye(3)), MIRROR(np.eye(3)))
    np.testing.assert_array_equal(read.vertices[0], [4, 8, 15])
    np.testing.assert_array_equal(read.places[1], [1.0, 2.0, 3.0])
    assert np.isnan(read.places[0]).all()
    assert read.of_part("head", "upper_teeth").tolist() == [1]


def test_markers_have_places_at_rest_but_for_those_that_are_ignored() -> None:
    ignored = replace(MARKERS[2], place_mm=(1.0, 2.0, 3.0))  # as binding leaves it
    markers = replace(SET, markers=(*MARKERS[:2], ignored))
    skin = Surface(np.random.default_rng(0).normal(size=(20, 3)), np.zeros((0, 3), np.int64))
    places = rest_places(markers, skin)
    assert np.isfinite(places[:2]).all()
    assert np.isnan(places[2]).all()


def _change(path: str, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(document: dict[str, Any]) -> None:
        *parents, last = [int(part) if part.isdigit() else part for part in path.split(".")]
        for part in parents:
            document = document[part]
        document[last] = value

    return change


@pytest.mark.parametrize(
    ("path", "value", "code", "where"),
    [
        ("markers.0.at.weights", [0.5, 0.5, 0.5], "schema", "markers.markers[0].at.weights"),
        ("markers.0.at.weights", [2.0, -0.5, -0.5], "schema", "markers.markers[0].at.weights[0]"),
        ("markers.0.at", [1, 2, 3.5], "schema", "markers.markers[0].at"),
        ("markers.1.at", {"vertices": [1, 2, 3], "weights": [1, 0, 0]}, "schema",
         "markers.markers[1].at"),
        ("markers.1.part", "nose", "schema", "markers.markers[1].part"),
        ("markers.1.label", "LBRO1", "labels", None),
        ("markers.0.sigma_mm", 0.0, "schema", "markers.markers[0].sigma_mm"),
        ("markers.0.sigma_mm", 1e-320, "schema", "markers.markers[0].sigma_mm"),
        ("session.scale", 1e-320, "schema", "markers.session.scale"),
        ("session.rotation", [[1, 0, 0], [0, 1, 0], [0, 0, 0.9]], "schema",
         "markers.session.rotation"),
        ("session.shift_mm.0", float("nan"), "schema", "markers.session.shift_mm[0]"),
        ("model_sha256", "ab", "schema", "markers.model_sha256"),
        ("format", 2, "schema", "markers.format"),
    ],
)  # fmt: skip
def test_a_wrong_value_is_told_with_its_place(
    tmp_path: Path, path: str, value: Any, code: str, where: str | None
) -> None:
    document = copy.deepcopy(SET.to_document())
    _change(path, value)(document)
    (tmp_path / "set.json").write_text(json.dumps(document))
    with pytest.raises(InputError) as caught:
        MarkerSet.load(tmp_path / "set.json")
    assert caught.value.code == f"markers.set_{code}"
    assert caught.value.context.get("where") == where
    assert caught.value.context["file"] == "set.json"


def test_what_is_no_set_is_refused(tmp_path: Path) -> None:
    for content in (b"", b"[" * 100_000, b"\xff", b"{}", b"[]", b"1", b" " * (5 << 20)):
        (tmp_path / "set.json").write_bytes(content)
        with pytest.raises(InputError) as caught:
            MarkerSet.load(tmp_path / "set.json")
        assert caught.value.context["file"] == "set.json"
