"""Hostile NPZ and NPY files are refused in words, before they cost memory."""

from __future__ import annotations

import io
import struct
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from solver.errors import InputError
from solver.model import SubjectModel
from solver.rig import Rig
from solver.scans.performance import open_performance
from solver.storage import map_array, read_arrays
from tests.solver.block import block_model

ARRAYS = {
    "x": np.arange(12.0).reshape(3, 4),
    "names": np.array(["smile", "ah"]),
    "one": np.array(1),
}


def _npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, array)
    return stream.getvalue()


def _claims(header: str, size: int = 0) -> bytes:
    """Return an NPY with such a header and ``size`` bytes of values."""
    text = header.encode().ljust(118 - 1) + b"\n"
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(text)) + text + bytes(size)


def _zip(path: Path, *members: tuple[str, bytes], packed: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", packed) as archive:
        for name, content in members:
            archive.writestr(name, content)
    return path


def test_what_numpy_wrote_is_read(tmp_path: Path) -> None:
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "a.npz", **ARRAYS)
        read = read_arrays(tmp_path / "a.npz")
        assert list(read) == list(ARRAYS)
        for name, array in ARRAYS.items():
            np.testing.assert_array_equal(read[name], array)
            assert read[name].dtype == array.dtype
    np.save(tmp_path / "a.npy", np.asfortranarray(ARRAYS["x"]))
    np.testing.assert_array_equal(map_array(tmp_path / "a.npy"), ARRAYS["x"])


CLAIM = "{{'descr': {}, 'fortran_order': False, 'shape': {}, }}"
HOSTILE_ARRAYS = {
    "more values than bytes": _claims(CLAIM.format("'<f8'", "(10, 10)"), 16),
    "fewer values than bytes": _claims(CLAIM.format("'<f8'", "(1,)"), 16),
    "as many as there are atoms": _claims(CLAIM.format("'<f8'", f"({10**40}, 3)"), 16),
    "a negative shape": _claims(CLAIM.format("'<f8'", "(-2, -1)"), 16),
    "an empty shape too large": _claims(CLAIM.format("'<f8'", f"(0, {10**40})")),
    "a shape that is none": _claims(CLAIM.format("'<f8'", "3"), 24),
    "text of no length": _claims(CLAIM.format("'<U0'", "(1000000000000,)")),
    "objects": _claims(CLAIM.format("'|O'", "(1,)"), 8),
    "a record": _claims(CLAIM.format("[('a', '<f8')]", "(1,)"), 8),
    "an array of arrays": _claims(CLAIM.format("('<f8', (9,))", "(1,)"), 72),
    "complex numbers": _npy(np.zeros(2, complex)),
    "times": _npy(np.zeros(2, "M8[s]")),
    "a header that nests": _claims("-" * 110 + "1"),
    "a header that calls": _claims("__import__('os').system('true')"),
    "a longer header than there is": b"\x93NUMPY\1\0\xff\xff{}",
    "a header of four gigabytes": b"\x93NUMPY\2\0\xff\xff\xff\xff{}",
    "version 3": b"\x93NUMPY\3\0" + bytes(100),
    "nothing": b"",
    "a picture": b"\x89PNG\r\n\x1a\n" + bytes(100),
}


@pytest.mark.parametrize("content", HOSTILE_ARRAYS.values(), ids=HOSTILE_ARRAYS)
def test_an_array_that_is_none_is_refused(content: bytes, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"."):
        read_arrays(_zip(tmp_path / "a.npz", ("x.npy", content)))
    (tmp_path / "a.npy").write_bytes(content)
    with pytest.raises(ValueError, match=r"."):
        map_array(tmp_path / "a.npy")


def test_members_that_do_not_belong_there_are_refused(tmp_path: Path) -> None:
    one = _npy(np.arange(3))
    path = tmp_path / "a.npz"
    with pytest.raises(ValueError, match="no array"):
        read_arrays(_zip(path, ("x.npy", one), ("../run.py", b"")))
    with pytest.warns(UserWarning, match="Duplicate"):
        _zip(path, ("x.npy", one), ("x.npy", one))
    with pytest.raises(ValueError, match="twice"):
        read_arrays(path)
    with pytest.raises(ValueError, match="another way"):
        read_arrays(_zip(path, ("x.npy", one), packed=zipfile.ZIP_LZMA))


