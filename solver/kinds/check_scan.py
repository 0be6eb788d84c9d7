"""Check a raw scan while the person is still in the chair."""

from solver.kinds.kind import FrameOptions, Kind

KIND = Kind(
    title="Check a scan",
    description="Whether a scan can be used, while the person is still in the chair: verdict, "
    "findings with advice, and a picture.",
    queue="ingest",
    reads=("capture", "template"),
    asks=("role",),
    leaves="check",
    result="check.png",
    options=FrameOptions,
)
