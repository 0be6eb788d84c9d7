"""The files of a rig that nobody fitted."""

import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path

from tests.standin.orders import orders_of

# names of the files that a rig of 0.1 is read from, by role
OLD_FILES = {"model": "model.npz", "weights": "muscle_weights.npz", "rig": "activations.npz"}


def read_rig(inputs: Mapping[str, Path]) -> list[str]:
    """Return the names of a rig's expressions, of its one file or one of 0.1."""
    if "weights" in inputs:
        assert {role: inputs[role].name for role in OLD_FILES} == OLD_FILES
    else:
        assert inputs["rig"].name == "rig.npz"
        assert "model" not in inputs
    names: list[str] = json.loads(inputs["rig"].read_text())
    return names


def leave_rig(out: Path, captures: Mapping[str, Path], carried: Iterable[str] = ()) -> None:
    """Write a rig with the expressions that are carried over and those of the captures."""
    expressions = [*carried, *captures]
    (out / "rig.glb").write_bytes(b"glTF" + os.urandom(4096))
    (out / "rig.npz").write_text(json.dumps(expressions))
    (out / "activations.npz").write_bytes(b"a")
    (out / "muscle_weights.npz").write_bytes(b"S")
    report = {"expressions": {name: {} for name in expressions}, "train_mean_mm": 0.4}
    if any("view" in orders_of(scan) for scan in captures.values()):
        from tests.browser.sample_rig import write_sample  # needs seconds, so only here

        report |= write_sample(out).summary()
    (out / "report.json").write_text(json.dumps(report))
    (out / "report.html").write_text("<!doctype html><title>Report</title><h1>Report</h1>")
