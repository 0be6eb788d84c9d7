"""Names and roles of scans by their files: what is legal for the service, before anything is sent.

The page has the same rule in ``service/page/static/js/scan_files.js``; both are tried on the cases
of ``tests/fixtures/scan_names.json``.

- A role is in the name: ``neutral``, ``neutre``, ``rest`` or ``relaxed`` as a word of its own is
  the neutral, an ending that one role alone has (``.npy``, ``.c3d``) says that one, and all else is
  an expression.
- A name that is legal stays as it is. In others accents go, and blanks and signs become ``_``.
- What all files of a session begin with, up to a blank, ``_`` or ``-``, is the person and goes,
  where the neutral is among them and what is left of each has a letter.
- A name is that of a file, too: case and a last dot do not tell two apart, and those that Windows
  keeps for devices (``nul``, ``com1``) are none.
"""

from __future__ import annotations

import os
import re
import unicodedata
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from myoface.errors import ApiError
from myoface.roles import OWN_FORMATS, Role

BAD_NAME = "client.name"
LEGAL = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
LONGEST = 64
NEUTRAL = frozenset({"neutral", "neutre", "rest", "relaxed"})
DEVICES = frozenset(
    {"con", "prn", "aux", "nul", *(f"{port}{i}" for port in ("com", "lpt") for i in range(10))}
)
# Letters that are none with an accent
LETTERS = str.maketrans(
    {"ß": "ss", "æ": "ae", "Æ": "AE", "œ": "oe", "Œ": "OE", "ø": "o", "Ø": "O", "ł": "l", "Ł": "L"}
)


@dataclass(frozen=True)
class NamedScan:
    """A scan's file, with its name and role for the service."""

    path: Path
    name: str
    role: Role


def name_scans(
    paths: Sequence[Path],
    *,
    names: Sequence[str | None] | None = None,
    roles: Sequence[Role | None] | None = None,
    option: str | None = "--name",
) -> list[NamedScan]:
    """Return files with the names and roles that they have for the service.

    ``names`` and ``roles`` are those that are given, None where the file says it; ``option`` is
    what a command line gives a name by, None where it cannot.

    Raises
    ------
    ApiError
        With ``client.name`` if a file has no name, two have the same, or two are the neutral.
    """
    by_file = by_files([path.name for path in paths], roles)
    given = names or [None] * len(paths)
    found = [
        NamedScan(path, name if own is None else as_name(own), role)
        for path, own, (name, role) in zip(paths, given, by_file, strict=True)
    ]
    texts = [path.name if own is None else own for path, own in zip(paths, given, strict=True)]
    _require_names(found, texts, option)
    return found


def name_session(neutral: Path | None, others: Iterable[Path]) -> list[NamedScan]:
    """Return a session's scans with names and roles; ``neutral`` is its neutral, if it is given.

    It may be one of the others, too. See :func:`name_scans`.
    """
    if neutral is None:
        return name_scans(list(others))
    rest = [path for path in others if path.resolve() != neutral.resolve()]
    roles: list[Role | None] = [
        "expression" if _role(path.name) == "neutral" else None for path in rest
    ]
    return name_scans([neutral, *rest], roles=["neutral", *roles])


def same_file(name: str) -> str:
    """Return what names have in common that are one file on some system."""
    return name.casefold().rstrip(".")


def is_device(name: str) -> bool:
    """Return True if Windows has a device of this name, whatever follows its first dot."""
    return name.partition(".")[0].casefold() in DEVICES


def by_files(
    files: Sequence[str], given: Sequence[Role | None] | None = None
) -> list[tuple[str, Role]]:
    """Return name and role by the files' names, and by the roles that are ``given``.

    A name that cannot be made of a file's is empty.
    """
    stems = [_split(file)[0] for file in files]
    roles = [
        role or _role(file) for file, role in zip(files, given or [None] * len(files), strict=True)
    ]
    start = _length_of_person(stems) if "neutral" in roles else 0
    return [(as_name(stem[start:]), role) for stem, role in zip(stems, roles, strict=True)]


def as_name(text: str) -> str:
    """Return text as a name for the service; empty if there is no letter or digit, or a device."""
    if is_device(text):
        return ""
    if LEGAL.fullmatch(text) and not text.endswith("."):
        return text
    name = re.sub(r"[^A-Za-z0-9_.-]+", "_", _plain(text))
    name = re.sub(r"^[^A-Za-z0-9]+|[^A-Za-z0-9]+$", "", name)[:LONGEST].rstrip(".")
    return "" if is_device(name) else name


def why_no_name(text: str) -> str:
    """Return words on why :func:`as_name` makes no name of text, or of a file's name."""
    if re.search("[A-Za-z0-9]", _plain(_split(text)[0])):
        return f"{text!r} is a device's name on Windows, and no file's"
    return f"no name can be made of {text!r}, which has no letter of a to z and no digit"


def _role(file: str) -> Role:
    stem, suffix = _split(file)
    if suffix in OWN_FORMATS:
        return OWN_FORMATS[suffix]
    words = re.sub(r"([a-z])([A-Z])", r"\1 \2", _plain(stem)).lower()
    return "neutral" if NEUTRAL & set(re.split(r"[^a-z]+", words)) else "expression"


def _length_of_person(stems: Sequence[str]) -> int:
    """Return how much of each is the person: nothing of a single one."""
    if len(stems) < 2:
        return 0
    common = os.path.commonprefix(list(stems))  # noqa: RUF071  # of texts, not of paths
    part = re.match(r".*[ _-]", common, re.DOTALL)
    length = len(part[0]) if part else 0
    keep_letters = all(re.search("[A-Za-z]", as_name(stem[length:])) for stem in stems)
    return length if keep_letters else 0


def _plain(text: str) -> str:
    """Return text without accents."""
    parts = unicodedata.normalize("NFKD", text.translate(LETTERS))
    return re.sub("[\u0300-\u036f]", "", parts)


def _split(file: str) -> tuple[str, str]:
    """Return a file's name without its ending, and the ending in small letters."""
    dot = file.rfind(".")
    return (file[:dot], file[dot:].lower()) if dot > 0 else (file, "")


def _require_names(scans: Sequence[NamedScan], texts: Sequence[str], option: str | None) -> None:
    """Refuse scans without a name of their own; ``texts`` are what the names are made of."""
    another = f", or give it another name ({option})" if option else ""
    apart = f", or send it by itself with another name ({option})" if option else ""
    taken: dict[str, Path] = {}
    neutral: Path | None = None
    for scan, text in zip(scans, texts, strict=True):
        if not scan.name:
            _refuse(scan.path, f"{why_no_name(text)}: rename it{another}")
        # Two that differ in case alone are one morph target to many programs, and one file to some
        other = taken.setdefault(same_file(scan.name), scan.path)
        if other is not scan.path:
            _refuse(
                scan.path,
                f"{other.name!r} and {scan.path.name!r} would both be called {scan.name}: rename "
                f"one{apart}",
            )
        if scan.role == "neutral":
            if neutral is not None:
                _refuse(
                    scan.path,
                    f"{neutral.name!r} and {scan.path.name!r} both are neutrals by name, and "
                    "a person has one: leave one out, or send it by itself (--role expression)",
                )
            neutral = scan.path


def _refuse(path: Path, detail: str) -> None:
    raise ApiError({"code": BAD_NAME, "detail": detail, "file": path.name})
