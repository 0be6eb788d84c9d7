"""A subject model on disk: it comes back whole, and what is none is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from solver.errors import InputError
from solver.model import SubjectModel
from tests.solver.block import block_model


def test_a_model_comes_back_as_it_was(tmp_path: Path) -> None:
    model = block_model()
    model.save(tmp_path / "model.npz")
    found = SubjectModel.load(tmp_path / "model.npz")
    assert found.muscle_names == model.muscle_names
    for field in ("rest", "tets", "cranium", "mandible", "embedded", "offset", "face"):
        np.testing.assert_array_equal(getattr(found, field), getattr(model, field))
    for field in ("weights", "embedding"):
        kept, read = getattr(model, field), getattr(found, field)
        np.testing.assert_array_equal(read.indices, kept.indices)
        np.testing.assert_array_equal(read.data, kept.data)


@pytest.mark.parametrize("content", ["nothing", "text", "cut zip", "array", "other header"])
def test_what_is_no_model_is_refused(content: str, tmp_path: Path) -> None:
    path = tmp_path / "model.npz"
    with path.open("wb") as stream:
        if content == "array":
            np.save(stream, np.zeros(3))
        elif content == "other header":
            np.savez(stream, header=np.frombuffer(b"[1]", np.uint8))
        else:
            stream.write({"nothing": b"", "text": b"v 0 0 0", "cut zip": b"PK\3\4cut"}[content])
    with pytest.raises(InputError) as caught:
        SubjectModel.load(path)
    assert caught.value.code == "model.unreadable"
    assert caught.value.context["file"] == "model.npz"
