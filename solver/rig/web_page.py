"""``report.html``: the certificate for a person to read, in one file that needs no network."""

from __future__ import annotations

from html import escape
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

from solver.rig.checks import overall
from solver.rig.plausibility import JAW_RANGES, JAW_SOURCE, MUSCLE_SOURCE
from solver.rig.web_expression import article, muscle_rows
from solver.rig.web_markup import figure, row, tag, tile

ROLES = {"train": "training", "test": "unseen"}
MEANS = {"train_mean_mm": "mean of training scans", "test_mean_mm": "mean of unseen scans"}
FILES = {
    "rig.glb": "the skin with one named morph target per expression",
    "activations.npz": "muscle activations, jaw and flesh of every expression",
    "activations.csv": "the same activations as a table",
    "muscle_weights.npz": "the matrix S, tetrahedra × muscles",
    "report.json": "the figures of this page",
}

WHOLE = {"flesh.inverted", "muscles.beyond"}
"""Checks whose figures are counts."""
FEW = 4
"""So many expressions are named one by one, even where a check fails in all of them."""
LONG = 200
"""Letters of a detail that is only told with its expression."""


def write_page(path: Path, figures: dict[str, Any]) -> None:
    """Write the page of a rig's ``report.json`` values, with the pictures found beside ``path``."""
    page = resources.files(__package__).joinpath("report.html").read_text(encoding="utf-8")
    expressions = figures["expressions"]
    anchors = {name: f"e{number}" for number, name in enumerate(expressions)}
    columns, muscles = muscle_rows(expressions)
    filled = Template(page).substitute(
        verdict=figures["verdict"],
        subject=_subject(figures),
        tag=tag(figures["verdict"]),
        summary=_summary(figures),
        tiles=_tiles(figures),
        todo=_todo(figures, anchors),
        checks=_checks(figures["checks"], anchors),
        sources=_sources(),
        rows=_rows(expressions, anchors),
        articles="\n".join(
            article(anchors[name], name, found, path.with_name(f"fit_{name}.png"))
            for name, found in expressions.items()
        ),
        muscle_columns=columns,
        muscles=muscles,
        made=_made(figures, path.parent),
    )
    path.write_text(filled, encoding="utf-8")


def _subject(figures: dict[str, Any]) -> str:
    template = figures["made_with"]["template"]
    return escape(
        f"{len(figures['expressions'])} expressions, {figures['muscles']} muscles, "
        f"{figures['tets']:,} tetrahedra; anatomy {template['name']} {template['version']}"
    )


def _summary(figures: dict[str, Any]) -> str:
    """Return whether the rig may be used, and the verdict of every group of checks."""
    checks = figures["checks"]
    groups = {
        check["group"]: overall(
            [each["verdict"] for each in checks if each["group"] == check["group"]]
        )
        for check in checks
    }
    good = sum(check["verdict"] == "good" for check in checks)
    parts = "".join(f"<li>{escape(name)} {tag(verdict)}</li>" for name, verdict in groups.items())
    counted = f"{good} of {len(checks)} checks are good in every expression."
    return f"<p><b>{escape(figures['use'])}</b> {counted}</p><ul>{parts}</ul>"


def _tiles(figures: dict[str, Any]) -> str:
    worst = {check["code"]: check for check in figures["checks"]}
    tiles = [
        tile(words, figure(figures[key], 2), "mm")
        for key, words in MEANS.items()
        if figures[key] is not None
    ]
    for code, words in (
        ("flesh.inverted", "inverted tets"),
        ("flesh.volume", "greatest change of volume"),
        ("muscles.beyond", "muscles out of range, at most"),
        ("trip.skin", "simulated from rest, at most"),
    ):
        if code in worst:
            value = worst[code]["value"]
            tiles.append(tile(words, figure(value, 0 if code in WHOLE else 2), worst[code]["unit"]))
    return "\n".join(tiles)


def _todo(figures: dict[str, Any], anchors: dict[str, str]) -> str:
    failed = [check for check in figures["checks"] if check["verdict"] != "good"]
    failed.sort(key=lambda check: check["verdict"] != "bad")
    lines = [f"<li>{tag(check['verdict'])}{_advice(check, anchors)}</li>" for check in failed]
    lines += [
        f"<li>{tag('usable')}<div><p>{escape(warning['message'])}</p></div></li>"
        for warning in figures["warnings"]
    ]
    if not lines:
        return "<p>Nothing. Use the rig.</p>"
    return f'<ul class="todo">{"".join(lines)}</ul>'


