"""The kinds of job: one JSON file each, with what it reads and the JSON Schema of its options.

``scenes/definitions.json`` is what their scenes are made of, copied from the solver.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from importlib import resources
from typing import Any, Literal

from jsonschema import Draft202012Validator

Read = Literal[
    "capture",
    "neutral",
    "captures",
    "performance",
    "template",
    "model",
    "rig",
    "assets",
    "blendshapes",
]


@dataclass(frozen=True)
class Kind:
    """A kind of job.

    ``reads`` names the inputs that are looked up at submission: ``capture`` is one scan as it was
    uploaded, with its landmarks; ``neutral`` and ``captures`` are registered scans, the subject's
    neutral and chosen expressions; ``performance`` is one capture of that role, ``assets`` any
    number of theirs; ``blendshapes`` are those that an earlier job of the rig solved. ``options``
    is a JSON Schema and ``queue`` the Celery queue.
    """

    kind: str
    title: str
    description: str
    queue: str
    reads: list[Read]
    leaves: Literal[
        "check", "registration", "model", "rig", "sequence", "preview", "animation", "edit"
    ]
    options: dict[str, Any]

    def faults(self, options: dict[str, Any]) -> list[dict[str, str]]:
        """Return what is wrong with ``options``: where (a JSON path) and a sentence."""
        known = self.options["properties"]
        message = f"{self.kind} has no such option; it has {', '.join(known)}"
        strangers = [
            {"where": f"options.{name}", "message": message}
            for name in sorted(options.keys() - known.keys())
        ]
        errors = Draft202012Validator({**self.options, "additionalProperties": True})
        return strangers + [
            {"where": error.json_path.replace("$", "options", 1), "message": error.message}
            for error in sorted(errors.iter_errors(options), key=lambda error: error.json_path)
        ]


def _load() -> dict[str, Kind]:
    files = sorted(resources.files(__name__).iterdir(), key=lambda file: file.name)
    kinds = [Kind(**json.loads(file.read_text())) for file in files if file.name.endswith(".json")]
    for kind in kinds:
        if "scene" in kind.options["properties"]:
            kind.options["$defs"] = _definitions()
    return {kind.kind: kind for kind in kinds}


def _definitions() -> dict[str, Any]:
    file = resources.files(__name__).joinpath("scenes", "definitions.json")
    found: dict[str, Any] = json.loads(file.read_text())
    return found


KINDS = _load()
