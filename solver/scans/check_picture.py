"""The picture of a check: the scan from the front and from both sides, its faults in colour."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial import KDTree

from solver.drawing.render import Camera, look
from solver.registration.scan_surface import estimated_normals
from solver.scans.check import ScanCheck
from solver.scans.cover import FAR_MM
from solver.surface import Floats, Ints, Surface, area_normals

WIDTH, HEIGHT = 420, 520  # pixels of a view
SUPERSAMPLING = 2  # pixels drawn for one that is kept, along each axis
YAWS = (0.0, np.radians(42), np.radians(-42))  # of the views
SPAN_MM = 330.0  # height of a view
LIGHT = np.array([0.35, 0.45, 0.82])  # where it comes from
GREY = np.array([0.80, 0.78, 0.76])  # skin
INWARD = np.array([0.45, 0.52, 0.66])  # triangles that face inwards
FAULT = np.array([0.93, 0.55, 0.10])  # spikes
MISSING = np.array([0.86, 0.10, 0.12])  # of the face
BACKGROUND = np.array([0.975, 0.975, 0.98])  # of the sheet
MOST_POINTS = 100_000  # of a cloud that are drawn
LARGEST_DISC, MISSING_PIXELS = 8, 8  # radii in pixels
# What is missing is drawn where the fitted face has it, even if the scan lies before it.
BEHIND_MM = 25.0
BACK_MM = 45.0  # of the view's middle behind the face


def check_picture(check: ScanCheck, title: str, path: Path) -> None:
    """Write the picture of a check as PNG: three views, what is missing of the face in red.

    Orange vertices are spikes; triangles that face inwards are blue. Without a scan the picture
    holds only the title.
    """
    views = [_view(check, yaw) for yaw in YAWS] if check.scan is not None else []
    sheet = Image.new("RGB", (WIDTH * len(YAWS), HEIGHT + 40), _rgb(BACKGROUND))
    for number, view in enumerate(views):
        sheet.paste(Image.fromarray(view), (WIDTH * number, 40))
    ImageDraw.Draw(sheet).text((14, 10), title, (40, 40, 46), ImageFont.load_default(18))
    sheet.save(path)


def _rgb(colour: Floats) -> tuple[int, int, int]:
    red, green, blue = (round(float(value) * 255) for value in colour)
    return red, green, blue


def _view(check: ScanCheck, yaw: float) -> np.ndarray:
    surface, centre, span = _place(check)
    camera = Camera(centre, span, yaw, distance=FAR_MM)
    wide, high = WIDTH * SUPERSAMPLING, HEIGHT * SUPERSAMPLING
    image = np.broadcast_to(BACKGROUND, (high, wide, 3)).copy()
    depth = np.full((high, wide), np.inf)
    if len(surface.faces):
        _draw_mesh(image, depth, camera, surface, check)
    else:
        _draw_cloud(image, depth, camera, surface.vertices)
    if check.cover is not None:
        missing = check.cover.points[~check.cover.covered]
        red = np.broadcast_to(MISSING, missing.shape)
        pixels = camera.project(missing, wide, high)
        _draw_discs(image, depth + BEHIND_MM, pixels, red, MISSING_PIXELS)
    image = image.reshape(HEIGHT, SUPERSAMPLING, WIDTH, SUPERSAMPLING, 3).mean(axis=(1, 3))
    return np.asarray(np.clip(image * 255, 0, 255), np.uint8)


def _place(check: ScanCheck) -> tuple[Surface, Floats, float]:
    """Return the scan as it is to be seen, the middle of the view and its height."""
    scan = check.scan
    assert scan is not None
    if check.location is not None and check.cover is not None:
        vertices = check.location.pose.motion(scan.vertices)
        if any(finding.code == "scan.two_heads" for finding in check.findings):
            low, high = np.quantile(vertices, [0.002, 0.998], axis=0)
            return Surface(vertices, scan.faces), (low + high) / 2, 1.6 * float((high - low).max())
        middle = np.median(check.cover.points, axis=0) - np.array([0.0, 0.0, BACK_MM])
        return Surface(vertices, scan.faces), middle, SPAN_MM
    low, high = np.quantile(scan.vertices, [0.002, 0.998], axis=0)
    scale = SPAN_MM / 1.2 / float((high - low).max() + 1e-30)
    return Surface((scan.vertices - (low + high) / 2) * scale, scan.faces), np.zeros(3), SPAN_MM


def _draw_mesh(
    image: Floats, depth: Floats, camera: Camera, surface: Surface, check: ScanCheck
) -> None:
    seen = look(camera, surface, image.shape[1], image.shape[0])
    mask = np.asarray(seen.mask)
    if not mask.any():
        return
    normals = area_normals(surface.vertices, surface.faces)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-30
    smooth = _smooth(normals, surface.faces, len(surface.vertices))
    normal = seen.interpolate(smooth).astype(np.float64)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-30
    facing = normals[seen.triangle[mask]] @ camera.axes[2]
    light = np.abs(normal @ (camera.axes.T @ LIGHT))
    colour = np.where(facing[:, None] >= 0, GREY, INWARD)
    if check.marked is not None and check.marked.any():
        fault = np.asarray(check.marked[surface.faces].any(axis=1))[seen.triangle[mask]]
        colour[fault] = FAULT
    image[mask] = colour * (0.25 + 0.75 * light[:, None])
    place = seen.interpolate(surface.vertices).astype(np.float64)
    depth[mask] = camera.distance - (place - camera.centre) @ camera.axes[2]


def _smooth(normals: Floats, faces: Ints, count: int) -> Floats:
    sums = np.zeros((count, 3))
    for axis in range(3):
        sums[:, axis] = np.bincount(faces.ravel(), np.repeat(normals[:, axis], 3), minlength=count)
    return sums


def _draw_cloud(image: Floats, depth: Floats, camera: Camera, points: Floats) -> None:
    """Draw a point cloud as a closed surface: discs as wide as the points lie apart."""
    shown = points[np.random.default_rng(0).permutation(len(points))[:MOST_POINTS]]
    gap = float(np.median(KDTree(shown).query(shown[::7], k=2)[0][:, 1]))
    pixels = camera.project(shown, image.shape[1], image.shape[0])
    radius = round(2.0 * gap * image.shape[0] / camera.span)
    light = np.abs(estimated_normals(shown, shown) @ (camera.axes.T @ LIGHT))
    _draw_discs(image, depth, pixels, GREY * (0.25 + 0.75 * light[:, None]), radius)


def _draw_discs(image: Floats, depth: Floats, pixels: Floats, colours: Floats, radius: int) -> None:
    """Draw points (n, 3: column, row, depth) as discs, the nearest over all others."""
    rows, columns = depth.shape
    radius = int(np.clip(radius, 2, LARGEST_DISC))
    for down in range(-radius, radius + 1):
        for right in range(-radius, radius + 1):
            if down * down + right * right > radius * radius:
                continue
            column = np.rint(pixels[:, 0]).astype(int) + right
            row = np.rint(pixels[:, 1]).astype(int) + down
            inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
            row, column, far = row[inside], column[inside], pixels[inside, 2]
            order = np.argsort(-far)  # of several points in a pixel, the last written stays
            row, column, far = row[order], column[order], far[order]
            nearer = far < depth[row, column]
            image[row[nearer], column[nearer]] = colours[inside][order][nearer]
            depth[row[nearer], column[nearer]] = far[nearer]
