"""Write a rig for another program: a rig of a service there, one in a folder here."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

from myoface.cli.app import NewFolder, Url
from myoface.cli.commands import Argument, Option
from myoface.cli.console import JobDisplay, out, transfer_bar
from myoface.cli.lookup import find_rig, refuse_missing
from myoface.cli.operator import OPERATOR
from myoface.client import DEFAULT_URL, Client
from myoface.errors import ApiError
from myoface.resources import Artifact, Result, Rig
from myoface.values import NOT_OF_THE_API

Format = Literal["usd", "glb", "npz"]

# The files as their exporters call them; a rig may have its own already
FILES: Mapping[Format, str] = {"usd": "rig.usdc", "glb": "rig.glb", "npz": "rig.npz"}


def export(
    rig: Annotated[
        str, Argument(help="rig.npz, or a rig's folder or ZIP; else a service's rig, by its id")
    ],
    format: Annotated[Format, Option(help="usd needs the extra `usd` where it is made")] = "usd",
    output: NewFolder = Path("."),
    url: Url = DEFAULT_URL,
) -> None:
    """Write a rig as USD, glTF or NPZ: of a file here, or by the service that has the rig."""
    if Path(rig).exists():
        words = ["export-rig", rig, "--format", format, "--output", str(output)]
        OPERATOR["solve"].run(words, "myoface solve")
        return
    refuse_missing(rig)
    with Client(url) as client:
        found = client.rig(find_rig(client, rig))
        file = _find_artifact(FILES[format], found.artifacts) or _made(client, found, format)
        with transfer_bar(file.name) as progress:
            client.download(file, output / file.name, progress=progress)
    out.print(f"{output / file.name}")


def _find_artifact(name: str, artifacts: list[Artifact]) -> Artifact | None:
    return next((each for each in artifacts if each.name == name), None)


def _made(client: Client, rig: Rig, format: Format) -> Artifact:
    """Have the service write the file, in a job.

    Raises :class:`ApiError`: ``client.answer`` if the job has left no such file.
    """
    job = client.submit("export_rig", rig.subject_id, rig_id=rig.id, options={"format": format})
    with JobDisplay(job.kind) as view:
        result = client.wait(job.id, view.watch).result or Result()
    if file := _find_artifact(FILES[format], result.artifacts):
        return file
    left = ", ".join(each.name for each in result.artifacts) or "nothing"
    detail = f"the export of rig {rig.id} has left no {FILES[format]}: it has left {left}"
    raise ApiError({"code": NOT_OF_THE_API, "detail": detail})
