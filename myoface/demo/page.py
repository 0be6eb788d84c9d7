"""``report.html``: the demonstration's figures and pictures in one file."""

from __future__ import annotations

import base64
from html import escape
from importlib import resources
from pathlib import Path
from string import Template

from myoface.demo.outcome import Outcome, millimetres

ROLES = {"train": "training", "test": "unseen"}


def write_page(path: Path, title: str, outcome: Outcome) -> None:
    """Write the page, self-contained, from the outcome and the pictures beside ``path``."""
    page = resources.files(__package__).joinpath("page.html").read_text(encoding="utf-8")
    report, folder = outcome.report, path.parent
    filled = Template(page).substitute(
        title=escape(title),
        verdict=_verdict(outcome),
        train=millimetres(report["train_mean_mm"], 2),
        test=millimetres(report["test_mean_mm"], 2),
        inverted=report["inverted"],
        tets=f"{report['tets']:,}",
        muscles=report["muscles"],
        minutes=_clock(sum(outcome.seconds.values())),
        rows=_rows(outcome),
        model=_figure(folder / "anatomy.png", "Skull, mandible and muscles inside the neutral scan")
        + _figure(folder / "tets.png", "The flesh as tetrahedra"),
        fits="\n".join(_fit(folder, name) for name in report["expressions"]),
        phases=_phases(outcome.seconds),
        files=_files(folder, outcome),
    )
    path.write_text(filled, encoding="utf-8")


def _verdict(outcome: Outcome) -> str:
    failures = outcome.failures()
    if failures:
        words = "".join(f"<li>{escape(failure)}</li>" for failure in failures)
        return f'<ul class="bad">{words}</ul>'
    if outcome.bars is None:
        return '<p class="good">A quick run on a coarse mesh: its figures are not judged.</p>'
    bars = f"training ≤ {outcome.bars.train_mm} mm, unseen ≤ {outcome.bars.test_mm} mm"
    return f'<p class="good">All bars met: {bars}.</p>'


def _rows(outcome: Outcome) -> str:
    fits = outcome.report["expressions"]
    widest = max((fit["mean_mm"] for fit in fits.values()), default=0.0) or 1.0
    return "\n".join(
        f"<tr><th scope='row'>{escape(name)}</th><td>{ROLES[fit['role']]}</td>"
        f"<td class='bar'><i style='width:{100 * fit['mean_mm'] / widest:.0f}%'></i>"
        f"<b>{fit['mean_mm']:.3f}</b></td>"
        f"<td>{fit['p95_mm']:.2f}</td><td>{fit['max_mm']:.2f}</td><td>{fit['inverted']}</td>"
        f"<td>{fit['iterations']}</td><td>{fit['seconds']:.1f}</td></tr>"
        for name, fit in fits.items()
    )


def _fit(folder: Path, name: str) -> str:
    return _figure(folder / f"fit_{name}.png", f"{name}: scan, fit and distance between them")


def _figure(picture: Path, caption: str) -> str:
    if not picture.exists():
        return ""
    data = base64.b64encode(picture.read_bytes()).decode()
    text = escape(caption)
    image = f'<img loading="lazy" alt="{text}" src="data:image/png;base64,{data}">'
    return f"<figure>{image}<figcaption>{text}</figcaption></figure>"


def _phases(seconds: dict[str, float]) -> str:
    longest = max(seconds.values(), default=0.0) or 1.0
    return "\n".join(
        f"<tr><th scope='row'>{escape(phase)}</th>"
        f"<td class='bar'><i style='width:{100 * spent / longest:.1f}%'></i>"
        f"<b>{spent:.1f}</b></td></tr>"
        for phase, spent in seconds.items()
    )


def _files(folder: Path, outcome: Outcome) -> str:
    khronos = outcome.khronos
    checked = "structure in order" if not outcome.glb_faults else "; ".join(outcome.glb_faults)
    if khronos.errors is None:
        word = f"Khronos validator {khronos.note}"
    else:
        word = f"Khronos validator: {khronos.errors} errors, {khronos.warnings} warnings"
    lines = [
        ("rig.glb", f"skin with one named morph target per expression; {checked}; {word}"),
        ("activations.npz", "muscle activations and jaw of every expression"),
        ("muscle_weights.npz", "the matrix S, tetrahedra × muscles"),
        ("report.json", "the figures of this page"),
        ("model.npz", "the person's flesh, bones and muscles"),
    ]
    return "\n".join(
        f"<li><a href='{name}'>{name}</a> — {escape(text)}</li>"
        for name, text in lines
        if (folder / name).exists()
    )


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02d}"
