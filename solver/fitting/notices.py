"""What a fit has to tell besides its result: things that are wrong but did not stop it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Notice:
    """One warning: a stable ``code``, one plain sentence, and figures that say where and how much.

    ``context`` holds plain JSON values; ``expression`` is among them where it is about one.
    """

    code: str
    message: str
    context: dict[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Return the notice as plain JSON values."""
        return {"code": self.code, "message": self.message, **self.context}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Notice:
        """Return the notice that :meth:`as_dict` wrote."""
        context = {key: value for key, value in values.items() if key not in ("code", "message")}
        return cls(values["code"], values["message"], context)
