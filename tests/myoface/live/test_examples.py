"""The example that drives Blender, with a stand-in for the few things of Blender that it uses."""

from __future__ import annotations

import importlib.util
import socket
import sys
import time
from array import array
from pathlib import Path
from types import SimpleNamespace

import pytest

from myoface.client import LiveFrame
from myoface.live.sinks import OscSink
from tests.myoface.live.echo import READY

EXAMPLE = Path(__file__).parents[3] / "docs" / "examples" / "live_blender.py"


def test_shape_keys_follow_what_a_station_sends(monkeypatch: pytest.MonkeyPatch) -> None:
    keys = {name: SimpleNamespace(value=0.0, slider_min=0.0) for name in ("Basis", "jawOpen")}
    blocks = type("Blocks", (dict,), {"__iter__": lambda self: iter(self.values())})(keys)
    face = SimpleNamespace(data=SimpleNamespace(shape_keys=SimpleNamespace(key_blocks=blocks)))
    monkeypatch.setitem(
        sys.modules, "bpy", SimpleNamespace(data=SimpleNamespace(objects={"face": face}))
    )  # type: ignore[arg-type]
    spec = importlib.util.spec_from_file_location("live_blender", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    receiver = example.Receiver(port, "face")
    assert receiver() > 0  # nothing has come
    sink = OscSink("127.0.0.1", port)
    sink.said(READY)
    arrays = {name: array("f", [0.0] * size) for name, size in (("head", 16), ("jaw", 5))}
    arrays |= {"values": array("f", [0.5, 0.25]), "contractions": array("f", [0.25])}
    sink.face(LiveFrame(1, 0.5, 1.0, 0.1, 0.2, 0, False, False, False, arrays), None)
    time.sleep(0.05)

    receiver()

    assert keys["jawOpen"].value == 0.5
    assert keys["Basis"].value == 0.0
    sink.close()
    receiver.socket.close()
