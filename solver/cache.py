"""The cache folder: what is made or fetched once. Light, for those who know no numerics."""

from __future__ import annotations

import os
from pathlib import Path

# Of the environment; a worker names another folder to each solver process
VARIABLE = "MYOFACE_CACHE"


def cache_path() -> Path:
    """Return where the cache folder is: ``$MYOFACE_CACHE``, else ``~/.cache/myoface``."""
    return Path(os.environ.get(VARIABLE) or Path.home() / ".cache" / "myoface")


def cache_directory() -> Path:
    """Return the cache folder, made if missing."""
    folder = cache_path()
    folder.mkdir(parents=True, exist_ok=True)
    return folder
