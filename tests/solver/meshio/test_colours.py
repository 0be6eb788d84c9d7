"""Colours of raw scans: every way that a file may have them, and what is never opened."""

from __future__ import annotations

import io
import struct
import unicodedata
import zlib
from pathlib import Path

import numpy as np
import pygltflib as gl
import pytest
from PIL import Image

from solver.errors import InputError
from solver.meshio.colours import ScanColours, read_colours
from solver.meshio.raw import read_raw
from solver.rig.frames.gltf_buffer import Buffer

# A quarter of the image each: red, green above; blue, white below.
QUARTERS = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)
PICTURE = np.kron(QUARTERS, np.ones((8, 8, 1), np.uint8))
MIDDLE = np.array([[0.5, 0.25, 0.25]])
# A triangle whose middle is 0.25 from the left and 0.75 up: in the upper left quarter
OBJ = (
    "mtllib face.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\n"
    "vt 0.25 0.75\nvt 0.35 0.75\nvt 0.15 0.75\nusemtl skin\nf 1/1 2/2 3/3\n"
)


def png(pixels: np.ndarray, **options: object) -> bytes:
    content = io.BytesIO()
    Image.fromarray(pixels, **options).save(content, "PNG")
    return content.getvalue()


def colours(path: Path) -> ScanColours | None:
    return read_colours(path, read_raw(path))


def middle(path: Path) -> list[float]:
    """Return the colour in the middle of the first triangle."""
    found = colours(path)
    assert found is not None
    colour, known = found.at(np.zeros(1, np.int64), MIDDLE)
    assert known.all()
    return list(colour[0])


def obj(folder: Path, text: str = OBJ, mtl: str = "newmtl skin\nmap_Kd a b.png\n") -> Path:
    (folder / "a b.png").write_bytes(png(PICTURE))
    (folder / "face.mtl").write_text(mtl)
    path = folder / "face.obj"
    path.write_text(text)
    return path


def test_an_obj_has_the_images_of_its_materials_and_they_tile(tmp_path: Path) -> None:
    assert middle(obj(tmp_path)) == pytest.approx([1, 0, 0])
    # one image further, either way, and counted back
    moved = (
        OBJ.replace("0.75\n", "-1.25\n").replace("vt 0.", "vt 3.").replace("f 1/1 2/2 3/3\n", "")
    )
    assert middle(obj(tmp_path, moved + "f -3/-3 -2/-2 -1/-1\n")) == pytest.approx([1, 0, 0])
    # an offset in the MTL, and options before the name
    mtl = "newmtl skin\n\tmap_Kd -clamp off -o 0.5 0 0 -s 1 1 1 ./a b.png\n"
    assert middle(obj(tmp_path, mtl=mtl)) == pytest.approx([0, 1, 0])


def test_several_materials_have_an_image_each_and_some_none(tmp_path: Path) -> None:
    more = "usemtl bare\nf 1/1 2/2 3/3\nusemtl other\nf 1/1 2/2 3/3\nf 1 2 3\n"
    mtl = "newmtl skin\nmap_Kd a b.png\nnewmtl bare\nKd 1 0 0\nnewmtl other\nmap_Kd blue.png\n"
    path = obj(tmp_path, OBJ + more, mtl)
    (tmp_path / "blue.png").write_bytes(png(np.full((4, 4, 3), (0, 0, 255), np.uint8)))
    found = colours(path)
    assert found is not None
    colour, known = found.at(np.arange(4), np.repeat(MIDDLE, 4, axis=0))
    assert known.tolist() == [True, False, True, False]
    np.testing.assert_allclose(colour[[0, 2]], [[1, 0, 0], [0, 0, 1]], atol=1e-6)


def test_tiles_lie_on_their_unit_squares_and_missing_ones_are_told(tmp_path: Path) -> None:
    """Triangles in the first square, in the second of the second row, and where no tile lies."""
    rows = [(0.25, 0.75), (1.25, 1.75), (2.25, 0.75), (-0.75, 0.75)]
    text = "mtllib face.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl skin\n"
    text += "".join(f"vt {u} {v}\n" for u, v in rows)
    text += "".join(f"f 1/{k} 2/{k} 3/{k}\n" for k in range(1, len(rows) + 1))
    path = obj(tmp_path, text, "newmtl skin\nmap_Kd skin.<UDIM>.png\n")
    with pytest.raises(InputError, match=r"skin\.1001\.png") as caught:
        colours(path)
    assert caught.value.code == "texture.missing"
    (tmp_path / "skin.1001.png").write_bytes(png(PICTURE))
    (tmp_path / "skin.1012.png").write_bytes(png(PICTURE[:, ::-1].copy()))
    found = colours(path)
    assert found is not None
    colour, known = found.at(np.arange(4), np.repeat(MIDDLE, 4, axis=0))
    assert known.tolist() == [True, True, False, False]
    np.testing.assert_allclose(colour[:2], [[1, 0, 0], [0, 1, 0]])
    (told,) = found.findings
    assert told.code == "texture.missing"
    assert "skin.1003.png" in told.message


