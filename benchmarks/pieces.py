"""Join the pieces of a benchmark: runs of a subject, a set or a part each, of at most 20 minutes.

A piece is what ``--json`` wrote. Figures of different names stand side by side in the whole; one
that two pieces have has to be the same in both. What a benchmark makes of all its figures, such as
the worst subject's, it makes anew: its ``summarised`` takes the joined figures, and says with
:data:`OF_ALL` which of a piece's are not to be joined.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.documents import Figures

STAMPS = ("machine", "run")
OF_ALL = "SUMMARY"


class PieceError(Exception):
    """Pieces that do not make a whole."""


def merged(benchmark: str, files: Sequence[Path]) -> Figures:
    """Return the figures of one run from those of its pieces; raises :class:`PieceError`.

    Its stamp is the newest piece's, with the commit and the command of each.
    """
    pieces = [json.loads(file.read_text(encoding="utf-8")) for file in files]
    for file, piece in zip(files, pieces, strict=True):
        found = piece.get("run", {}).get("benchmark")
        if found != benchmark:
            raise PieceError(f"{file} is of the benchmark {found}, not of {benchmark}")
    module = importlib.import_module(f"benchmarks.{benchmark}")
    left_out = {*STAMPS, *getattr(module, OF_ALL, ())}
    whole: Figures = {}
    for file, piece in zip(files, pieces, strict=True):
        _join(whole, {key: value for key, value in piece.items() if key not in left_out}, str(file))
    if hasattr(module, "summarised"):
        whole = module.summarised(whole)
    newest = max(pieces, key=lambda piece: str(piece["run"]["date"]))
    runs = [piece["run"] for piece in pieces]
    command = "\n    ".join(str(run["command"]) for run in runs)
    told = [{key: run.get(key) for key in ("date", "commit", "command")} for run in runs]
    run = {**newest["run"], "command": command, "pieces": told}
    return {**whole, "machine": newest["machine"], "run": run}


def _join(whole: dict[str, Any], piece: Mapping[str, Any], file: str, place: str = "") -> None:
    """Add a piece's figures to the whole, in place."""
    for key, value in piece.items():
        here = f"{place}.{key}" if place else key
        if key not in whole:
            whole[key] = value
        elif isinstance(value, Mapping) and isinstance(whole[key], dict):
            _join(whole[key], value, file, here)
        elif whole[key] != value:
            raise PieceError(f"{file}: {here} is {value}, in a piece before it {whole[key]}")
