"""What a check found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Verdict = Literal["ok", "warning", "fault"]


@dataclass(frozen=True)
class Finding:
    """One check's outcome; ``advice`` says what to do where it is not ok."""

    subject: str
    verdict: Verdict
    found: str
    advice: str = ""
