"""Elements of an XML file of a stranger: bounded, with their lines, and without any entity.

The standard library's trees do not tell lines, and expand entities. Here a document type refuses
the file before anything of it is expanded or fetched.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

import numpy as np

from solver.errors import InputError, file_error, quote
from solver.surface import Floats

CODE = "neck.osim"
MOST = 1e9  # that any number is, in units of the file


@dataclass(frozen=True)
class XmlLimits:
    """How much of a file is read."""

    bytes: int = 20 << 20  # of the file
    elements: int = 400_000
    depth: int = 60  # of elements within each other


@dataclass
class Element:
    """An element: its ``tag``, ``name`` attribute, ``line``, text and children."""

    file: str
    tag: str
    name: str
    line: int
    text: str = ""
    children: list[Element] = field(default_factory=list)

    def __iter__(self) -> Iterator[Element]:
        return iter(self.children)

    def all(self) -> Iterator[Element]:
        """Return the element and all in it, parents first."""
        waiting = [self]
        while waiting:
            found = waiting.pop()
            yield found
            waiting += reversed(found.children)

    def find(self, path: str) -> Element | None:
        """Return the first child, or that of a child (``a/b``), with these tags."""
        found: Element | None = self
        for tag in path.split("/"):
            inside = [] if found is None else found.children
            found = next((each for each in inside if each.tag == tag), None)
        return found

    def need(self, path: str) -> Element:
        """Return what :meth:`find` does; raises ``neck.osim`` where there is none."""
        found = self.find(path)
        if found is None:
            raise self.error(f"has no {path}")
        return found

    def word(self, path: str, default: str = "") -> str:
        """Return the text of a child, without blanks around it."""
        found = self.find(path)
        return default if found is None else found.text.strip()

    def numbers(self, path: str, count: int | None, default: Floats | None = None) -> Floats:
        """Return a child's numbers, ``count`` of them; raises ``neck.osim``."""
        found = self.find(path)
        if found is None and default is not None:
            return default
        found = self.need(path)
        try:
            values = np.array(found.text.split(), dtype=np.float64)
        except ValueError:
            raise found.error(f"is '{quote(found.text.strip())}', not numbers") from None
        if count is not None and len(values) != count:
            raise found.error(f"has {len(values)} numbers, not {count}")
        if not (np.abs(values) <= MOST).all():
            raise found.error("has a number without sense")
        return values

    def number(self, path: str, default: float | None = None) -> float:
        """Return the one number of a child; raises ``neck.osim``."""
        return float(self.numbers(path, 1, None if default is None else np.array([default]))[0])

    def error(self, reason: str) -> InputError:
        """Return the error ``neck.osim`` about this element, with its line."""
        named = f"{self.tag} '{quote(self.name)}'" if self.name else self.tag
        where = {"line": self.line, "element": quote(self.name or self.tag)}
        return file_error(CODE, self.file, f"{named} {reason}", **where)


def read_elements(path: Path, limits: XmlLimits = XmlLimits()) -> Element:
    """Return the root element of a file.

    Raises ``neck.osim``, with the line, for a file that is too large, no XML, or has a document
    type, where entities are declared.
    """
    try:
        size = path.stat().st_size
        if size > limits.bytes:
            most = f"{limits.bytes >> 20} MB are read"
            raise file_error(CODE, path.name, f"it has {size >> 20} MB; at most {most}")
        content = path.read_bytes()
    except OSError as error:
        raise file_error(CODE, path.name, f"it cannot be read: {error.strerror}") from error
    return _Reader(path.name, limits).read(content)


class _Reader:
    def __init__(self, file: str, limits: XmlLimits) -> None:
        self.file = file
        self.limits = limits
        self.count = 0
        self.root = Element(file, "", "", 0)
        self.open = [self.root]
        self.texts: list[list[str]] = [[]]  # of those that are open, in pieces
        self.parser = expat.ParserCreate()
        self.parser.SetParamEntityParsing(expat.XML_PARAM_ENTITY_PARSING_NEVER)
        self.parser.buffer_text = True
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self.parser.CharacterDataHandler = self._text
        self.parser.StartDoctypeDeclHandler = self._document_type

    def read(self, content: bytes) -> Element:
        try:
            self.parser.Parse(content, True)
        except expat.ExpatError as error:
            reason = f"it is no XML: {expat.ErrorString(error.code)}"
            raise file_error(CODE, self.file, reason, line=error.lineno) from error
        except (LookupError, ValueError) as error:  # an encoding that Python does not know
            reason = f"it is no XML: {quote(error)}"
            raise file_error(CODE, self.file, reason, line=1) from error
        return self.root.children[0]

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        line = self.parser.CurrentLineNumber
        element = Element(self.file, tag, attributes.get("name", ""), line)
        self.count += 1
        if self.count > self.limits.elements:
            raise element.error(f"is one more than the {self.limits.elements} that are read")
        if len(self.open) > self.limits.depth:
            raise element.error(f"is more than {self.limits.depth} elements deep")
        self.open[-1].children.append(element)
        self.open.append(element)
        self.texts.append([])

    def _end(self, _tag: str) -> None:
        self.open.pop().text = "".join(self.texts.pop())

    def _text(self, text: str) -> None:
        self.texts[-1].append(text)

    def _document_type(self, name: str, *_: object) -> None:
        reason = f"a document type ('{quote(name)}') and its entities are not read"
        raise file_error(CODE, self.file, reason, line=self.parser.CurrentLineNumber)
