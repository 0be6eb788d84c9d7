"""The job that builds the light rig a studio ships."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from solver.anatomy.template import Template
from solver.animation.lids import Lids
from solver.drawing.head import DrawnHead, face_camera
from solver.drawing.sheet import Column, SheetLayout, draw_sheet
from solver.errors import Finding, InputError
from solver.jobs import Task, read_template
from solver.jobs.blendshapes import SOLVED, left_files, person_blendshapes, tell_blendshapes
from solver.jobs.scenes import READ
from solver.kinds.build_studio_rig import BuildStudioRig
from solver.model import SubjectModel
from solver.progress import Step
from solver.registration.texture import texture_coordinates
from solver.rig import Rig
from solver.rig.studio.glb import compare_glb, worn_images, write_glb
from solver.rig.studio.levels import carry_texture, distance_mm, simplify
from solver.rig.studio.light_rig import LightRig
from solver.rig.studio.parts import parts_of
from solver.rig.studio.shapes import FleshShapes, StudioShapes, shape_names, solve_studio_shapes
from solver.rig.studio.skin_texture import SkinTexture
from solver.rig.studio.wrinkle_maps import drive_wrinkles, read_wrinkle_images
from solver.scene.places import Places
from solver.storage import write_json

MADE = 0.85  # share of the job after which the shapes are solved in flesh
TEXTURE_ADVICE = (
    "Register the neutral's raw scan again, with its colours (OBJ with MTL and images, GLB, PLY): "
    "the rig's next job in a service finds what that leaves, a command line takes it by --texture."
)
LEVELS = {"studio": 1.0, "studio_half": 0.5, "studio_quarter": 0.25}  # share of the triangles


def run(task: Task[BuildStudioRig]) -> list[Path]:
    """Solve the person's shapes in flesh with contact and write them as a light rig.

    Blendshapes of an earlier job are taken as they are, and so are a ``texture`` and ``normals`` of
    the neutral's registration, which the skin wears. Captures are wrinkle maps by the names of
    their expressions. Raises ``texture.*``, ``wrinkles.*``, ``blendshapes.*``, ``basis.*`` and what
    reading a rig raises.
    """
    given = task.options
    progress = task.progress
    progress(Step("read", 0.0, message=task.inputs["rig"].name))
    rig = Rig.load(task.inputs)
    model = rig.model
    template = read_template(task)
    basis = template.shapes
    if basis is None:
        name = model.template.get("name", "")
        raise InputError("blendshapes.none", f"the template {name} has no expressions")
    texture = _read_texture(task, template, len(model.skin.faces))
    quality = {} if texture is None else texture.figures
    wrinkles = {}
    if task.captures:  # whatever is wrong with one is told before the shapes are solved
        coordinates = texture_coordinates(template)
        wrinkles = read_wrinkle_images(task.captures, rig, shape_names(basis), coordinates)
    progress(Step("read", READ))
    blendshapes = person_blendshapes(task, rig)
    flesh = FleshShapes(rig, blendshapes, Places.of(model, task.inputs.get("template"), {}))

    def listen(done: int, count: int) -> None:
        words = f"{done} of {count}"
        progress(Step("shapes", SOLVED + (MADE - SOLVED) * done / count, done, message=words))

    shapes = solve_studio_shapes(model, flesh, basis, listen)
    light = LightRig.of(model, shapes, given.driven_by).with_lids(Lids.of(model))
    progress(Step("export", MADE))
    written = {}
    levels = {}
    for name, share in LEVELS.items():
        rigged = light if share == 1.0 else simplify(light, share)
        file = task.out / f"{name}.glb"
        worn = texture
        if worn is not None and rigged is not light:
            carried = carry_texture(worn.coordinates, light.neutral, rigged.neutral)
            worn = replace(worn, coordinates=carried)
        write_glb(rigged, file, worn)
        compared = compare_glb(rigged, file, worn.coordinates if worn else None)
        written[file] = {**compared, "bytes": file.stat().st_size}
        levels[file.name] = tell_level(light, rigged)
    written |= _write_usd(light, task.out / "studio.usdc", texture)
    wrinkled = [*drive_wrinkles(wrinkles, rig, shapes)]
    for each in wrinkled:
        file = task.out / each.file
        file.write_bytes(each.content)
        written[file] = {"bytes": len(each.content)}
    notices = _notices(texture)
    for notice in notices:
        progress(Step("warning", MADE, message=f"{notice.message} {notice.advice}"))
    picture = task.out / "studio.png"
    draw_shapes(model, light, texture, picture)
    report = task.out / "studio.json"
    figures = {
        **tell_shapes(light, shapes),
        **tell_blendshapes(blendshapes),
        "driven_by": given.driven_by,
        "has_texture": texture is not None and texture.colours is not None,
        "texture": quality,
        "has_normals": texture is not None and texture.normals is not None,
        "notices": [notice.to_dict() for notice in notices],
        "wrinkles": {each.name: each.told() for each in wrinkled},
        "levels": levels,
        "files": {file.name: told for file, told in written.items()},
    }
    write_json(report, figures)
    progress(Step("done", 1.0))
    return [*written, report, picture, *left_files(task)]


def _read_texture(task: Task[BuildStudioRig], template: Template, faces: int) -> SkinTexture | None:
    """Return the images for a skin of ``faces`` triangles; None if none was given."""
    images = {"colours": task.inputs.get("texture"), "normals": task.inputs.get("normals")}
    if not any(images.values()):
        return None
    return SkinTexture.read(texture_coordinates(template), faces, **images)


def _notices(texture: SkinTexture | None) -> list[Finding]:
    """Return what is told of a skin that has no colours."""
    if texture is not None and texture.colours is not None:
        return []
    message = "The skin has no colours: no texture.png was given."
    return [Finding("studio.no_texture", "info", message, TEXTURE_ADVICE)]


def _write_usd(
    light: LightRig, file: Path, texture: SkinTexture | None
) -> dict[Path, dict[str, Any]]:
    """Write the rig as USD where the extra is there; return what is told of the files.

    The images of skin and eyes lie beside it.
    """
    try:
        from solver.rig.studio.usd import compare_usd, write_usd  # an extra
    except ModuleNotFoundError:
        return {}
    coordinates = texture.coordinates if texture else None
    write_usd(light, file, texture)
    told = {file: {**compare_usd(light, file, coordinates), "bytes": file.stat().st_size}}
    for name, content in worn_images(parts_of(light.neutral, light.skeleton), texture).items():
        image = file.with_name(name)
        image.write_bytes(content)
        told[image] = {"bytes": len(content)}
    return told


def tell_level(light: LightRig, level: LightRig) -> dict[str, Any]:
    """Return the triangles of a level of detail, and how far its shapes are off the whole rig's."""
    triangles = len(level.neutral.faces)
    if level is light:
        return {"triangles": triangles}
    off = distance_mm(light, level)
    worst = int(off.argmax())
    return {
        "triangles": triangles,
        "mean_mm": round(float(off.mean()), 4),
        "worst_mm": round(float(off[worst]), 4),
        "worst": light.names[worst],
    }


