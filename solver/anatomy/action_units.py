"""Action units of FACS: the muscles that make each, and the expressions that they make up.

The tables are in ``solver/anatomy/data``: ``action_units.csv`` has muscles by the names of anatomy
texts, ``muscle_names.csv`` what the templates call them, ``expression_units.csv`` the units of
ARKit's shapes and of plain words.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

from solver.anatomy.data import read_table, split_cell
from solver.drawing.head import both_sides, muscle_side

SIDES = ("left", "right")


@dataclass(frozen=True)
class ActionUnit:
    """A unit of FACS; muscles have the names of anatomy texts, without sides."""

    code: str  # ``AU 12``, or ``AD 29`` for a descriptor
    name: str
    muscles: tuple[str, ...]  # that make it
    antagonists: tuple[str, ...]  # that work against it, or must relax for it
    by_relaxing: bool  # whether these make it by relaxing, without its muscles
    sources: tuple[str, ...]  # keys of ``sources.csv``


class Action(NamedTuple):
    """An action unit on one ``side`` of the face: ``left`` or ``right``."""

    unit: ActionUnit
    side: str


@cache
def action_units() -> dict[str, ActionUnit]:
    """Return code -> unit."""
    return {
        row["unit"]: ActionUnit(
            row["unit"],
            row["name"],
            split_cell(row["muscles"]),
            split_cell(row["antagonists"]),
            row["by_relaxing"] == "yes",
            tuple(row["source"].split()),
        )
        for row in read_table("action_units")
    }


def units_of(expression: str) -> tuple[ActionUnit, ...]:
    """Return the units of a shape or word without a side; () for one that is in no table.

    It may name the units itself, as ``AU12`` or ``AU6+12``.
    """
    units = action_units()
    name = _plain(expression)
    if re.fullmatch(r"au\d+(\+(au)?\d+)*", name):
        codes = [f"AU {number}" for number in re.findall(r"\d+", name)]
        return tuple(units[code] for code in codes) if units.keys() >= set(codes) else ()
    return tuple(units[code] for code in _expressions().get(name, ()))


def actions_of(expression: str) -> tuple[Action, ...]:
    """Return the actions of a shape or word; those of one without a side are on both.

    The side is at the end: ``mouthSmileLeft``, ``mouthSmile_L``, ``smile left``.
    """
    units = units_of(expression)
    if units:
        return tuple(Action(unit, side) for unit in units for side in SIDES)
    found = re.fullmatch(r"(.+?)[\s_-]*(left|right|(?<=[\s_-])[lr])", expression, re.IGNORECASE)
    if found is None:
        return ()
    side = SIDES["lr".index(found[2][0].lower())]
    return tuple(Action(unit, side) for unit in units_of(found[1]))


def joined_codes(units: Iterable[ActionUnit]) -> str:
    """Return the codes of units in one, as ``AU 6 + 12``; "" of none."""
    return " + ".join(dict.fromkeys(unit.code for unit in units)).replace("+ AU ", "+ ")


def template_names(muscle: str) -> frozenset[str]:
    """Return what templates call a muscle of anatomy texts, without sides, in small letters.

    Of a part of a muscle they are the whole's name and a word of its compartments' names, with a
    dot between them.
    """
    return _template_names()[muscle]


def template_wholes(muscle: str) -> frozenset[str]:
    """Return what templates call the whole of a muscle, or of a part, of anatomy texts."""
    return frozenset(name.partition(".")[0] for name in template_names(muscle))


def is_one_of(name: str, muscles: Iterable[str]) -> bool:
    """Tell whether a template's muscle, or compartment, is one of ``muscles`` of anatomy texts.

    A muscle that is not divided into the parts of texts is as a whole what each of them is.
    """
    whole, _, part = name.lower().partition(".")
    whole = both_sides(whole)
    words = re.split(r"[\s.]+", part)
    of_whole = {part for part in _parts().get(whole, ()) if part in words}
    for muscle in muscles:
        for given in template_names(muscle):
            named, _, part = given.partition(".")
            if named == whole and (not part or not of_whole or part in of_whole):
                return True
    return False


@cache
def find_called(muscles: tuple[str, ...], expression: str) -> tuple[list[bool], list[bool]]:
    """Tell of ``muscles`` whether a unit of an expression names them, or as antagonists.

    A unit is made on its side, by muscles of that side and of the middle.
    """

    def are_of(chosen: Callable[[ActionUnit], tuple[str, ...]]) -> list[bool]:
        called = [(chosen(unit), side) for unit, side in actions_of(expression)]
        return [
            any(
                muscle_side(name.partition(".")[0]) in (side, "") and is_one_of(name, of)
                for of, side in called
            )
            for name in muscles
        ]

    return are_of(lambda unit: unit.muscles), are_of(lambda unit: unit.antagonists)


@cache
def _template_names() -> dict[str, frozenset[str]]:
    found = {}
    for row in read_table("muscle_names"):
        names = [row["muscle"], *split_cell(row["builtin"]), *split_cell(row["bodyparts3d"])]
        pairs = (name.partition(".") for name in names)
        found[row["muscle"]] = frozenset(both_sides(name) + dot + part for name, dot, part in pairs)
    return found


@cache
def _parts() -> dict[str, set[str]]:
    """Return whole muscle of a template -> the parts of it that anatomy texts name."""
    found: dict[str, set[str]] = {}
    for name in frozenset().union(*_template_names().values()):
        whole, _, part = name.partition(".")
        if part:
            found.setdefault(whole, set()).add(part)
    return found


@cache
def _expressions() -> dict[str, tuple[str, ...]]:
    rows = read_table("expression_units")
    return {_plain(row["expression"]): split_cell(row["units"]) for row in rows}


def _plain(name: str) -> str:
    """Return a name in small letters without what parts its words."""
    return re.sub(r"[\s_-]+", "", name).lower()
