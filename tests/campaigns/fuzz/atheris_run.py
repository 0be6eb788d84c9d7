"""``python -m tests.campaigns.fuzz.atheris_run TARGET [-max_total_time=60]``: led by coverage.

The same readers as ``tests.campaigns.fuzz``, mutated by libFuzzer instead of Hypothesis.
Needs the package ``atheris``; the arguments after the target's name are libFuzzer's.
"""

from __future__ import annotations

import contextlib
import sys
import tempfile
import warnings
from pathlib import Path

import atheris  # type: ignore[import-untyped]

with atheris.instrument_imports(include=["solver.scans", "solver.storage", "service"]):
    from tests.campaigns.fuzz.targets import targets


def main() -> None:
    """Fuzz one target until libFuzzer's limits, or until it crashes."""
    known = {target.name: target for target in targets()}
    if len(sys.argv) < 2 or sys.argv[1] not in known:
        sys.exit(f"{__doc__}\ntargets: {', '.join(known)}")
    target = known[sys.argv.pop(1)]
    warnings.simplefilter("ignore", RuntimeWarning)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "work"
        corpus = Path(name) / "corpus"
        folder.mkdir()
        corpus.mkdir()
        for number, content in enumerate(target.seeds):
            (corpus / str(number)).write_bytes(content)

        def once(content: bytes) -> None:
            with contextlib.suppress(target.refusal):
                target.run(content, folder)

        atheris.Setup([*sys.argv, str(corpus)], once)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
