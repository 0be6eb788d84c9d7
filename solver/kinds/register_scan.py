"""Register a raw scan: the template's vertices on it."""

from solver.kinds.kind import FrameOptions, Kind

KIND = Kind(
    title="Register a raw scan",
    description="The template's vertices on a raw scan, with a confidence each; an expression is "
    "registered from the subject's registered neutral.",
    queue="short",
    reads=("capture", "template", "neutral"),
    leaves="registration",
    result="registered.ply",
    folder="registered",
    options=FrameOptions,
)
