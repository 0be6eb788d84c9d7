"""The demonstration: a person's scans in, a fitted rig and its figures out."""

from __future__ import annotations

import json
import shlex
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from myoface.cli.commands import Option, UsageError
from myoface.cli.console import complain, out, show_table
from myoface.cli.service import compile_kernels, end_in_order, read_settings
from myoface.client import Client
from myoface.demo.outcome import Bars, DemoOutcome, khronos_validation, millimetres

if TYPE_CHECKING:
    from myoface.demo.session import Options
    from solver.templates.tables import CaptureSet

BUILTIN_BARS = Bars(train_mm=0.9, test_mm=1.0)
ICT_BARS = Bars(train_mm=0.85, test_mm=0.90)
QUICK_OPTIONS: Options = {
    "build_model": {"edge_mm": 16.0},
    "fit_geometry": {"rounds": 2},
    "fit_tracks": {"max_iterations": 8},
}
QUICK_TRAIN = 2
QUICK_TEST = 1
# The data folder of the service that is started, in the output: `myoface up` goes on with it.
SERVICE = "service"

Folder = Annotated[Path | None, Option(exists=True, file_okay=False)]


def demo(
    output: Annotated[Path, Option("--output", "-o", file_okay=False)] = Path("demo-output"),
    anatomy: Folder = None,
    faces: Folder = None,
    subject: Annotated[str, Option(help="with --faces: a subject of the capture sets")] = "A",
    capture_sets: Annotated[Path | None, Option(exists=True, dir_okay=False)] = None,
    url: Annotated[str | None, Option(help="a running service; default: starts one")] = None,
    quick: Annotated[bool, Option("--quick", help="coarse, three expressions, not judged")] = False,
    json_file: Annotated[Path | None, Option("--json", help="figures; - prints them")] = None,
) -> None:
    """Fit a face: the built-in one, or with --anatomy and --faces one of your folders."""
    from myoface.demo.session import Session
    from solver.cache import cache_directory
    from solver.rig.frames.read_back import validate_glb

    to_stdout = str(json_file) == "-"
    out.stderr = to_stdout  # standard output is then for the figures alone
    if (anatomy is None) != (faces is None):
        raise UsageError("--anatomy and --faces go together")
    title = "Myoface: the built-in face" if faces is None else f"Myoface: subject {subject}"
    output.mkdir(parents=True, exist_ok=True)
    begun = time.monotonic()
    template, captures = _inputs(output, anatomy, faces, subject, capture_sets)
    if quick:
        captures = captures.first(QUICK_TRAIN, QUICK_TEST)
    preparing = time.monotonic() - begun

    with _service(url, output / SERVICE) as client:
        session = Session(client, output, {"prepare": preparing})
        report = session.run(title, captures, template, QUICK_OPTIONS if quick else {})
    glb = output / "rig.glb"
    outcome = DemoOutcome(
        report,
        session.seconds,
        validate_glb(glb, list(report["expressions"])),
        khronos_validation(glb, cache_directory() / "gltf-validator"),
        None if quick else ICT_BARS if faces else BUILTIN_BARS,
    )
    _print_outcome(outcome, output)
    _print_page(f"/rigs/{session.rig_id}", url, output / SERVICE)
    text = json.dumps(outcome.as_dict(), indent=2, allow_nan=False)
    if to_stdout:
        sys.stdout.write(text + "\n")
    elif json_file is not None:
        json_file.write_text(text + "\n", encoding="utf-8")
    for failure in outcome.failures():
        complain(failure)
    if outcome.failures():
        raise SystemExit(1)


def _inputs(
    output: Path, anatomy: Path | None, faces: Path | None, subject: str, capture_sets: Path | None
) -> tuple[Path | None, CaptureSet]:
    if anatomy is None or faces is None:
        from solver.templates.builtin.build import builtin_capture_set

        return None, builtin_capture_set()
    from solver.templates.ict_facekit import ict_capture_set
    from solver.templates.ict_template import build_ict_template

    captures = ict_capture_set(faces, subject, capture_sets)
    template = output / "template.npz"
    out.print("building the template from the folders")
    build_ict_template(anatomy, faces).save(template)
    return template, captures


@contextmanager
def _service(url: str | None, data: Path) -> Iterator[Client]:
    """Yield a client of the service at ``url``, or of one that is started for the block."""
    if url is not None:
        with Client(url) as client:
            yield client
        return
    from myoface.stack import Stack
    from worker.kernels import remove_stale

    end_in_order()
    remove_stale()
    stack = Stack(read_settings(data_dir=data, port=0))
    with stack, Client(stack.url, stack.key) as client:
        out.print(f"watch it on the page {_signed_in(stack.url + '/', stack.key)}")
        compile_kernels(niceness=0)  # nobody else asks for anything
        yield client


def _print_outcome(outcome: DemoOutcome, output: Path) -> None:
    fits = outcome.report["expressions"].items()
    columns = ("expression", "scan", "mean mm", "95 % mm", "max mm", "inverted")
    rows = [(n, f["role"], f["mean_mm"], f["p95_mm"], f["max_mm"], f["inverted"]) for n, f in fits]
    show_table(columns, rows)
    out.print()
    show_table(("phase", "seconds"), [(p, f"{s:.1f}") for p, s in outcome.seconds.items()])
    out.print()
    figures = outcome.as_dict()
    out.print(f"training mean  {millimetres(figures['train_mean_mm'])}")
    out.print(f"unseen mean    {millimetres(figures['test_mean_mm'])}")
    out.print(f"inverted tets  {figures['inverted']} of {figures['tets']}")
    out.print(f"muscles        {figures['muscles']}")
    out.print(f"seconds        {figures['seconds']}")
    errors = outcome.khronos.errors
    khronos = outcome.khronos.note if errors is None else f"{errors} errors"
    out.print(f"rig.glb        {len(outcome.glb_faults)} faults; Khronos validator: {khronos}")
    out.print(f"certificate    {outcome.report['verdict']}: {outcome.report['use']}")
    out.print(f"look at        {output / 'report.html'!s}")


def _print_page(path: str, url: str | None, data: Path) -> None:
    """Say where the page shows the rig: of a running service, or of the one that was kept."""
    if url is not None:
        out.print(f"in the browser {url.rstrip('/')}{path}")
        return
    settings = read_settings()
    key = read_settings(data_dir=data).admin_key.read_text()
    page = _signed_in(f"http://{settings.host}:{settings.port}{path}", key)
    out.print("sliders        are made once it runs, in two to ten minutes; the page shows how far")
    out.print(f"in the browser myoface up --data {shlex.quote(str(data))}")
    out.print(f"               and open {page}")


def _signed_in(page: str, key: str) -> str:
    """Return a page's address with the key, which never goes into a log."""
    return f"{page}#key={key}" if out.is_terminal else page