def patches(folder: Path, *, is_flipped: bool, varied: bool = True) -> Path:
    """Write a sheet of 8 x 8 squares, each in a place of its own in an image, by chance.

    The image has the sheet's colours there, which change smoothly over it if they are ``varied``.
    """
    count = 8
    rng = np.random.default_rng(3)
    order = rng.permutation(count * count)
    places = []
    pixels = np.zeros((count * 16, count * 16, 3), np.uint8)
    lines = ["mtllib face.mtl", "usemtl skin"]
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)])
    step = np.linspace(0.0, 1.0, 16)
    for number, place in enumerate(order):
        square = np.array(divmod(number, count))
        row, column = divmod(int(place), count)
        x, y = ((square[k] + step) / count for k in (0, 1))
        tile = np.stack(np.meshgrid(x, 1.0 - y, [0.0], indexing="ij"), axis=-1)[:, :, 0]
        if not varied:
            tile[:] = 0.5
        turned = tile.swapaxes(0, 1)[::-1]  # v goes up
        block = slice(16 * row, 16 * row + 16), slice(16 * column, 16 * column + 16)
        pixels[block] = np.round(255 * turned)
        inside = 0.03 + 0.94 * corners
        u = (column + inside[:, 0]) / count
        v = (count - 1 - row + inside[:, 1]) / count
        places += [(a, 1.0 - b if is_flipped else b) for a, b in zip(u, v, strict=True)]
        lines += [f"v {a} {b} 0" for a, b in square + corners]
    lines += [f"vt {a:.5f} {b:.5f}" for a, b in places]
    for number in range(count * count):
        first = 4 * number + 1
        lines.append("f " + " ".join(f"{first + k}/{first + k}" for k in range(4)))
    path = obj(folder, "\n".join(lines) + "\n", "newmtl skin\nmap_Kd skin.png\n")
    (folder / "skin.png").write_bytes(png(pixels))
    return path


@pytest.mark.parametrize("is_flipped", [False, True])
def test_coordinates_that_are_upside_down_are_found_by_the_seams(
    tmp_path: Path, is_flipped: bool
) -> None:
    found = colours(patches(tmp_path, is_flipped=is_flipped))
    assert found is not None
    faces = np.arange(len(found.faces))
    at, known = found.at(faces, np.full((len(faces), 3), 1 / 3))
    assert known.all()
    middle = found.vertices[found.faces].mean(axis=1) / 8
    wanted = np.column_stack([middle[:, 0], 1.0 - middle[:, 1], np.zeros(len(faces))])
    assert np.abs(at - wanted).max() < 0.05
    assert [each.code for each in found.findings] == ["texture.flipped"] * is_flipped
    # of an image that looks alike either way, the standard is taken
    plain = colours(patches(tmp_path, is_flipped=is_flipped, varied=False))
    assert plain is not None
    assert not plain.findings


@pytest.mark.parametrize(
    ("name", "code"),
    [
        ("/etc/passwd", "texture.path"),
        ("../secret.png", "texture.path"),
        ("C:\\scans\\skin.png", "texture.path"),
        ("folder/skin.png", "texture.path"),
        ("..", "texture.path"),
        ("a c.png", "texture.missing"),
        ("face.mtl", "texture.unreadable"),
    ],
)
def test_only_images_beside_the_scan_are_opened(name: str, code: str, tmp_path: Path) -> None:
    folder = tmp_path / "scan"
    folder.mkdir()
    (tmp_path / "secret.png").write_bytes(png(PICTURE))
    with pytest.raises(InputError) as caught:
        colours(obj(folder, mtl=f"newmtl skin\nmap_Kd {name}\n"))
    assert caught.value.code == code
    assert name.split("\\")[0] in caught.value.message


@pytest.mark.parametrize(
    ("written", "lies"),
    [
        ("Skin.PNG", "skin.png"),
        (".\\skin.png", "skin.png"),
        ('"skin.png"', "skin.png"),
        (
            unicodedata.normalize("NFC", "M\u00fcller.png"),
            unicodedata.normalize("NFD", "M\u00fcller.png"),
        ),
    ],
)
def test_an_image_is_found_however_its_name_is_written(
    written: str, lies: str, tmp_path: Path
) -> None:
    path = obj(tmp_path, mtl=f"newmtl skin\nmap_Kd {written}\n")
    (tmp_path / "a b.png").rename(tmp_path / lies)
    assert colours(path) is not None
    mtl = f"newmtl skin\nmap_Kd {written}\n"
    if not mtl.isascii():  # an older program on Windows
        (tmp_path / "face.mtl").write_bytes(mtl.encode("cp1252"))
        assert colours(path) is not None


