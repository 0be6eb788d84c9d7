"""What a stand-in job does is written in the scans that it is given.

A scan's lines ``#! key value`` say it: ``seconds`` to take, the ``verdict`` to give, a ``fault`` to
have, the seconds for which a ``child`` process sleeps, ``view`` for a rig that can be looked at.
With ``STANDIN_SHOW`` in the environment jobs take half a second and leave real pictures.
"""

import os
import signal
import subprocess
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

from PIL import Image, ImageDraw

from solver.errors import InputError
from solver.progress import ProgressCallback, Step

SHOW = "STANDIN_SHOW" in os.environ
SECONDS, LEAST_REPORTS = (0.5, 12) if SHOW else (0.0, 1)


def orders_of(scan: Path) -> dict[str, str]:
    """Return a scan's orders."""
    lines = scan.read_text(errors="replace").splitlines()  # a ZIP, say
    return dict(line[3:].split(maxsplit=1) for line in lines if line.startswith("#! "))


def work(scans: Iterable[Path], progress: ProgressCallback, phases: Sequence[str]) -> None:
    """Report progress, to be seen in ``phases``, with an error that falls, as each scan says."""
    phases = phases if SHOW else ["geometry"]
    for scan in scans:
        orders = orders_of(scan)
        if "child" in orders:
            subprocess.Popen(["sleep", orders["child"]])
        seconds = float(orders.get("seconds", SECONDS))
        reports = max(LEAST_REPORTS, int(seconds / 0.1))
        for number in range(reports):
            phase = phases[number * len(phases) // reports]
            error = 0.3 + 2.4 * 0.88**number
            residual = 40 * 0.8 ** min(number, 60) if SHOW else float("nan")
            progress(Step(phase, number / reports, number + 1, residual, mean_error_mm=error))
            told = f", objective {residual:.4e}" if SHOW else ""
            os.write(1, f"step {number} of {scan.name}{told}\n".encode())
            time.sleep(seconds / reports)
        fail(orders.get("fault"), scan)


def fail(fault: str | None, scan: Path) -> None:
    """Have a fault."""
    if fault == "nan":
        raise InputError("scan.nan", f"{scan} has a NaN in line 3", file=str(scan), line=3)
    if fault == "crash":
        raise ZeroDivisionError("a bug")
    if fault == "memory":
        bytearray(1 << 36)
    if fault == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if fault == "deaf":  # a C library that hears no signal
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        time.sleep(120)
    if fault == "poison":
        os.kill(os.getppid(), signal.SIGKILL)


def draw(path: Path, words: str) -> None:
    """Leave a picture."""
    if not SHOW:
        path.write_bytes(b"PNG")
        return
    image = Image.new("RGB", (480, 320), "#20262b")
    pen = ImageDraw.Draw(image)
    pen.ellipse((170, 40, 310, 260), fill="#b8a79a")
    pen.text((12, 296), words, fill="#e8ecee")
    image.save(path)
