"""Scans packed with their images: by the client, and by the page in the same bytes."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from zipfile import ZipFile

import pytest

from myoface.client.scan_packing import with_images

PAGE = Path(__file__).parents[2] / "service/page/static/js/scan_zip.js"

IN_NODE = """
import { readFileSync, writeFileSync } from "node:fs";
import { File } from "node:buffer";
globalThis.File = File;
const { imagesOf, packed } = await import("./scan_zip.mjs");
const [names, target] = process.argv.slice(1).map(JSON.parse);
const [scan, ...others] = names.map((name) => new File([readFileSync(name)], name));
const whole = await packed(scan, await imagesOf(scan, others));
writeFileSync(target, Buffer.from(await whole.arrayBuffer()));
"""


def scan_of(folder: Path) -> Path:
    """Write an OBJ with two materials, one image with a blank in its name, and a stranger's."""
    scan = folder / "Zoë.obj"
    scan.write_text("mtllib ./head skin.mtl\nmtllib lost.mtl\nv 0 0 0\n")
    lines = ["newmtl a", "map_Kd -clamp on my skin.png", "newmtl b", "\tmap_kd é.jpg"]
    lines += ["newmtl c", "map_Kd ../../secret.png", "newmtl d", "map_Kd skin.png"]
    lines += ["newmtl e", "map_Kd body.<UDIM>.png"]
    (folder / "head skin.mtl").write_text("\n".join(lines))
    tiles = ("body.1001.png", "body.1012.png")
    for name in ("my skin.png", "é.jpg", "other.png", "other.1001.png", *tiles):
        (folder / name).write_bytes(name.encode() * 1000)
    (folder.parent / "secret.png").write_bytes(b"not the scan's")
    return scan


def ply_of(folder: Path) -> Path:
    """Write a PLY with two images beside it."""
    scan = folder / "head.ply"
    names = ["my skin.png", "é.jpg", "gone.png"]
    comments = "".join(f"comment TextureFile {name}\n" for name in names)
    scan.write_text(f"ply\nformat ascii 1.0\n{comments}end_header\n")
    for name in names[:2]:
        (folder / name).write_bytes(name.encode() * 1000)
    return scan


def test_a_ply_goes_with_the_images_that_its_comments_name(tmp_path: Path) -> None:
    packed = with_images(ply_of(tmp_path), tmp_path)
    with ZipFile(packed) as archive:
        assert archive.namelist() == ["head.ply", "my skin.png", "é.jpg"]


def test_an_obj_goes_with_what_it_names_beside_it(tmp_path: Path) -> None:
    folder = tmp_path / "scans"
    folder.mkdir()
    scan = scan_of(folder)
    packed = with_images(scan, tmp_path)
    assert packed == tmp_path / "Zoë.zip"
    with ZipFile(packed) as archive:
        assert archive.testzip() is None
        assert archive.namelist() == [
            *("Zoë.obj", "body.1001.png", "body.1012.png"),
            *("head skin.mtl", "my skin.png", "é.jpg"),
        ]
        assert archive.read("my skin.png") == (folder / "my skin.png").read_bytes()
    before = packed.read_bytes()
    assert with_images(scan, tmp_path).read_bytes() == before


def test_a_scan_without_images_stays_what_it_is(tmp_path: Path) -> None:
    alone = tmp_path / "alone.obj"
    alone.write_text("mtllib gone.mtl\nmtllib alone.obj\nv 0 0 0\n")
    assert with_images(alone, tmp_path) == alone
    ply = tmp_path / "face.ply"
    ply.write_text("ply\n")
    assert with_images(ply, tmp_path) == ply


@pytest.mark.parametrize("make", [scan_of, ply_of])
def test_the_page_packs_the_same_bytes(make: Callable[[Path], Path], tmp_path: Path) -> None:
    node = shutil.which("node")
    if node is None:
        pytest.skip("there is no node here")
    folder = tmp_path / "scans"
    folder.mkdir()
    scan = make(folder)
    shutil.copy(PAGE, folder / "scan_zip.mjs")
    others = [path.name for path in folder.iterdir() if path not in (scan, folder / "scan_zip.mjs")]
    target = tmp_path / "page.zip"
    words = [json.dumps([scan.name, *sorted(others)]), json.dumps(str(target))]
    command = [node, "--input-type=module", "-e", IN_NODE, *words]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert target.read_bytes() == with_images(scan, tmp_path).read_bytes()