def test_links_and_mtls_elsewhere_are_not_followed(tmp_path: Path) -> None:
    path = obj(tmp_path, OBJ.replace("face.mtl", "../face.mtl"))
    with pytest.raises(InputError, match="plain name"):
        colours(path)
    path = obj(tmp_path)
    secret = tmp_path / "secret.png"
    (tmp_path / "a b.png").rename(secret)
    (tmp_path / "a b.png").symlink_to(secret)
    with pytest.raises(InputError, match="does not lie beside"):
        colours(path)


@pytest.mark.parametrize("mode", ["L", "1", "P", "CMYK", "RGBA", "I;16"])
def test_images_of_any_depth_become_colours(mode: str, tmp_path: Path) -> None:
    grey = np.full((16, 16), 255, np.uint8)
    if mode == "I;16":
        image = Image.fromarray(np.full((16, 16), 65535, np.uint16))
    else:
        image = Image.fromarray(grey).convert("RGB").convert(mode)
    path = obj(tmp_path, mtl="newmtl skin\nmap_Kd skin.img\n")
    image.save(tmp_path / "skin.img", "TIFF" if mode == "CMYK" else "PNG")
    assert middle(path) == pytest.approx([1, 1, 1], abs=0.01)


def test_where_an_image_is_transparent_there_is_no_colour(tmp_path: Path) -> None:
    path = obj(tmp_path)
    clear = np.dstack([PICTURE, np.zeros(PICTURE.shape[:2], np.uint8)])
    (tmp_path / "a b.png").write_bytes(png(clear))
    found = colours(path)
    assert found is not None
    assert not found.at(np.zeros(1, np.int64), MIDDLE)[1].any()


def test_bombs_and_damaged_images_are_refused(tmp_path: Path) -> None:
    path = obj(tmp_path)
    image = tmp_path / "a b.png"
    whole = png(PICTURE)
    huge = bytearray(whole)
    huge[16:24] = (20000).to_bytes(4, "big") * 2
    huge[29:33] = zlib.crc32(huge[12:29]).to_bytes(4, "big")
    for content in (bytes(huge), whole[: len(whole) // 2], b"", b"GIF89a"):
        image.write_bytes(content)
        with pytest.raises(InputError) as caught:
            colours(path)
        assert caught.value.code == "texture.unreadable"
        assert "a b.png" in caught.value.message


def test_vertex_colours_of_ply_and_obj(tmp_path: Path) -> None:
    for kind, most in (("uchar", 255), ("float", 1)):
        path = tmp_path / f"{kind}.ply"
        rows = "".join(f"{x} {y} 0 {most} 0 {most}\n" for x, y in ((0, 0), (1, 0), (0, 1)))
        names = "".join(f"property {kind} {name}\n" for name in ("red", "green", "blue"))
        path.write_text(
            "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
            f"property float z\n{names}element face 1\nproperty list uchar int vertex_indices\n"
            f"end_header\n{rows}3 0 1 2\n"
        )
        assert middle(path) == pytest.approx([1, 0, 1])
    path = tmp_path / "a.obj"
    path.write_text("v 0 0 0 0 1 0\nv 1 0 0 0 1 0\nv 0 1 0 0 1 0\nf 1 2 3\n")
    assert middle(path) == pytest.approx([0, 1, 0])
    # linear light, which a file cannot say of itself
    path.write_text("v 0 0 0 0.214 1 0\nv 1 0 0 0.214 1 0\nv 0 1 0 0.214 1 0\nf 1 2 3\n")
    for space, red in (("srgb", 0.214), ("linear", 0.5)):
        found = read_colours(path, read_raw(path), space)
        assert found is not None
        colour, _ = found.at(np.zeros(1, np.int64), MIDDLE)
        assert colour[0] == pytest.approx([red, 1, 0], abs=1e-3)
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\n")
    assert colours(path) is None


def glb(path: Path, image: bytes, moved: dict[str, object] | None = None, **more: object) -> Path:
    """Write a triangle whose middle is 0.25 from the left and 0.25 down."""
    buffer = Buffer()
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float)
    places = np.array([[0.25, 0.25], [0.35, 0.25], [0.15, 0.25]])
    attributes = gl.Attributes(
        POSITION=buffer.dense(points, gl.VEC3, bounds=True),
        TEXCOORD_0=buffer.dense(places, gl.VEC2),
        COLOR_0=buffer.dense(np.full((3, 3), 0.2140), gl.VEC3),
    )
    extensions = {"KHR_texture_transform": moved} if moved else {}
    texture = gl.TextureInfo(index=0, extensions=extensions)
    surface = gl.PbrMetallicRoughness(baseColorTexture=texture if image else None, **more)
    document = gl.GLTF2(
        scene=0,
        scenes=[gl.Scene(nodes=[0])],
        nodes=[gl.Node(mesh=0)],
        meshes=[gl.Mesh(primitives=[gl.Primitive(attributes=attributes, material=0)])],
        materials=[gl.Material(pbrMetallicRoughness=surface)],
        textures=[gl.Texture(source=0)],
        images=[gl.Image(bufferView=buffer.image(image or b"none"), mimeType="image/png")],
        accessors=buffer.accessors,
        bufferViews=buffer.views,
    )
    document.buffers = [gl.Buffer(byteLength=len(buffer.content))]
    document.set_binary_blob(bytes(buffer.content))
    document.save_binary(str(path))
    return path


def test_a_glb_has_its_texture_where_its_transform_puts_it(tmp_path: Path) -> None:
    path = tmp_path / "a.glb"
    assert middle(glb(path, png(PICTURE))) == pytest.approx([1, 0, 0])
    assert middle(glb(path, png(PICTURE), {"offset": [0.5, 0.0]})) == pytest.approx([0, 1, 0])
    # a quarter turn takes (0.25, 0.25) to (0.25, -0.25), which is 0.75 down
    turned = {"rotation": np.pi / 2}
    assert middle(glb(path, png(PICTURE), turned)) == pytest.approx([0, 0, 1])
    half = {"baseColorFactor": [0.2140, 1.0, 1.0, 1.0]}
    assert middle(glb(path, png(PICTURE), **half)) == pytest.approx([0.5, 0, 0], abs=0.01)


def test_a_glb_s_vertex_colours_are_linear(tmp_path: Path) -> None:
    assert middle(glb(tmp_path / "a.glb", b"")) == pytest.approx([0.5] * 3, abs=0.001)


def test_a_glb_s_image_that_is_none_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="image 0") as caught:
        colours(glb(tmp_path / "a.glb", b"no image"))
    assert caught.value.code == "texture.unreadable"


