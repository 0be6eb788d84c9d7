"""The tables of action units: they fit each other and the templates, and names are understood."""

from __future__ import annotations

import pytest

from solver.anatomy.action_units import (
    action_units,
    actions_of,
    is_one_of,
    joined_codes,
    template_names,
)
from solver.anatomy.data import read_table
from solver.scans.live_link import ARKIT_NAMES

LOOKS = "eyeLook"
NO_UNIT = {"mouthLeft", "mouthRight", "tongueOut"}  # FACS has none that muscles of the face make


def cells(table: str, column: str) -> list[str]:
    return [name for row in read_table(table) for name in row[column].split("; ") if name]


def test_the_tables_know_each_other() -> None:
    units = action_units()
    sources = cells("sources", "key")
    for unit in units.values():
        assert unit.sources
        assert set(unit.sources) <= set(sources), unit.code
        for muscle in (*unit.muscles, *unit.antagonists):
            assert template_names(muscle)
    assert set(cells("expression_units", "units")) <= set(units)
    assert set(cells("expression_units", "source")) <= set(sources)


def test_the_templates_have_the_muscles_that_they_are_said_to_have() -> None:
    for template, table, column in (
        ("builtin", "muscles", "name"),
        ("bodyparts3d", "bodyparts3d_muscles", "muscle"),
    ):
        parts = {
            f"{row[column]}.{part.strip()}"
            for row in read_table(table)
            for part in row["compartments"].replace("|", ";").split(";")
        }
        assert set(cells("muscle_names", template)) <= parts | set(cells(table, column))


def test_every_shape_of_arkit_has_its_units() -> None:
    without = {name for name in ARKIT_NAMES if not actions_of(name)}
    assert {name for name in without if not name.startswith(LOOKS)} == NO_UNIT


@pytest.mark.parametrize(
    ("name", "codes", "sides"),
    [
        ("smile", "AU 6 + 12", {"left", "right"}),
        ("Brow raise_R", "AU 1 + 2", {"right"}),
        ("mouthSmile_L", "AU 12", {"left"}),
        ("mouthSmileRight", "AU 12", {"right"}),
        ("jawLeft", "AD 30", {"left", "right"}),
        ("mouthClose", "AU 26 + 8", {"left", "right"}),
        ("AU6+12", "AU 6 + 12", {"left", "right"}),
        ("au 9 left", "AU 9", {"left"}),
        ("AU6+999", "", set()),
        ("scan_0012", "", set()),
    ],
)
def test_a_name_speaks_for_actions(name: str, codes: str, sides: set[str]) -> None:
    found = actions_of(name)
    assert joined_codes(action.unit for action in found) == codes
    assert {action.side for action in found} == sides


@pytest.mark.parametrize(
    ("name", "of_margin"),
    [
        ("orbicularis_oris_upper_l.lateral.marginal", True),
        ("orbicularis_oris_upper_l.lateral.peripheral", False),
        ("orbicularis oris.upper left medial.marginal", True),
        ("orbicularis_oris_upper_l", True),
        ("orbicularis_oris_upper_l.lateral", True),  # as models of before divided it
        ("orbicularis_oculi_palpebral_upper_l.medial.pretarsal", False),
    ],
)
def test_a_part_of_a_muscle_is_told_from_the_others(name: str, of_margin: bool) -> None:
    assert is_one_of(name, ["marginal part of orbicularis oris"]) is of_margin
    assert is_one_of(name, ["orbicularis oris"]) is ("oris" in name)
