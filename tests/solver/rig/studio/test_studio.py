"""The studio's light rig: joints, parts, lids, levels of detail, and its file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, PngImagePlugin
from scipy.spatial.transform import Rotation

from solver.anatomy.texture_coordinates import NOWHERE, TextureCoordinates
from solver.animation.blendshapes import Blendshapes
from solver.animation.lids import Lids
from solver.contact.obstacles import Eyeball
from solver.drawing.head import skin_parts
from solver.errors import InputError, SolveError
from solver.fitting.drives.admissible import Admissible
from solver.fitting.face import Face, Pose
from solver.jobs.build_studio_rig import draw_shapes
from solver.mechanics.boundary import FreeJaw
from solver.mechanics.flesh import IDENTITY
from solver.meshio.colours import read_colours
from solver.meshio.raw import read_raw
from solver.registration.texture import Texture
from solver.rig import Rig
from solver.rig.frames.read_back import accessor_values, split_glb
from solver.rig.studio.glb import compare_glb, write_glb
from solver.rig.studio.levels import carry_texture, distance_mm, simplify
from solver.rig.studio.light_rig import LightRig
from solver.rig.studio.parts import TEXTURED, parts_of
from solver.rig.studio.shapes import FleshShapes, Made, MadeBy, StudioShapes, nearest
from solver.rig.studio.skeleton import HEAD, JAW, Skeleton
from solver.rig.studio.skin_texture import SkinTexture
from solver.scene.places import Places
from solver.surface import Surface
from tests.solver.block import head_block

MODEL = head_block()
OPEN = np.array([0.3, 0.0, 0.0, 0.0, -2.0])
NAMES = ("jawOpen", "mouthClose", "mouthSmileLeft")


@pytest.fixture(scope="module")
def shapes() -> StudioShapes:
    """Shapes of a block: its jaw open, closed again by the lips alone, and a bulge."""
    face = Face(MODEL)
    state = face.continuation(face.rest, Pose(np.tile(IDENTITY, (MODEL.muscle_count, 1)), OPEN))
    opened = face.whole_skin(state.x, OPEN) - MODEL.skin.vertices
    bulge = np.random.default_rng(1).normal(size=opened.shape)
    motions = np.array([opened, -0.3 * opened, bulge])
    jaw = np.array([OPEN, -0.1 * OPEN, 0.0 * OPEN])
    return StudioShapes(NAMES, motions, jaw, np.zeros((3, 2, 3)), np.zeros(3))


def test_a_shape_is_made_by_the_first_way_that_is_near_enough() -> None:
    """Muscles first, freed ones where they are too far off, whichever is nearer then."""
    tried: list[str] = []

    def way(by: MadeBy, off_mm: float | None) -> Callable[[], Made]:
        def make() -> Made:
            tried.append(by)
            if off_mm is None:
                raise SolveError("solve.no_convergence", "no rest")
            return Made(np.zeros((1, 3)), np.zeros(5), off_mm, by)

        return make

    def best(muscles: float | None, freed: float | None) -> str | None:
        tried.clear()
        made = nearest([way("muscles", muscles), way("freed muscles", freed)], 0.25)
        return made.by if made else None

    assert best(0.2, 0.1) == "muscles"
    assert tried == ["muscles"]
    assert best(0.4, 0.1) == "freed muscles"
    assert best(0.4, 0.5) == best(0.4, None) == "muscles"
    assert best(None, 0.5) == "freed muscles"
    assert best(None, None) is None


def test_freed_muscles_reach_what_living_ones_do_not() -> None:
    """A muscle that swells moves the skin; a living one keeps its volume."""
    model = MODEL
    face = Face(model)
    living = face.driven_as(Admissible())
    grown = np.tile(1.3 * IDENTITY, (model.muscle_count, 1))
    limits = living.layout.drive.feasible
    assert limits is not None
    assert (limits.margins(grown) < 0.0).any()
    points = face.face_points(face.continuation(face.rest, Pose(grown, np.zeros(5))).x)
    rig = Rig(model, model.weights, (), drive=Admissible())
    still = Blendshapes(model.muscle_names, {}, Admissible())
    flesh = FleshShapes(rig, still, Places(model, {}))
    neutral = model.skin.vertices[model.face]
    away = np.linalg.norm(points - neutral, axis=1).mean()
    reached = flesh.reach(points).skin[model.face]
    assert away > 0.1
    assert np.linalg.norm(reached - points, axis=1).mean() < 0.2 * away


def test_skinning_and_what_is_before_it_are_inverse() -> None:
    skeleton = Skeleton.of(MODEL)
    assert skeleton.joints[:2] == (HEAD, JAW)
    np.testing.assert_allclose(skeleton.weights.sum(axis=1), 1.0)
    assert np.all(skeleton.weights[MODEL.attached_mandible, 1] == 1.0)
    twists = skeleton.twists(MODEL, OPEN, np.zeros((2, 3)))
    motions = skeleton.motions(twists)
    np.testing.assert_allclose(motions[1], FreeJaw(MODEL.jaw).matrix(OPEN), atol=1e-12)
    points = MODEL.skin.vertices
    moved = skeleton.skin(points, motions)
    assert np.abs(moved - points).max() > 1.0
    np.testing.assert_allclose(skeleton.before(moved, motions), points, atol=1e-9)


def test_both_ways_to_drive_it_show_the_same_shapes(shapes: StudioShapes) -> None:
    by_shapes, by_joints = (LightRig.of(MODEL, shapes, way) for way in ("shapes", "joints"))
    for weights in ({}, {"jawOpen": 1.0}, {"jawOpen": 1.0, "mouthClose": 1.0}):
        np.testing.assert_allclose(by_joints.play(weights), by_shapes.play(weights), atol=1e-9)
    assert np.abs(by_joints.motions[0]).max() < np.abs(by_shapes.motions[0]).max()
    # half way a joint turns, where shapes go straight
    half = {"jawOpen": 0.5}
    assert np.abs(by_joints.play(half) - by_shapes.play(half)).max() > 0.05


def test_its_file_has_the_shapes_and_is_refused_with_others(
    shapes: StudioShapes, tmp_path: Path
) -> None:
    rig = LightRig.of(MODEL, shapes, "joints")
    path = tmp_path / "studio.glb"
    write_glb(rig, path)
    assert compare_glb(rig, path)["max_mm"] < 1e-2
    other = replace(rig, motions=rig.motions + 1.0)
    with pytest.raises(SolveError, match="jawOpen"):
        compare_glb(other, path)


@pytest.fixture
def texture(tmp_path: Path) -> SkinTexture:
    """An image in which every triangle of the block has a place of its own."""
    skin = MODEL.skin
    grid = np.arange(len(skin.faces))[:, None] + np.array([0.1, 0.5, 0.9])
    places = np.column_stack([grid.ravel() / len(skin.faces), np.tile([0.2, 0.9, 0.3], len(grid))])
    corners = np.arange(skin.faces.size, dtype=np.int32).reshape(-1, 3)
    coordinates = TextureCoordinates(places.astype(np.float32), corners)
    path = tmp_path / "texture.png"
    pixels = np.zeros((8, 8, 3), np.uint8)
    Texture(pixels, pixels[:, :, 0], coordinates, {}).write(path, tmp_path / "confidence.png")
    return SkinTexture.read(coordinates, len(skin.faces), path)


def test_its_skin_wears_a_texture_with_seams(
    shapes: StudioShapes, texture: SkinTexture, tmp_path: Path
) -> None:
    rig = LightRig.of(MODEL, shapes, "joints")
    path = tmp_path / "studio.glb"
    write_glb(rig, path, texture)
    assert compare_glb(rig, path, texture.coordinates)["max_mm"] < 1e-2
    document, binary = split_glb(path)
    primitive = next(mesh for mesh in document["meshes"] if mesh["name"] == TEXTURED)["primitives"]
    attributes = primitive[0]["attributes"]

    def values(number: int) -> np.ndarray:
        return accessor_values(document, binary, document["accessors"][number])

    faces = values(primitive[0]["indices"]).reshape(-1, 3)
    part = parts_of(MODEL.skin, rig.skeleton, texture.coordinates)[0]
    own = skin_parts(MODEL.skin)[TEXTURED]
    found = values(attributes["TEXCOORD_0"])[faces]
    wanted = texture.coordinates.places[texture.coordinates.corners[own]]
    np.testing.assert_allclose(found[..., 0], wanted[..., 0], atol=1e-6)
    np.testing.assert_allclose(found[..., 1], 1.0 - wanted[..., 1], atol=1e-6)
    points = values(attributes["POSITION"])[faces] / 1e-3
    np.testing.assert_allclose(points, MODEL.skin.vertices[MODEL.skin.faces[own]], atol=1e-3)
    assert len(part.vertices) == 3 * len(own)
    # read back as a scan, it has the image's colours
    scan = read_colours(path, read_raw(path))
    assert scan is not None
    assert (scan.paint.images_of >= 0).sum() == len(own)


def test_it_is_drawn_in_its_own_colours_which_say_how_good_they_are(
    shapes: StudioShapes, texture: SkinTexture, tmp_path: Path
) -> None:
    red = np.zeros((8, 8, 3), np.uint8)
    red[:, :, 0] = 220
    path = tmp_path / "texture.png"
    image = Texture(red, red[:, :, 0], texture.coordinates, {"ssim": 0.93})
    image.write(path, tmp_path / "confidence.png")
    worn = SkinTexture.read(texture.coordinates, len(MODEL.skin.faces), path)
    assert worn.figures == {"ssim": 0.93}
    rig = LightRig.of(MODEL, shapes, "joints")

    def redness(texture: SkinTexture | None) -> float:
        draw_shapes(MODEL, rig, texture, tmp_path / "studio.png")
        with Image.open(tmp_path / "studio.png") as picture:
            drawn = np.asarray(picture).astype(float)
        return float((drawn[:, :, 0] - drawn[:, :, 1] > 100).mean())

    assert redness(worn) > 0.1
    assert redness(None) < 0.01
    # painted over, with the words still on it
    with Image.open(path) as before:
        about = PngImagePlugin.PngInfo()
        for key, text in before.text.items():
            about.add_text(key, text)
        before.convert("L").save(path, pnginfo=about)
    assert SkinTexture.read(texture.coordinates, len(MODEL.skin.faces), path).figures == {}


def test_its_skin_wears_a_normal_map_with_tangents(
    shapes: StudioShapes, texture: SkinTexture, tmp_path: Path
) -> None:
    rig = LightRig.of(MODEL, shapes, "shapes")
    path = tmp_path / "studio.glb"
    write_glb(rig, path, SkinTexture(texture.coordinates, normals=texture.colours))
    document, binary = split_glb(path)
    mesh = next(mesh for mesh in document["meshes"] if mesh["name"] == TEXTURED)["primitives"][0]
    material = document["materials"][mesh["material"]]
    assert material["normalTexture"]["index"] == 0
    assert "baseColorTexture" not in material["pbrMetallicRoughness"]
    assert document["images"][0]["name"] == "studio_normals"

    def values(number: int) -> np.ndarray:
        return accessor_values(document, binary, document["accessors"][number])

    found = {name: values(number) for name, number in mesh["attributes"].items()}
    tangents = found["TANGENT"].astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(tangents[:, :3], axis=1), 1.0, atol=1e-5)
    across = np.einsum("nd,nd->n", tangents[:, :3], found["NORMAL"])
    np.testing.assert_allclose(across, 0.0, atol=1e-5)
    # going along the image to the right and to its upper edge is going along both axes
    faces = values(mesh["indices"]).reshape(-1, 3)
    points = found["POSITION"][faces]
    places = found["TEXCOORD_0"][faces]
    ways = points[:, 1:] - points[:, :1]
    to_the_right, down = np.moveaxis(
        np.linalg.solve((places[:, 1:] - places[:, :1]).astype(np.float64), ways), 1, 0
    )
    ours = tangents[faces[:, 0]]
    seconds = ours[:, 3:] * np.cross(found["NORMAL"][faces[:, 0]], ours[:, :3])
    along = np.einsum("nd,nd->n", ours[:, :3], to_the_right)
    assert (along > 0.0).mean() > 0.98
    assert (np.einsum("nd,nd->n", seconds, -down) > 0.0).mean() > 0.98


def test_a_level_of_detail_wears_the_texture_where_it_was() -> None:
    skin = MODEL.skin
    # two charts, cut in the middle, whose coordinates go with the place
    right = skin.vertices[skin.faces].mean(axis=1)[:, 0] > skin.vertices[:, 0].mean()
    places = np.vstack([skin.vertices[:, :2]] * 2) / 1000.0
    corners = (skin.faces + len(skin.vertices) * right[:, None]).astype(np.int32)
    coordinates = TextureCoordinates(places.astype(np.float32), corners)
    level = Surface(skin.vertices, skin.faces[::2])
    found = carry_texture(coordinates, skin, level)
    np.testing.assert_allclose(
        found.places[found.corners], level.vertices[level.faces][..., :2] / 1000.0, atol=1e-5
    )
    assert len(found.places) > len(np.unique(level.faces))  # split at the seam
    # a ball behind the skin lies in no chart, and has nothing to say of it
    ball = skin.vertices[skin.faces].mean(axis=1) - np.array([0.0, 0.0, 0.01])
    count = len(skin.vertices)
    faces = np.arange(len(ball) // 3 * 3).reshape(-1, 3) + count
    nowhere = np.full(faces.shape, NOWHERE, np.int32)
    eyed = Surface(np.vstack([skin.vertices, ball]), np.vstack([skin.faces, faces]))
    behind = replace(coordinates, corners=np.vstack([corners, nowhere]))
    nearer = level.with_vertices(level.vertices - np.array([0.0, 0.0, 0.01]))
    again = carry_texture(behind, eyed, nearer)
    np.testing.assert_array_equal(again.corners, found.corners)


def test_its_usd_wears_the_texture(
    shapes: StudioShapes, texture: SkinTexture, tmp_path: Path
) -> None:
    usd = pytest.importorskip("solver.rig.studio.usd")
    from pxr import Usd, UsdGeom, UsdShade

    rig = LightRig.of(MODEL, shapes, "shapes")
    path = tmp_path / "studio.usdc"
    usd.write_usd(rig, path, replace(texture, normals=texture.colours))
    assert usd.compare_usd(rig, path, texture.coordinates)["max_mm"] < 1e-4
    stage = Usd.Stage.Open(str(path))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/Face/skin"))
    places = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").Get()
    assert len(places) == len(mesh.GetPointsAttr().Get())
    image = UsdShade.Shader.Get(stage, "/Face/Materials/skin/BaseColour")
    assert image.GetInput("file").Get().path == "./studio_skin.png"
    surface = UsdShade.Shader.Get(stage, "/Face/Materials/skin/Surface")
    source, *_ = surface.GetInput("diffuseColor").GetConnectedSources()[0]
    assert source.source.GetPath() == image.GetPath()
    normals = UsdShade.Shader.Get(stage, "/Face/Materials/skin/Normals")
    assert normals.GetInput("sourceColorSpace").Get() == "raw"
    assert normals.GetInput("file").Get().path == "./studio_normals.png"
    source, *_ = surface.GetInput("normal").GetConnectedSources()[0]
    assert source.source.GetPath() == normals.GetPath()


def test_a_texture_of_another_template_is_refused(texture: SkinTexture, tmp_path: Path) -> None:
    other = replace(texture.coordinates, places=texture.coordinates.places * np.float32(0.5))
    with pytest.raises(InputError) as caught:
        SkinTexture.read(other, len(MODEL.skin.faces), tmp_path / "texture.png")
    assert caught.value.code == "texture.template"
    (tmp_path / "texture.png").write_bytes(b"none")
    with pytest.raises(InputError) as caught:
        SkinTexture.read(other, len(MODEL.skin.faces), tmp_path / "texture.png")
    assert caught.value.code == "texture.unreadable"


def test_its_usd_has_the_shapes_and_the_joints(shapes: StudioShapes, tmp_path: Path) -> None:
    usd = pytest.importorskip("solver.rig.studio.usd")
    rig = LightRig.of(MODEL, shapes, "joints")
    path = tmp_path / "studio.usdc"
    usd.write_usd(rig, path)
    assert usd.compare_usd(rig, path)["max_mm"] < 1e-4
    with pytest.raises(SolveError, match="jawOpen"):
        usd.compare_usd(replace(rig, motions=rig.motions + 1.0), path)
    from pxr import Usd, UsdSkel

    stage = Usd.Stage.Open(str(path))
    cache = UsdSkel.Cache()
    root = UsdSkel.Root(stage.GetDefaultPrim())
    cache.Populate(root, Usd.PrimDefaultPredicate)
    query = cache.GetSkelQuery(UsdSkel.Skeleton(stage.GetPrimAtPath("/Face/Skeleton")))
    assert list(query.GetJointOrder()) == ["head", "head/jaw"]
    # at rest nothing moves
    np.testing.assert_allclose(
        np.array(query.ComputeSkinningTransforms(0)), np.tile(np.eye(4), (2, 1, 1)), atol=1e-5
    )


def test_its_file_skins_as_the_rig_does(shapes: StudioShapes, tmp_path: Path) -> None:
    rig = LightRig.of(MODEL, shapes, "joints")
    path = tmp_path / "studio.glb"
    write_glb(rig, path)
    document, binary = split_glb(path)
    skin = document["skins"][0]
    nodes = document["nodes"]
    assert [nodes[joint]["name"] for joint in skin["joints"]] == list(rig.skeleton.joints)
    weights = {"jawOpen": 0.7, "mouthSmileLeft": 0.4}
    twist = np.tensordot([0.7, 0.0, 0.4], rig.twists, 1)
    wanted = rig.play(weights)
    for mesh, part in zip(document["meshes"], parts_of(rig.neutral, rig.skeleton), strict=True):
        primitive = mesh["primitives"][0]

        def values(number: int) -> np.ndarray:
            return accessor_values(document, binary, document["accessors"][number])

        points = values(primitive["attributes"]["POSITION"]).astype(float)
        names = mesh["extras"]["targetNames"]
        for name, target in zip(names, primitive["targets"], strict=True):
            points += weights.get(name, 0.0) * values(target["POSITION"])
        placed = np.zeros_like(points)
        joints = values(primitive["attributes"]["JOINTS_0"])
        shares = values(primitive["attributes"]["WEIGHTS_0"])
        for number in range(len(rig.skeleton.joints)):
            share = np.where(joints == number, shares, 0.0).sum(axis=1, keepdims=True)
            place = rig.skeleton.places[number] * 1e-3
            turn = Rotation.from_rotvec(twist[number, :3])
            moved = turn.apply(points - place) + place + twist[number, 3:] * 1e-3
            placed += share * moved
        np.testing.assert_allclose(1e3 * placed, wanted[part.vertices], atol=2e-3)


def test_a_level_of_detail_has_its_triangles_and_follows(shapes: StudioShapes) -> None:
    rig = LightRig.of(MODEL, replace(shapes, motions=0.2 * shapes.motions), "shapes")
    level = simplify(rig, 0.5)
    assert len(level.neutral.faces) < 0.75 * len(rig.neutral.faces)
    np.testing.assert_allclose(level.skeleton.weights.sum(axis=1), 1.0)
    assert distance_mm(rig, level).max() < 1.0
    same = simplify(rig, 1.0)
    assert distance_mm(rig, same).max() < 0.05


EYE = Eyeball(np.zeros(3), 12.0)
UP, DOWN = (
    12.2 * np.array([[0.0, np.sin(angle), np.cos(angle)]]) for angle in np.radians([40.0, -40.0])
)


def lids() -> Lids:
    """A lid of one vertex above an eyeball, and skin that goes along by half."""
    return Lids("left", np.array([0]), np.array([1.0, 0.5]), EYE, np.array([-0.1]))


def test_a_lid_is_shut_as_the_template_has_it_and_stays_off_the_eyeball() -> None:
    open_ = np.vstack([UP, UP + 5.0])
    inside = np.vstack([0.9 * DOWN, DOWN])
    shut = lids().finish(open_, inside)
    assert np.linalg.norm(shut[0]) == pytest.approx(12.1)
    np.testing.assert_allclose(shut[0] / 12.1, DOWN[0] / 12.2)
    np.testing.assert_allclose(shut[1], 0.5 * (open_[1] + inside[1]))
    assert lids().moves("eyeBlinkLeft")
    assert not lids().moves("eyeBlinkRight")


def test_a_lid_that_goes_straight_through_the_eyeball_is_led_around_it() -> None:
    def straight(weight: float) -> np.ndarray:
        return np.vstack([(1.0 - weight) * UP + weight * DOWN, UP])

    assert lids().depth(straight(0.5)).max() > 1.0
    motion = lids().half_way(straight)
    assert motion is not None
    assert not motion[1].any()
    for weight in np.linspace(0.0, 1.0, 21):
        led = straight(weight) + 4.0 * weight * (1.0 - weight) * motion
        assert lids().depth(led).max() < 0.02
    assert lids().half_way(lambda _: np.vstack([UP, UP])) is None