def ply(path: Path, *, binary: bool, of_corners: bool, uneven: bool = False) -> Path:
    """Write a triangle in the upper left quarter of an image, and one in the lower right."""
    square = [(0, 0), (1, 0), (0, 1), (1, 1)]
    faces = [(0, 1, 2), (1, 3, 2), (0, 1, 3, 2)][: 3 if uneven else 2]
    middles = [(0.25, 0.75), (0.75, 0.25), (0.75, 0.25)]
    order = "binary_little_endian" if binary else "ascii"
    header = ["ply", f"format {order} 1.0", "comment TextureFile a b.png", "element vertex 4"]
    header += [f"property float {name}" for name in ("x", "y", "z", "s", "t")]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    header += ["property list uchar float texcoord"] if of_corners else []
    header += ["property int texnumber", "end_header", ""]
    body = b""
    for x, y in square:
        row = (x, y, 0, 0.25, 0.75)
        body += struct.pack("<5f", *row) if binary else f"{' '.join(map(str, row))}\n".encode()
    for corners, middle in zip(faces, middles, strict=False):
        count = len(corners)
        places = middle * count
        row = [count, *corners, *([2 * count, *places] if of_corners else []), 0]
        packing = f"<B{count}i" + (f"B{2 * count}f" if of_corners else "") + "i"
        body += struct.pack(packing, *row) if binary else f"{' '.join(map(str, row))}\n".encode()
    path.write_bytes("\n".join(header).encode() + body)
    path.with_name("a b.png").write_bytes(png(PICTURE))
    return path


@pytest.mark.parametrize("binary", [False, True])
def test_a_ply_has_the_images_that_its_comments_name(tmp_path: Path, binary: bool) -> None:
    path = tmp_path / "face.ply"
    for uneven in (False, True):
        found = colours(ply(path, binary=binary, of_corners=True, uneven=uneven))
        assert found is not None
        colour, known = found.at(np.arange(2), np.repeat(MIDDLE, 2, axis=0))
        assert known.all()
        np.testing.assert_allclose(colour, [[1, 0, 0], [1, 1, 1]])
    assert middle(ply(path, binary=binary, of_corners=False)) == pytest.approx([1, 0, 0])


def test_a_ply_whose_coordinates_are_not_its_corners_is_told(tmp_path: Path) -> None:
    path = ply(tmp_path / "face.ply", binary=False, of_corners=True)
    text = path.read_text()
    path.write_text(text.replace("6 0.25 0.75 ", "4 "))
    with pytest.raises(InputError, match="other corners") as caught:
        colours(path)
    assert caught.value.code == "texture.unreadable"
    path.with_name("a b.png").unlink()
    path.write_text(text)
    with pytest.raises(InputError, match=r"a comment of face\.ply") as caught:
        colours(path)
    assert caught.value.code == "texture.missing"