def test_a_size_that_is_a_lie_is_refused(tmp_path: Path) -> None:
    """The directory and the array's header agree, the packed values are fewer or more."""
    path = _zip(tmp_path / "a.npz", ("x.npy", _claims(CLAIM.format("'<f8'", "(2,)"), 16)))
    content = bytearray(path.read_bytes())
    size = struct.pack("<L", 128 + 16)
    assert content.count(size) == 2
    for values in (1, 1000):
        lying = _claims(CLAIM.format("'<f8'", f"({values},)"), 16)
        _zip(path, ("x.npy", lying))
        claimed = struct.pack("<L", 128 + 8 * values)
        path.write_bytes(path.read_bytes().replace(size, claimed))
        with pytest.raises(ValueError, match=r"."):
            read_arrays(path)


@pytest.mark.parametrize("cut", [0, 10, 100, 400, -1])
def test_a_truncated_file_is_refused(cut: int, tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, **ARRAYS)
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(ValueError, match=r"."):
        read_arrays(path)


def test_a_flipped_byte_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez_compressed(path, x=np.random.default_rng(3).normal(size=1000))
    content = bytearray(path.read_bytes())
    content[4000] ^= 1
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"CRC|decompress"):
        read_arrays(path)


def test_bombs_cost_no_memory(tmp_path: Path) -> None:
    """A child with little memory refuses what unpacks to gigabytes, or lists a million members."""
    big = 3 << 30
    header = _claims(CLAIM.format("'|u1'", f"({big},)"))
    with (
        zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file,
        file.open(zipfile.ZipInfo("x.npy"), "w", force_zip64=True) as member,
    ):
        member.write(header)
        for _ in range(8):
            member.write(bytes(1 << 20))
    entry = struct.pack("<4s6H3L5H2L", b"PK\1\2", 20, 20, 0, 0, 0, 0, 0, 0, 0, 5, 0, 0, 0, 0, 0, 0)
    directory = (entry + b"x.npy") * 1_000_000
    end = struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 1, 1, len(directory), 0, 0)
    (tmp_path / "many.npz").write_bytes(directory + end)
    program = (
        "import sys, resource; from pathlib import Path; from solver.storage import read_arrays\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "for path in map(Path, sys.argv[1:]):\n"
        "    try:\n"
        "        read_arrays(path)\n"
        "    except ValueError as error:\n"
        "        print(path.name, error)\n"
        "print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)\n"
    )
    files = [str(tmp_path / name) for name in ("bomb.npz", "many.npz")]
    child = subprocess.run(
        [sys.executable, "-c", program, *files],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
        cwd=Path(__file__).parents[2],
    )
    bomb, many, grown = child.stdout.splitlines()
    assert bomb.startswith("bomb.npz x.npy: it has 8388736 bytes")
    assert many == "many.npz it lists too many members"
    assert int(grown) < 20


def test_an_honest_bomb_is_too_large(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "a.npz", x=np.zeros(1_000_000), y=np.zeros(1_000_000))
    assert (tmp_path / "a.npz").stat().st_size < 20_000
    with pytest.raises(ValueError, match="unpacks to 160"):
        read_arrays(tmp_path / "a.npz", most_bytes=10_000_000)


def test_callers_name_the_file(tmp_path: Path) -> None:
    model = block_model()
    zipped = tmp_path / "take.npy"
    plain = tmp_path / "a.npz"
    np.savez(tmp_path / "b.npz", x=np.zeros((2, 3)))
    zipped.write_bytes((tmp_path / "b.npz").read_bytes())
    np.save(tmp_path / "c.npy", np.zeros((2, 3)))
    plain.write_bytes((tmp_path / "c.npy").read_bytes())
    face = np.arange(3)
    cases = {
        "performance.unreadable": lambda: open_performance(zipped, model.skin, face),
        "model.unreadable": lambda: SubjectModel.load(plain),
        "rig.unreadable": lambda: Rig.load(plain),
    }
    for code, read in cases.items():
        with pytest.raises(InputError) as caught:
            read()
        assert caught.value.code == code
        assert caught.value.context["file"] == ("take.npy" if "perf" in code else "a.npz")


def test_nothing_else_in_the_solver_reads_arrays() -> None:
    """The mesher's child and its parent write to each other; all other files may be anybody's."""
    solver = Path(__file__).parents[2] / "solver"
    readers = [path.name for path in solver.rglob("*.py") if "np.load(" in path.read_text()]
    assert readers == ["tetrahedra.py"]


def test_arrays_are_read_by_their_names(tmp_path: Path) -> None:
    """A long take's skins may be more than is read, what was played of it is not."""
    path = tmp_path / "animation.npz"
    np.savez(path, skin=np.zeros(4096), weights=np.arange(3.0))
    found = read_arrays(path, most_bytes=2000, names=("weights",))
    assert found.keys() == {"weights"}
    np.testing.assert_array_equal(found["weights"], np.arange(3.0))
    with pytest.raises(ValueError, match="unpack"):
        read_arrays(path, most_bytes=2000)
