"""The Python of guides that talks to a service, against one whose jobs solve nothing."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from myoface.client import Client
from myoface.client.credentials import KEY_VARIABLE
from myoface.stack import Stack
from tests.service_client import Studio

GUIDES = Path(__file__).parents[2] / "docs" / "guide"


def snippet(name: str, word: str) -> str:
    """Return the guide's Python that has a word in it."""
    found = re.findall(r"^```python\n(.*?)^```$", (GUIDES / name).read_text(), re.M | re.S)
    (code,) = (each for each in found if word in each)
    return str(code)


@pytest.mark.parametrize(
    ("guide", "kind", "take"),
    [("sequences.md", "fit_sequence", "take.npy"), ("simulation.md", "animate", "take.csv")],
)
def test_the_first_rig_and_what_plays_on_it(
    stack_and_studio: tuple[Stack, Studio],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    guide: str,
    kind: str,
    take: str,
) -> None:
    stack, studio = stack_and_studio
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(KEY_VARIABLE, stack.key)
    for name in ("neutral.obj", "smile.obj"):
        Path(name).write_text(f"# {name}\n")
    start = snippet("start.md", "create_subject").replace("http://127.0.0.1:8765", stack.url)
    names: dict[str, Any] = {}
    exec(start, names)
    assert (tmp_path / "rig" / "rig.npz").exists()
    rig = SimpleNamespace(id=names["job"].result.rig_id)
    subject = names["subject"]
    Path(take).write_text("#! frames 4\n")
    with Client(stack.url) as client:
        exec(snippet(guide, kind), {"client": client, "subject": subject, "rig": rig, "Path": Path})
    jobs = studio.get(f"/v1/jobs?subject_id={subject.id}&kind={kind}")["items"]
    assert [job["state"] for job in jobs] == ["succeeded"]
