"""Whom a scene is about: the files of a fitted person, and what is in them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import scipy.sparse as sp

from solver.model import SubjectModel
from solver.pipeline.common import activations_file
from solver.progress import Progress, Step
from solver.rig.result import ExpressionFit, load_activations, load_weights
from solver.scene.places import Places


@dataclass(frozen=True)
class Person:
    """A fitted face with its S (n, m + 1), and the places on it."""

    model: SubjectModel
    S: sp.csr_array
    places: Places


@dataclass(frozen=True)
class PersonFiles:
    """The files that every job with a scene reads.

    model, weights
        ``model.npz``, and the rig's ``muscle_weights.npz``.
    rig
        The rig's ``activations.npz``, or its folder: the expressions.
    assets
        Name -> file, what the scene names.
    template
        The template that the model was made with, None for the built-in one: the scene may name
        its landmarks.
    """

    model: Path
    weights: Path
    rig: Path
    assets: Mapping[str, Path] = field(default_factory=dict)
    template: Path | None = None

    def read(self, progress: Progress) -> Person:
        """Return the person; raises as its files' readers, and ``scene.template``."""
        progress(Step("read", 0.0, message=self.model.name))
        model = SubjectModel.load(self.model)
        S = load_weights(self.weights, model)
        return Person(model, S, Places.of(model, self.template, self.assets))

    def expressions(self, model: SubjectModel) -> tuple[ExpressionFit, ...]:
        """Return the rig's expressions; raises as :func:`load_activations`."""
        return load_activations(activations_file(self.rig), model)

    def fingerprint(self, document: Mapping[str, Any], **more: Path | None) -> str:
        """Return the hash of a scene and of all files, ``more`` too, that it is played with."""
        files = {
            "model": self.model,
            "weights": self.weights,
            "rig": activations_file(self.rig),
            "template": self.template,
            **more,
            **{f"asset {name}": path for name, path in self.assets.items()},
        }
        hashes = {name: _hash(path) for name, path in files.items() if path is not None}
        return hashlib.sha256(json.dumps([document, hashes], sort_keys=True).encode()).hexdigest()


def _hash(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