def _advice(check: dict[str, Any], anchors: dict[str, str]) -> str:
    detail = f": {escape(check['detail'])}" if 0 < len(check["detail"]) < LONG else ""
    others = [name for name in check["failed"] if name != check["worst"]]
    links = ", ".join(_link(name, anchors) for name in others)
    more = f" Also in {links}." if others else ""
    if len(check["failed"]) == len(anchors) > FEW:
        more = " So in every expression."
    return (
        f"<div><p><b>{escape(check['title'])}</b>: {_value(check)} in "
        f"{_link(check['worst'], anchors)}{detail}.{more}</p><p>{escape(check['advice'])}</p></div>"
    )


def _checks(checks: list[dict[str, Any]], anchors: dict[str, str]) -> str:
    lines, group = [], None
    for check in checks:
        if check["group"] != group:
            group = check["group"]
            lines.append(
                f'<tr><th class="group" colspan="6" scope="rowgroup">{escape(group)}</th></tr>'
            )
        lines.append(
            f"<tr><th scope='row'>{escape(check['title'])}<small>{escape(check['meaning'])}</small>"
            f"</th><td class='left'>{tag(check['verdict'])}</td>"
            f"<td class='nowrap'>{_value(check)}</td><td class='left'>{_where(check, anchors)}</td>"
            f"<td class='nowrap'>{_limit(check, 'good')}</td>"
            f"<td class='nowrap'>{_limit(check, 'usable')}</td></tr>"
        )
    return "\n".join(lines)


def _sources() -> str:
    ranges = ", ".join(
        f"{name.replace('_', ' ')} {low:g} to {high:g}" for name, (low, high) in JAW_RANGES.items()
    )
    facts = {
        "Muscles": MUSCLE_SOURCE,
        "Jaw": f"{ranges.replace('-', '−')}. {JAW_SOURCE}",
        "The rest": "What fits of captured faces reach when nothing is wrong.",
    }
    return "".join(f"<dt>{words}</dt><dd>{escape(value)}</dd>" for words, value in facts.items())


def _value(check: dict[str, Any]) -> str:
    words = "none" if check["value"] == 0 else f"{figure(check['value'])} {check['unit']}"
    return escape(words.strip())


def _limit(check: dict[str, Any], name: str) -> str:
    if check[name] is None:
        return "any"
    if check[name] == 0:
        return "none"
    return f"{'≥' if check['least'] else '≤'} {figure(check[name])}"


def _where(check: dict[str, Any], anchors: dict[str, str]) -> str:
    return "" if check["value"] == 0 else _link(check["worst"], anchors)


def _link(name: str, anchors: dict[str, str]) -> str:
    return f"<a href='#{anchors[name]}'>{escape(name)}</a>"


def _rows(expressions: dict[str, Any], anchors: dict[str, str]) -> str:
    widest = max((found["mean_mm"] for found in expressions.values()), default=0.0) or 1.0
    lines = []
    for name, found in expressions.items():
        trip = found["round_trip"]
        lines.append(
            row(
                f"<a href='#{anchors[name]}'>{escape(name)}</a>",
                ("left", tag(found["verdict"])),
                ("left", ROLES.get(found["role"], escape(found["role"]))),
                (
                    "bar",
                    f"<i style='width:{100 * found['mean_mm'] / widest:.0f}%'></i>"
                    f"<b>{found['mean_mm']:.2f}</b>",
                ),
                ("", f"{found['p95_mm']:.2f}"),
                ("", f"{found['max_mm']:.2f}"),
                ("nowrap", f"{100 * found['coverage']:.0f} %"),
                ("nowrap", f"{found['jaw_motion']['opening_mm']:.1f} mm".replace("-", "−")),
                ("nowrap", "" if trip is None else f"{figure(trip['skin_mean_mm'], 2)} mm"),
                ("", str(found["iterations"])),
                ("", f"{found['seconds']:.1f}"),
            )
        )
    return "\n".join(lines)


def _made(figures: dict[str, Any], folder: Path) -> str:
    made = figures["made_with"]
    seconds = ", ".join(f"{phase} {spent:.1f} s" for phase, spent in figures["seconds"].items())
    versions = ", ".join(f"{name} {number}" for name, number in made["versions"].items() if number)
    settings = ", ".join(f"{name} {value}" for name, value in figures["settings"].items())
    facts = {
        "Settings": settings,
        "Time": seconds,
        "Versions": versions,
        "Template": "{name} {version}, content sha256 {content_sha256}".format(**made["template"]),
        "Model": f"content sha256 {made['model_sha256']}",
        "Muscle geometry S": f"content sha256 {made['weights_sha256']}",
    }
    lines = "".join(f"<dt>{words}</dt><dd>{escape(value)}</dd>" for words, value in facts.items())
    files = "".join(
        f"<dt><a href='{name}'>{name}</a></dt><dd>{escape(words)}</dd>"
        for name, words in FILES.items()
        if (folder / name).exists()
    )
    return f"<dl>{lines}</dl><dl>{files}</dl>"
