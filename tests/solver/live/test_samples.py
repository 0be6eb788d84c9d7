"""Frames that a session has solved in full, and the session after it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from solver.errors import InputError
from solver.kinds.live_session import Source
from solver.live.checks import CheckOptions, CheckOrder, Checks, FullSolver, Sample
from solver.live.rigged import LiveFace
from solver.live.samples import FILE, MOST_SORTS, SolvedFrames, read_samples, sort_of, write_samples
from solver.live.session import LiveOptions, LiveSession
from solver.storage import Archive
from solver.surface import Floats
from tests.solver.live.live_rig import live_files


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return live_files(tmp_path_factory.mktemp("rig"))


def frames(count: int, seed: int) -> SolvedFrames:
    rng = np.random.default_rng(seed)
    return SolvedFrames(rng.normal(size=(count, 5)), rng.normal(size=(count, 3)))


def test_frames_are_read_by_their_sorts_the_newest_first(tmp_path: Path) -> None:
    by_sort = {f"sort {number}": frames(number + 1, number) for number in range(MOST_SORTS + 2)}
    write_samples(tmp_path / FILE, by_sort)
    found = read_samples(tmp_path / FILE)
    assert [*found] == [*by_sort][:MOST_SORTS]
    for sort, each in found.items():
        np.testing.assert_array_equal(each.at, by_sort[sort].at)
        np.testing.assert_array_equal(each.off, by_sort[sort].off)
        assert each.fits(5, 3)
        assert not each.fits(5, 4)


class Swollen(FullSolver):
    """Finds every frame a millimetre further out than the session has it."""

    def __init__(self, face: LiveFace) -> None:
        self._face = face

    def solve(self, sample: Sample) -> Floats:
        return self._face.skin_of(sample.plain) + 1.0


def test_a_session_begins_with_what_one_before_of_its_sort_has_solved(
    files: dict[str, Path], tmp_path: Path
) -> None:
    face = LiveFace.open(files, tmp_path)
    values = np.full(len(face.skin.names), 0.2)
    amounts = face.skin.amounts(values)
    sample = Sample(0, np.zeros((0, 3), np.float32), values, np.zeros(0), amounts, amounts)

    def checks(folder: str, source: Source, left: dict[str, SolvedFrames]) -> Checks:
        out = tmp_path / folder
        out.mkdir(exist_ok=True)
        order = CheckOrder(files, out, source, 60.0, CheckOptions(), 0, left=left)
        return Checks(face, Swollen(face), order)

    first = checks("first", "weights", {})
    assert first.known() is None
    told = first.check(sample)
    assert told.error_mm == pytest.approx(np.sqrt(3.0))
    first.keep()
    other = checks("other", "points", read_samples(tmp_path / "first" / FILE))
    assert other.known() is None
    other.keep()  # which hands them on
    known = checks("second", "weights", read_samples(tmp_path / "other" / FILE)).known()
    assert known is not None
    assert told.mend is not None
    off = known(values, np.zeros(0))
    assert np.abs(off).max() > 0.01
    np.testing.assert_array_equal(off, told.mend(values, np.zeros(0)))


def test_what_full_solves_go_by_makes_another_sort(files: dict[str, Path], tmp_path: Path) -> None:
    skin = LiveFace.open(files, tmp_path).skin
    given = {name: tmp_path / name for name in ("controls", "marker_set", "others")}
    for name, path in given.items():
        path.write_text(name)
    later = {**given, "controls": given["others"]}

    def sort(source: Source, files: dict[str, Path], *, learned: bool) -> str:
        return sort_of(skin, source, files, learned=learned)

    sources: tuple[Source, ...] = ("weights", "landmarks")
    for source in sources:
        known = {
            sort(source, given, learned=False),
            sort(source, given, learned=True),
            sort(source, later, learned=True),
        }
        assert len(known) == 3
    assert sort("points", given, learned=True) == sort("points", later, learned=False)
    markers = {**given, "marker_set": given["others"]}
    assert sort("markers", given, learned=True) == sort("markers", later, learned=True)
    assert sort("markers", given, learned=True) != sort("markers", markers, learned=True)


@pytest.mark.parametrize("spoil", ["garbage", "format", "shape", "number"])
def test_a_damaged_file_is_told_when_the_session_is_opened(
    files: dict[str, Path], tmp_path: Path, spoil: str
) -> None:
    path = tmp_path / FILE
    write_samples(path, {"a": frames(3, 1)})
    archive = Archive.read(path, "live_samples", "frames", 1)
    if spoil == "garbage":
        path.write_bytes(b"PK")
    elif spoil == "format":
        Archive({**archive.header, "format": 99}, archive.arrays).write(path)
    else:
        wrong = np.zeros((2, 3)) if spoil == "shape" else np.full((3, 3), np.nan)
        Archive(archive.header, {**archive.arrays, "off_0": wrong}).write(path)
    given = {**files, "live_samples": path}
    with pytest.raises(InputError) as caught:
        LiveSession.open(given, tmp_path, LiveOptions("weights", check_seconds=0.0))
    code = "format" if spoil == "format" else "unreadable"
    assert caught.value.code == f"live_samples.{code}"
    assert FILE in caught.value.message
