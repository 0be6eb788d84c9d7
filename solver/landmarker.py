"""Where the file of MediaPipe's face landmarker is. Light, for those who know no numerics."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path

from solver.cache import cache_path

VARIABLE = "MYOFACE_FACE_LANDMARKER"  # of the environment: a file in the place of the fetched one
FILE = "face_landmarker_v2.task"  # in the cache folder, where it is fetched to
# packages without which no face is found, and no film read
PACKAGES = ("av", "mediapipe")
HELP = f"run myoface assets fetch landmarker, or name a file in {VARIABLE}"


def landmarker_file() -> Path | None:
    """Return the file that the environment names, else the fetched one; None without either."""
    if given := os.environ.get(VARIABLE):
        return Path(given)
    fetched = cache_path() / FILE
    return fetched if fetched.is_file() else None


def optional_landmarker() -> Path | None:
    """Return the file for a job that does without it, too.

    What the environment names is asked for. What was only fetched is of use with MediaPipe.
    """
    if os.environ.get(VARIABLE) or importlib.util.find_spec("mediapipe") is not None:
        return landmarker_file()
    return None


def lacking_of_faces() -> list[str]:
    """Return what is missing here of finding faces: packages, and the ``landmarker`` itself."""
    lacks = [name for name in PACKAGES if importlib.util.find_spec(name) is None]
    file = landmarker_file()
    return lacks if file is not None and file.is_file() else [*lacks, "landmarker"]
