"""Commands about takes of markers: check them, bind them to a person."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from myoface.cli.app import NewFile
from myoface.cli.commands import Argument, Group, Option
from myoface.cli.console import BAD, out, show_findings
from myoface.cli.offline import make_command
from solver.kinds import INPUTS, KINDS

markers = Group("Markers on a face: check takes, bind them to a person.")
CHECK = KINDS["check_markers"]
RULES = CHECK.schema["properties"]  # of its options, which binding has as well
markers.command("check")(make_command(CHECK))

TAKE = INPUTS["markers"].parts[0].words
Take = Annotated[Path, Argument(exists=True, dir_okay=False, help=TAKE)]
Person = Annotated[
    Path, Argument(exists=True, dir_okay=False, help="the person: rig.npz or model.npz")
]


@markers.command()
def bind(
    model: Person,
    take: Take,
    neutral: Annotated[
        int | None, Option("--neutral", "--frame", help=RULES["neutral"]["description"])
    ] = None,
    expression: Annotated[str | None, Option(help=RULES["expression"]["description"])] = None,
    actor: Annotated[
        bool, Option("--actor", help="the take is another person's, whose motion is carried over")
    ] = False,
    output: NewFile = Path("markers.json"),
) -> None:
    """Propose where each label of a take sits on a person: the marker set of a session.

    Ends with 3 if there is something to look at before the set is used.
    """
    from solver.model import SubjectModel
    from solver.rig import Rig
    from solver.scans.markers.places.face_take import frames_about
    from solver.scans.markers.prepare import bind
    from solver.scans.markers.readers.take import read_take

    read = read_take(take)
    shown = None if expression is None else Rig.load(model).expression(expression)
    rows = frames_about(read, neutral)
    person = SubjectModel.load(model)
    found = bind(read, person, rows, expression=shown, actor=actor)
    found.markers.save(output)
    first, last = (read.numbers[row] for row in found.neutral)
    parts = [each.part for each in found.markers.markers]
    counted = ", ".join(f"{parts.count(part)} {part}" for part in dict.fromkeys(parts))
    out.print(f"{expression or 'at rest'} in frames {first} to {last}: {counted}")
    out.print(f"the markers miss the skin by {found.pose.miss():.1f} mm (root mean square)")
    show_findings([each.to_dict() for each in found.findings])
    out.print(f"{output}")
    if found.findings:
        raise SystemExit(BAD)
