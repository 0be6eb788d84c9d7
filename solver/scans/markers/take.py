"""A take: labelled points over time, as an optical system or a tracker of video leaves them."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from solver.errors import Finding
from solver.storage import Archive
from solver.surface import Floats

FORMAT = 1


@dataclass(frozen=True)
class Event:
    """Something that the file marks in time."""

    name: str
    time: float  # s after the first frame


@dataclass(frozen=True)
class Take:
    """Positions of labelled points in the axes of the file, in mm, NaN where one is missing.

    k labels, f frames, u tracks that have no label and may be any marker.
    """

    file: str
    labels: tuple[str, ...]  # (k,), without blanks and without a subject's prefix
    positions: Floats  # (f, k, 3)
    rate: float  # frames a second; NaN where the file does not say
    first: int = 1  # number of the first frame
    unit_mm: float = 1.0  # mm a unit of the file: positions are multiplied by it
    sigma: Floats | None = None  # (f, k, 3) standard deviations in mm, where the file has them
    residual: Floats | None = None  # (f, k) of the system's triangulation in mm, NaN if unknown
    unlabelled: Floats = field(default_factory=lambda: np.zeros((0, 0, 3)))  # (f, u, 3)
    unlabelled_names: tuple[str, ...] = ()  # (u,)
    subject: str = ""  # the prefix that all labels had
    up: str | None = None  # the axis that the file says is up, as "y" or "-z"
    events: tuple[Event, ...] = ()
    findings: tuple[Finding, ...] = ()  # what reading it found

    def __post_init__(self) -> None:
        if not self.unlabelled_names:
            object.__setattr__(self, "unlabelled", np.zeros((len(self.positions), 0, 3)))

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def missing(self) -> np.ndarray:
        """Return which points of which frames are missing (f, k)."""
        return np.asarray(np.isnan(self.positions[..., 0]))

    @property
    def seconds(self) -> float:
        """Return how long the take is; NaN where the rate is not known."""
        return len(self.positions) / self.rate

    def save(self, path: Path) -> None:
        """Write the take as NPZ."""
        header = {
            "format": FORMAT,
            "file": self.file,
            "labels": list(self.labels),
            "rate": None if np.isnan(self.rate) else self.rate,
            "first": self.first,
            "unit_mm": self.unit_mm,
            "unlabelled_names": list(self.unlabelled_names),
            "subject": self.subject,
            "up": self.up,
            "events": [asdict(event) for event in self.events],
            "findings": [finding.to_dict() for finding in self.findings],
        }
        arrays = {"positions": self.positions, "unlabelled": self.unlabelled}
        further = {"sigma": self.sigma, "residual": self.residual}
        arrays |= {name: values for name, values in further.items() if values is not None}
        Archive(header, arrays).write(path)

    @classmethod
    def load(cls, path: Path) -> Take:
        """Read a take that :meth:`save` wrote.

        Raises :class:`InputError`: ``markers.unreadable`` or ``markers.format``.
        """
        archive = Archive.read(path, "markers", "a take", FORMAT)
        header, arrays = archive.header, archive.arrays
        rate = header["rate"]
        return cls(
            header["file"],
            tuple(header["labels"]),
            arrays["positions"],
            float("nan") if rate is None else rate,
            header["first"],
            header["unit_mm"],
            arrays.get("sigma"),
            arrays.get("residual"),
            arrays["unlabelled"],
            tuple(header["unlabelled_names"]),
            header["subject"],
            header["up"],
            tuple(Event(**event) for event in header["events"]),
            tuple(Finding.from_dict(finding) for finding in header["findings"]),
        )