def tell_shapes(light: LightRig, shapes: StudioShapes) -> dict[str, Any]:
    """Return what ``studio.json`` says of shapes and joints: distances in mm, turns in degrees."""
    skeleton = light.skeleton
    rows = {}
    for row, name in enumerate(shapes.names):
        moved = {}
        for joint, twist in zip(skeleton.joints, light.twists[row], strict=True):
            if twist.any():
                turn = np.degrees(twist[:3]).round(4).tolist()
                moved[joint] = {"turn_deg": turn, "move_mm": twist[3:].round(4).tolist()}
        off = {"off_mm": round(float(shapes.off_mm[row]), 4)}
        rows[name] = off | ({"joints": moved} if moved else {})
    return {
        "format": 1,
        "shapes": rows,
        "shapes_count": len(shapes.names),
        "shapes_mean_mm": round(float(shapes.off_mm.mean()), 4),
        "shapes_worst_mm": round(float(shapes.off_mm.max()), 4),
        "not_settled_in_contact": list(shapes.unsettled),
        "by_freed_muscles": list(shapes.freed),
        "joints": {
            name: place.round(4).tolist()
            for name, place in zip(skeleton.joints, skeleton.places, strict=True)
        },
        "half_ways": {each.name: each.of for each in light.half_ways},
    }


# Picture of the shapes.

SHOWN = {
    "neutral": {},
    "eyes shut": {"eyeBlinkLeft": 1.0, "eyeBlinkRight": 1.0},
    "jaw open": {"jawOpen": 1.0},
    "smile": {"mouthSmileLeft": 1.0, "mouthSmileRight": 1.0},
    "funnel": {"mouthFunnel": 1.0},
    "jawOpen, mouthClose 0.6": {"jawOpen": 0.6, "mouthClose": 0.6},
    "brows up, look left": {
        **{"browInnerUp": 1.0, "browOuterUpLeft": 1.0, "browOuterUpRight": 1.0},
        **{"eyeLookOutLeft": 1.0, "eyeLookInRight": 1.0},
    },
    "sneer": {"noseSneerLeft": 1.0, "noseSneerRight": 1.0, "browDownLeft": 1.0},
}
LAYOUT = SheetLayout(cell=(300, 380), label=20, foot=40)


def draw_shapes(
    model: SubjectModel, light: LightRig, texture: SkinTexture | None, path: Path
) -> None:
    """Draw some shapes of a light rig, whole, and mixed, in its skin's colours if it has any."""
    head = DrawnHead(model.skin)
    camera = face_camera(model.skin.vertices, model.face, 0.0)
    worn = None if texture is None else texture.on(model.skin)
    columns = []
    for name, weights in SHOWN.items():
        lit = head.lit(light.play(weights))
        body = head.body(lit) if worn is None else head.wearing(lit, worn.at)
        columns.append(Column.of(name, [body], camera, LAYOUT))
    detail = f"{len(light.names)} shapes, {len(light.skeleton.joints)} joints"
    draw_sheet(path, "The studio's rig", detail, ("",), columns, LAYOUT, scale_mm=None)
