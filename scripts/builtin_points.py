"""Write where a detector marks the built-in face: .venv/bin/python scripts/builtin_points.py MODEL.

MODEL is MediaPipe's ``face_landmarker*.task``; MediaPipe is where `scripts/mediapipe` puts it, or
installed (two minutes).
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from solver.photo.mesh_points import find_points
from solver.templates.builtin.build import POINTS_FILE, build_template, builtin_head

sys.path.append(str(Path(__file__).parents[1] / ".mediapipe"))
found = find_points(build_template(builtin_head()), Path(sys.argv[1]))
points = found.points
np.savez_compressed(POINTS_FILE, **points.arrays())
print(  # noqa: T201
    f"a face in {found.with_face} of {found.pictures} pictures, {len(points.names)} points, "
    f"spread {np.median(points.spread_mm):.2f} mm, {POINTS_FILE}"
)
