"""Register a raw scan.

The template's vertices on a raw scan, with a confidence each; an expression is registered from the
subject's registered neutral.
"""

from solver.kinds.kind import FrameOptions, Kind

KIND = Kind(
    queue="short",
    reads=("capture", "template", "neutral"),
    leaves="registration",
    result="registered.ply",
    folder="registered",
    options=FrameOptions,
)
