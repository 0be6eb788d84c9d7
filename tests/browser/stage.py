"""A stack with stand-in jobs, and a browser in front of it."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import httpx
import pytest

from myoface.stack import Stack
from service.settings import Settings
from tests.servers import unavailable
from tests.service_client import QUICK, STANDIN, Studio

ROOT = Path(__file__).parents[2]
CHROMIUM = Path("/usr/bin/chromium")
FLAGS = [
    "--no-sandbox",
    "--disable-quic",
    "--disable-background-networking",
    "--use-angle=swiftshader",  # the rig view draws with WebGL, here by the processor
    "--enable-unsafe-swiftshader",
]
SHOW: dict[str, Any] = {"solver_variables": ["STANDIN_SHOW"]}


@contextmanager
def on_stage(data_dir: Path, **settings: Any) -> Iterator[tuple[Stack, Studio]]:
    """Run a stack whose solver processes do stand-in jobs that take a while and leave pictures."""
    with mock.patch.dict(os.environ, PYTHONPATH=str(ROOT), STANDIN_SHOW="1"):
        stack = Stack(Settings(data_dir=data_dir, **{**QUICK, **STANDIN, **SHOW, **settings}))
    with stack, httpx.Client(base_url=stack.url, timeout=30) as http:
        yield stack, Studio(http, stack.key)


@contextmanager
def browser() -> Iterator[Any]:
    """Start Chromium; skips, with the reason, where it or playwright is missing."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if not CHROMIUM.exists():
        unavailable(f"there is no {CHROMIUM}")
    with playwright.sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=str(CHROMIUM), args=FLAGS)
        try:
            yield chromium
        finally:
            chromium.close()
