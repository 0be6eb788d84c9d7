"""Check a scan.

Whether a scan can be used, while the person is still in the chair: verdict, findings with advice,
and a picture.
"""

from solver.kinds.kind import FrameOptions, Kind

KIND = Kind(
    queue="ingest",
    reads=("capture", "template"),
    asks=("role",),
    leaves="check",
    result="check.png",
    options=FrameOptions,
)
