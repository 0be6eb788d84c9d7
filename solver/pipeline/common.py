"""What the jobs share: options, a rig's file, the place of a part's progress in the whole."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from solver.errors import InputError
from solver.progress import Step

Options = Mapping[str, Any] | None


def take(options: Options, defaults: dict[str, Any]) -> dict[str, Any]:
    """Return the defaults with the given options; raises ``options.unknown`` for others."""
    unknown = set(options or {}) - set(defaults)
    if unknown:
        raise InputError(
            "options.unknown",
            f"unknown options {sorted(unknown)}; known are {sorted(defaults)}",
            expected=sorted(defaults),
        )
    return {**defaults, **(options or {})}


def check_choice(given: Mapping[str, Any], name: str, known: Sequence[str]) -> None:
    """Raise ``options.<name>`` if the option is none of those that are known."""
    if given[name] not in known:
        raise InputError(
            f"options.{name}",
            f"unknown {name} {given[name]!r}; known are {', '.join(known)}",
            expected=list(known),
        )


def within(step: Step, start: float, end: float) -> Step:
    """Map a part's progress into [start, end] of the whole."""
    given = {**step.as_dict(), "fraction": start + step.fraction * (end - start)}
    return Step(**given)


def refuse(faults: Sequence[InputError]) -> None:
    """Raise what is wrong with the inputs, all of it at once, so that all can be mended at once."""
    if not faults:
        return
    if len(faults) == 1:
        raise faults[0]
    messages = "; ".join(fault.message for fault in faults)
    raise InputError(
        "scan.several",
        f"{len(faults)} scans can not be used: {messages}",
        faults=[fault.as_dict() for fault in faults],
    )


def activations_file(rig: Path) -> Path:
    """Return the ``activations.npz`` of a rig that is given as its folder or as that file."""
    return rig / "activations.npz" if rig.is_dir() else rig
