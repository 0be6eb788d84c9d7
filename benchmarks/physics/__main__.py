"""Living flesh, against known answers and on a fitted person, and its times.

The checks need no person: without ``--model`` the flesh that flies is the built-in person's, or
that of the subject that ``--anatomy`` and ``--faces`` choose. All else is of a person who is fitted
already: ``--model``, ``--rig``, ``--template``, and ``--blendshapes`` that the job ``animate`` has
left. Speed and performance play frames of ``--recording``. ``--show`` chooses; pictures, and the
performance's files, go into ``--out``.
"""

from __future__ import annotations

import argparse
import logging
from pathlib import Path

from benchmarks import report, subjects
from benchmarks.documents import Figures
from benchmarks.physics import checks, contact, effects, jobs, performance, sliding, speed
from benchmarks.physics.fitted import Fitted
from benchmarks.physics.gallery import gallery
from benchmarks.physics.section import section
from benchmarks.subjects import COARSE_EDGE_MM, EDGE_MM
from myoface.client import Client
from solver.anatomy.template import Template
from solver.animation import RecordedDrives
from solver.animation.controls import Controls
from solver.model import SubjectModel
from solver.rig import Rig
from solver.scans.live_link import read_live_link

SHOWS = ("checks", "contact", "sliding", "speed", "effects", "performance", "jobs")
QUICK_FRAMES = 20


def main() -> None:
    """Run from the command line."""
    parser = report.parser(__doc__ or "")
    subjects.add_options(parser)
    parser.add_argument("--show", action="append", choices=SHOWS, help="default: all there is to")
    parser.add_argument("--rig", type=Path, help="rig.npz, or a rig's folder")
    parser.add_argument("--template", type=Path, help="the model's")
    parser.add_argument("--blendshapes", type=Path, help="blendshapes.npz of the rig")
    parser.add_argument("--controls", type=Path, help="controls.npz of the rig")
    parser.add_argument("--recording", type=Path, help="CSV of Live Link Face")
    parser.add_argument(
        "--size", action="append", default=[], metavar="MM=MODEL", help="a model of another size"
    )
    parser.add_argument("--url", help="a running service")
    parser.add_argument("--rig-id", help="a rig of that service")
    parser.add_argument("--out", type=Path, default=Path("physics"), help="folder for pictures")
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    report.finish(run(options), options, section)


def run(options: argparse.Namespace) -> Figures:
    """Run the chosen shows and return the figures by show."""
    chosen = set(options.show or _possible(options))
    options.out.mkdir(parents=True, exist_ok=True)
    figures: Figures = {}
    for name, show in (
        ("checks", _checks),
        ("contact", _contact),
        ("sliding", _sliding),
        ("speed", _speed),
        ("effects", _effects),
        ("performance", _performance),
        ("jobs", _jobs),
    ):
        if name in chosen:
            logging.info(name)
            figures[name] = show(options)
    return figures


def _possible(options: argparse.Namespace) -> list[str]:
    """Return the shows for which everything is given."""
    needs = {
        "checks": (),
        "contact": ("rig", "blendshapes"),
        "sliding": ("rig", "blendshapes"),
        "speed": ("rig", "blendshapes", "recording"),
        "effects": ("rig", "template"),
        "performance": ("rig", "blendshapes", "recording", "template"),
        "jobs": ("url", "rig_id"),
    }
    return [show for show, names in needs.items() if all(getattr(options, n) for n in names)]


def _person(options: argparse.Namespace) -> Fitted:
    return Fitted.load(options.rig, options.blendshapes)


def _checks(options: argparse.Namespace) -> Figures:
    if options.rig:
        model = Rig.load(options.rig).model
    else:
        model, _ = subjects.load(options, COARSE_EDGE_MM if options.quick else EDGE_MM)
    figures = checks.run(model)
    checks.plot(options.out / "checks.png", figures)
    return figures


def _contact(options: argparse.Namespace) -> Figures:
    person = _person(options)
    played = contact.play_all(person)
    contact.picture(options.out / "contact.png", person, played)
    return contact.run(played)


def _sliding(options: argparse.Namespace) -> Figures:
    person = _person(options)
    sliding.picture(options.out / "sliding.png", person)
    return sliding.run(person)


def _speed(options: argparse.Namespace) -> Figures:
    person = _person(options)
    start = performance.START
    frames = QUICK_FRAMES if options.quick else performance.FRAMES
    take = read_live_link(options.recording)
    drives = RecordedDrives(take, person.shapes, person.model, start, start + frames)
    models = {}
    for given in options.size:
        edge, _, path = given.partition("=")
        models[float(edge)] = SubjectModel.load(Path(path))
    figures = speed.run(person, drives, models)
    if len(models) > 1:
        speed.plot(options.out / "speed.png", figures)
    return figures


def _effects(options: argparse.Namespace) -> Figures:
    subject = effects.Subject.load(options.rig, options.template)
    people = effects.run(subject)
    effects.sheet(people, options.out / "effects.png")
    return {"edits": effects.figures(people), "fibres": effects.fibres(subject)}


def _performance(options: argparse.Namespace) -> Figures:
    person = _person(options)
    basis = Template.load(options.template).shapes
    if basis is None:
        raise SystemExit("the template has no expressions to play a recording by")
    take = read_live_link(options.recording)
    frames = QUICK_FRAMES if options.quick else performance.FRAMES
    figures, played = performance.run(
        person, basis, take, options.out / "performance", frames=frames
    )
    if options.controls:
        controls = Controls.load(options.controls, person.model, person.S)
        folder = options.out / "controls"
        figures["controls"] = performance.compare_controls(
            person, basis, take, controls, folder, frames=frames
        )
    performance.picture(options.out / "performance.png", person, played)
    gallery(person, options.template, options.out / "gallery.png")
    return figures


def _jobs(options: argparse.Namespace) -> Figures:
    with Client(options.url) as client:
        return jobs.run(client, client.rig(options.rig_id), options.out)


if __name__ == "__main__":
    main()
