"""Hold a live session.

A performer's frames come in as they are captured, and the face of the rig follows within the
frame's own time: expressions, jaw, head and skin go out, with the error that is measured meanwhile
by full solves of sampled frames. Takes that are recorded are left for exact fits.
"""

from typing import Literal

from pydantic import Field

from solver.kinds.kind import JobOptions, Kind

# How a session went, at its end; before that the takes that are whole, for the next attempt
REPORT = "live.json"
VIEW_FILE = "live_view.bin"  # the shapes that a page draws a session's frames by
# Ends the names of takes that are being recorded: the next attempt finishes what it finds of them
PART = ".part"

Source = Literal["markers", "weights", "points", "landmarks"]


class LiveSessionOptions(JobOptions):
    """Options of a live session."""

    source: Source = Field(
        default="weights",
        description="what frames are: markers, places of a marker set in mm; weights, ARKit's "
        "blendshapes; points, all vertices of the registered skin in mm; landmarks, the 478 of "
        "MediaPipe",
    )
    rate: float = Field(default=60.0, ge=1, le=240, description="frames a second that will come")
    smooth_hz: float | None = Field(
        default=None,
        ge=0.5,
        le=120,
        description="cutoff of a filter of what goes out, which delays it by a frame at most; "
        "null: none",
    )
    send_skin: bool = Field(
        default=False,
        description="whether frames carry all vertices of the skin besides the amounts of its "
        "shapes, which need no more than the rig's live_skin.npz",
    )
    check_seconds: float = Field(
        default=0.1,
        ge=0,
        le=60,
        description="pause between two frames that are solved in full beside the session, by which "
        "the running error is known and the skin mended; 0: none are",
    )
    idle_seconds: float = Field(
        default=300.0,
        ge=1,
        le=3600,
        description="a session to which no frame has come for so long ends",
    )
    max_seconds: float = Field(
        default=4 * 3600.0, ge=1, le=24 * 3600, description="a session that is so long ends"
    )


ENDING = "ending"  # phase of a session that was told to end, while it leaves its takes

KIND = Kind(
    queue="live",
    reads=(
        *("rig", "marker_set", "template", "expression_basis", "controls", "live_skin"),
        "live_samples",
    ),
    leaves="live",
    result="live.json",
    hands_on=("live_skin.npz", "expression_basis.npz", "live_takes.npz", "live_samples.npz"),
    options=LiveSessionOptions,
)
