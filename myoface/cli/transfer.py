"""The command that plays a video or its signals by a rig, and draws what was filmed beside."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

from myoface.cli.app import NewFolder
from myoface.cli.commands import Argument, Option
from myoface.cli.console import JobDisplay, out, show_outcome
from solver.kinds import INPUTS

PICTURE = "transfer.png"
RIG = INPUTS["rig"].parts[0].words
_FILE: dict[str, Any] = {"exists": True, "dir_okay": False}


def transfer(
    video: Annotated[
        Path,
        Argument(**_FILE, help="of a face: MP4, MOV, WebM, Matroska or AVI; or its signals.csv"),
    ],
    rig: Annotated[Path, Option(exists=True, help=RIG)],
    output: NewFolder = Path("transfer"),
    controls: Annotated[Path | None, Option(**_FILE, help="controls.npz of learn-controls")] = None,
    template: Annotated[
        Path | None, Option(**_FILE, help="template NPZ; default: built-in")
    ] = None,
    blendshapes: Annotated[
        Path | None, Option(**_FILE, help="blendshapes.npz of an earlier animation")
    ] = None,
    basis: Annotated[
        Path | None, Option(**_FILE, help="expression_basis.npz of an earlier job")
    ] = None,
    start: Annotated[int, Option(min=0, help="first frame")] = 0,
    end: Annotated[int | None, Option(min=1, help="the frame after the last")] = None,
    face: Annotated[
        int | None, Option(min=0, help="whose face, 0 being the largest at the middle")
    ] = None,
    neutral: Annotated[
        int | None, Option(min=0, help="frame in which the face is at rest; default: estimated")
    ] = None,
    gain: Annotated[float, Option(min=0, max=10, help="factor of all weights")] = 1.0,
    smooth_hz: Annotated[
        float | None, Option(min=0, max=100, help="faster motion is taken out; default: 6")
    ] = None,
    film: Annotated[bool, Option("--film", help="make animation.mp4, too")] = False,
    resume: Annotated[
        bool, Option("--resume", help="go on after the frames in the folder")
    ] = False,
) -> None:
    """Play a video of a face by a rig, and draw frames of both side by side.

    Leaves what `myoface solve animate` does, `signals.csv`, which is a recording itself, and
    `transfer.png`. Needs the extras `video` and `mediapipe`, and MediaPipe's model: `myoface assets
    fetch landmarker`. Signals are played without looking again, and without a picture; so is any
    other recording.
    """
    from solver.anatomy.template import Template
    from solver.jobs import run_job
    from solver.rig import Rig, find_files
    from solver.rig.transfer_sheet import draw_transfer
    from solver.scans.film import is_film
    from solver.templates.builtin.build import builtin_template

    recording: dict[str, Any] = {"asset": "video", "start": start, "end": end, "face": face}
    recording |= {"gain": gain, "smooth_hz": smooth_hz}
    if neutral is not None:
        recording["neutral"] = neutral
    files: dict[str, Any] = {"controls": controls, "template": template}
    files |= {"blendshapes": blendshapes, "expression_basis": basis}
    files = {name: file for name, file in files.items() if file is not None} | find_files(rig)
    output.mkdir(parents=True, exist_ok=True)
    with JobDisplay("transfer") as view:
        run_job(
            "animate",
            output,
            options={"scene": {"recording": recording}, "video": film},
            captures={"video": video},
            resume=resume,
            progress=view,
            **files,
        )
        is_filmed = is_film(video)
        if is_filmed:
            points = (Template.load(template) if template else builtin_template()).points
            draw_transfer(output / PICTURE, video, output, Rig.load(files).model, points, start)
    report = json.loads((output / "animation.json").read_text(encoding="utf-8"))
    show_outcome("animate", report, None)
    told = report["transfer"]
    source = "video" if is_filmed else "recording"
    out.print(
        f"{report['frames']} frames played; in the whole {source} {told['seen']} with a face, "
        f"gaps: {told['gaps']}, the longest of {told['longest_gap_s']:.2f} s; "
        f"{len(told['unseen_shapes'])} shapes are not seen, or not the template's"
    )
    if is_filmed:
        out.print(f"{output / PICTURE}")
