"""The job that brings a raw scan into a template's topology."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from solver.errors import Finding, InputError
from solver.jobs import Task, read_template
from solver.kinds.kind import FrameOptions
from solver.kinds.register_scan import RegisterScan
from solver.landmarker import optional_landmarker
from solver.meshio.colours import read_colours
from solver.meshio.raw import RawScan, mend, read_raw
from solver.meshio.registered import read_registered, write_registered
from solver.meshio.scan_archive import opened_scan
from solver.progress import Step
from solver.registration.detail import DETAIL, Detail, bake_detail
from solver.registration.landmarks import match, read_landmarks
from solver.registration.normal_maps import read_normals
from solver.registration.register import RegisteredFace, register
from solver.registration.report import distance_picture, report
from solver.registration.texture import TEXTURE, bake, texture_coordinates
from solver.registration.texture_views import compare_views
from solver.registration.topology import Topology, topology
from solver.registration.wrinkles import wrinkles
from solver.similarity import IDENTITY, Similarity
from solver.storage import write_json
from solver.surface import Surface

NOISY_MM = 0.05  # of a scan's noise, that is told


def run(task: Task[RegisterScan]) -> list[Path]:
    """Register a raw scan: a neutral, or an expression if the person's ``neutral`` is given.

    The scan may be a ZIP of a mesh with its images. ``landmarks`` are in its own unit and axes.
    ``registered.ply`` has the template's vertices in mm with the property ``confidence``. Of a scan
    with colours there are ``texture.png`` and ``texture_confidence.png``, too, and
    ``texture_views.png``, which has the textured skin beside the scan; images that cannot be used
    are a finding. Of one that is finer than the template there are ``normals.png`` and
    ``displacement.png``, and of an expression with the neutral's ``normals``
    ``wrinkle_normals.png``. Raises :class:`solver.errors.InputError` for files that cannot be used
    and for a scan without a face (``scan.not_a_face``).
    """
    with opened_scan(task.inputs["scan"]) as scan:
        return _register(task, scan)


def _register(task: Task[RegisterScan], scan: Path) -> list[Path]:
    progress = task.progress
    neutral = task.inputs.get("neutral")
    landmarks = task.inputs.get("landmarks")
    progress(Step("read", 0.0, message=scan.name))
    anatomy = read_template(task)
    skin = anatomy.skin
    rest = None
    if neutral is not None:
        rest = read_registered(neutral, skin.faces, len(skin.vertices))
    marks = None
    if landmarks is not None:
        marks = match(landmarks.name, read_landmarks(landmarks), anatomy)
    as_read = read_raw(scan)
    raw, _ = mend(as_read)
    known = topology(anatomy)
    registered = register(
        raw,
        known,
        None if rest is None else rest.vertices,
        frame=task.options.model_dump(include=set(FrameOptions.model_fields)),
        landmarks=marks,
        landmarker=optional_landmarker(),
        progress=progress,
    )
    progress(Step("pictures", 0.85))
    files = [task.out / name for name in ("registered.ply", "registration.json", "distance.png")]
    size_from = registered.start.size.taken_from if rest is None else rest.size_from
    write_registered(files[0], registered.skin, registered.trust.confidence, size_from)
    told = report(registered, known, size_from)
    distance_picture(registered, known, files[2])
    progress(Step("texture", 0.88))
    with _faults_told(told, "to have its colours, send the files again with it"):
        files += _leave_texture(task, scan, as_read, registered, known, told)
    progress(Step("detail", 0.92))
    detail = None
    with _faults_told(told, "to have its detail, give the template texture coordinates"):
        detail = _bake_detail(task, raw, registered, known, told)
    if detail is not None:
        files += _leave_detail(task, detail, known, told)
    write_json(files[1], told)
    progress(Step("done", 1.0))
    return files


@contextmanager
def _faults_told(told: dict[str, Any], advice: str) -> Iterator[None]:
    """Make a finding of images that cannot be used or made."""
    try:
        yield
    except InputError as error:
        if not error.code.startswith("texture."):
            raise
        if any(each["code"] == error.code for each in told["findings"]):
            return
        words = f"The skin is registered; {advice}."
        told["findings"].append(Finding(error.code, "warning", error.message, words).to_dict())


def _leave_texture(
    task: Task[RegisterScan],
    scan: Path,
    raw: RawScan,
    registered: RegisteredFace,
    known: Topology,
    told: dict[str, Any],
) -> list[Path]:
    """Leave the scan's colours on the registered skin, if it has any."""
    colours = read_colours(scan, raw, task.options.colours)
    if colours is None:
        return []
    told["findings"] += [each.to_dict() for each in colours.findings]
    coordinates = texture_coordinates(known.template)
    options = replace(TEXTURE, size=task.options.texture_size)
    skin = registered.scanned
    onto = _onto_skin(registered)
    bare = bake(colours, onto, skin, known, coordinates, options)
    views = compare_views(colours, onto(colours.vertices), skin, known.face, bare)
    texture = replace(bare, figures=bare.figures | views.figures)
    images = [task.out / name for name in ("texture.png", "texture_confidence.png")]
    texture.write(*images)
    told["texture"] = texture.figures
    picture = task.out / "texture_views.png"
    views.draw(picture)
    return [*images, picture]


def _bake_detail(
    task: Task[RegisterScan],
    raw: RawScan,
    registered: RegisteredFace,
    known: Topology,
    told: dict[str, Any],
) -> Detail | None:
    """Return what a mended scan has beyond the registered skin; None: nothing, which is told."""
    detail = None
    if len(raw.faces):
        given = task.options
        options = replace(
            DETAIL, size=given.texture_size, width=given.detail_width_mm, most=given.detail_most_mm
        )
        scan = Surface(_onto_skin(registered)(raw.vertices), raw.faces)
        coordinates = texture_coordinates(known.template)
        detail = bake_detail(scan, registered.scanned, known, coordinates, options)
    if detail is None:
        message = "There is no normal map: the scan is hardly finer than the template, or no mesh."
        told["findings"].append(Finding("detail.coarse", "info", message).to_dict())
    return detail


def _leave_detail(
    task: Task[RegisterScan], detail: Detail, known: Topology, told: dict[str, Any]
) -> list[Path]:
    """Leave the maps of a scan's detail, and of what of it a neutral has not."""
    images = [task.out / name for name in ("normals.png", "displacement.png")]
    detail.write(*images)
    told["detail"] = detail.figures
    noise = detail.figures["noise_mm"]
    if noise >= NOISY_MM:
        message = f"The scan's noise is {noise:.2f} mm: relief that does not rise above it is none."
        advice = "For pores, scan closer or in better light."
        told["findings"].append(Finding("detail.noise", "info", message, advice).to_dict())
    neutral = task.inputs.get("normals")
    if neutral is not None and "neutral" in task.inputs:
        with _faults_told(told, "to have its wrinkles, register the neutral with this template"):
            before = read_normals(neutral, detail.texels, detail.coordinates)
            changed = wrinkles(detail, before, known)
            images.append(task.out / "wrinkle_normals.png")
            changed.write(images[-1])
            told["wrinkles"] = changed.figures
    return images


def _onto_skin(registered: RegisteredFace) -> Similarity:
    """Return what takes the scan's own coordinates onto the registered skin."""
    return replace(IDENTITY, scale=registered.start.mm_per_unit).then(registered.motion)
