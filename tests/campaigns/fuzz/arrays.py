"""Templates with wrong arrays: whole files, whose content is not what they should hold."""

from __future__ import annotations

import json
import random
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from solver.anatomy.template import Template
from solver.storage import Arrays, read_arrays
from tests.ball_head import ball_head

VALUES = [0, -1, 1, 2**31, 2**62, -(2**62), 0.5, 1e300, np.nan, np.inf]
SHAPES: list[tuple[int, ...]] = [(), (0,), (1,), (0, 3), (3,), (1, 1), (2, 3, 4), (5, 4)]
TYPES = ["f4", "f8", "i1", "i8", "u8", "?", "U3", "f2"]


def read_spoilt_template(content: bytes, folder: Path) -> None:
    """Read a template of which the bytes chose what is wrong."""
    chance = random.Random(content)
    arrays = dict(_arrays(folder))
    for _ in range(chance.randint(1, 3)):
        name = chance.choice(sorted(arrays))
        spoilt = _without(arrays, name, chance) if chance.random() < 0.1 else None
        arrays = spoilt if spoilt is not None else arrays | {name: _spoil(arrays[name], chance)}
    path = folder / "spoilt.npz"
    with path.open("wb") as stream:
        np.savez(stream, allow_pickle=False, **arrays)
    Template.load(path)


@cache
def _arrays(folder: Path) -> Arrays:
    path = folder / "template.npz"
    ball_head().save(path)
    return read_arrays(path)


def _without(arrays: Arrays, name: str, chance: random.Random) -> Arrays:
    """Return the arrays but one, or with one under another's name."""
    rest = {other: array for other, array in arrays.items() if other != name}
    if rest and chance.random() < 0.5:
        rest[chance.choice(sorted(rest))] = arrays[name]
    return rest


def _spoil(array: np.ndarray, chance: random.Random) -> np.ndarray:
    ways = [_values, _shape, _type, _cut, _twice]
    if array.dtype == np.uint8:
        ways.append(_json)
    with np.errstate(all="ignore"):
        return chance.choice(ways)(array, chance)


def _values(array: np.ndarray, chance: random.Random) -> np.ndarray:
    changed = array.copy()
    if changed.size and changed.dtype.kind in "fiu":
        value = chance.choice(VALUES)
        kind = changed.dtype
        changed.flat[chance.randrange(changed.size)] = np.float64(value).astype(kind)
    return changed


def _shape(array: np.ndarray, chance: random.Random) -> np.ndarray:
    return np.zeros(chance.choice(SHAPES), array.dtype)


def _type(array: np.ndarray, chance: random.Random) -> np.ndarray:
    return array.astype(chance.choice(TYPES))


def _cut(array: np.ndarray, _: random.Random) -> np.ndarray:
    return array[:-1] if array.ndim else array


def _twice(array: np.ndarray, _: random.Random) -> np.ndarray:
    return np.concatenate([array, array]) if array.ndim else array


def _json(array: np.ndarray, chance: random.Random) -> np.ndarray:
    """Spoil a header: JSON in bytes."""
    header: Any = json.loads(bytes(array))
    key = chance.choice(sorted(header))
    others: list[Any] = [None, 0, -1, "", "x" * 500, [], {}, [[1]], {"a": 1}, True, 1e308]
    if chance.random() < 0.2:
        del header[key]
    else:
        header[key] = chance.choice(others)
    return np.frombuffer(json.dumps(header).encode(), np.uint8)
