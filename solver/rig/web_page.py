"""``report.html``: the certificate for a person to read, in one file that needs no network."""

from __future__ import annotations

import base64
from html import escape
from importlib import resources
from io import BytesIO
from pathlib import Path
from string import Template
from typing import Any

from PIL import Image

from solver.drawing.head import both_sides
from solver.rig.certificate import JAW_RANGES, JAW_SOURCE, MUSCLE_SOURCE
from solver.rig.checks import overall
from solver.rig.result import ROLES

# Small pieces of the certificate's page.


WORDS = {"good": "Good", "usable": "Usable", "bad": "Look at it"}

_SHAPES = {  # told apart by shape, not by colour alone
    "good": '<circle cx="8" cy="8" r="7.2"/><path d="M4.6 8.3l2.3 2.4 4.5-5"/>',
    "usable": '<path d="M8 1.2L15.3 14.5H.7z"/><path d="M8 6v4.2M8 11.9v.8"/>',
    "bad": '<circle cx="8" cy="8" r="7.2"/><path d="M5.3 5.3l5.4 5.4M10.7 5.3l-5.4 5.4"/>',
}


def tag(verdict: str) -> str:
    """Return a verdict as a sign and a word."""
    return (
        f'<span class="tag {verdict}"><svg viewBox="0 0 16 16" fill="none" stroke="currentColor" '
        f'stroke-width="1.6" aria-hidden="true">{_SHAPES[verdict]}</svg>{WORDS[verdict]}</span>'
    )


def figure(value: float | None, decimals: int | None = None) -> str:
    """Return a figure in words, with three digits or so many decimals; None is ``not known``."""
    if value is None:
        return "not known"
    if decimals is not None:
        return f"{value:,.{decimals}f}"
    if value != 0.0 and abs(value) < 1e-3:
        return f"{value:.0e}".replace("e-0", "e-")
    return f"{value:,.3g}"


def tile(words: str, value: str, unit: str) -> str:
    """Return a big figure with its words."""
    return (
        f'<div class="tile"><strong>{value} <em>{escape(unit)}</em></strong>{escape(words)}</div>'
    )


def row(heading: str, *cells: tuple[str, str]) -> str:
    """Return a table's row from markup: its heading and cells of (class, content)."""
    inside = "".join(
        f"<td class='{kind}'>{content}</td>" if kind else f"<td>{content}</td>"
        for kind, content in cells
    )
    return f"<tr><th scope='row'>{heading}</th>{inside}</tr>"


# The certificate's page: what it says of one expression, and of the muscles in all of them.


PICTURE_WIDTH, JPEG_QUALITY = 1400, 86  # of a fit's picture: sharp on a large screen
SOLVERS = {"reduced": "Reduced solver,", "ipopt": "IPOPT,"}
ENDINGS = {
    "converged": "converged",
    "stopped": "out of steps",
    "failed": "broke down",
    "unknown": "ending not known",
}
CONTACTS = {
    "lips_mm": "lips in each other",
    "upper_teeth_mm": "lips in upper teeth",
    "lower_teeth_mm": "lips in lower teeth",
    "bite_mm": "teeth in teeth",
}
STRONG_PERCENT = 40.0  # change of a fibre's length at which a cell has its full colour


def article(anchor: str, name: str, found: dict[str, Any], picture: Path) -> str:
    """Return what is known of an expression: picture, figures, regions, faults."""
    return (
        f"<article id='{anchor}'><header><h3>{escape(name)}</h3>{tag(found['verdict'])}</header>"
        f"{_picture(picture, name)}<dl>{_facts(found)}</dl>"
        f"{_regions(found['by_region'])}{_faults(found['muscles'])}</article>"
    )


def muscle_rows(expressions: dict[str, Any]) -> tuple[str, str]:
    """Return the heading cells and the rows of muscles by expressions."""
    columns = "".join(f"<th scope='col'>{escape(name)}</th>" for name in expressions)
    names = list(next(iter(expressions.values()))["muscles"]) if expressions else []
    muscles = sorted(names, key=lambda name: (both_sides(name), name))
    rows = "\n".join(
        f"<tr><th scope='row'>{escape(muscle)}</th>"
        + "".join(_cell(found["muscles"][muscle]) for found in expressions.values())
        + "</tr>"
        for muscle in muscles
    )
    return columns, rows


def _cell(muscle: dict[str, Any]) -> str:
    if muscle["fibres"] is None:
        return "<td></td>"
    percent = 100.0 * (muscle["fibres"] - 1.0)
    strength = min(abs(percent) / STRONG_PERCENT, 1.0)
    colour = "pull" if percent < 0 else "push"
    kind = " class='fault'" if muscle["faults"] else ""
    words = f"{percent:+.0f}".replace("-", "−") if abs(percent) >= 0.5 else "0"
    title = f" title='{escape('; '.join(muscle['faults']))}'" if muscle["faults"] else ""
    fill = f"background:rgba(var(--{colour}),{0.75 * strength:.2f})"
    return f"<td{kind}{title} style='{fill}'>{words}</td>"


def _picture(picture: Path, name: str) -> str:
    if not picture.exists():
        return ""
    image = Image.open(picture)
    image.thumbnail((PICTURE_WIDTH, PICTURE_WIDTH))
    stream = BytesIO()
    image.convert("RGB").save(stream, "JPEG", quality=JPEG_QUALITY)
    data = base64.b64encode(stream.getvalue()).decode()
    words = f"{name}: scan, fit and the distance between them, from the front and from the side"
    return (
        f'<figure><img loading="lazy" width="{image.width}" height="{image.height}" '
        f'alt="{escape(words)}" src="data:image/jpeg;base64,{data}"></figure>'
    )


def _facts(found: dict[str, Any]) -> str:
    jaw = found["jaw_motion"]
    parts = [
        f"{words[value < 0]} {abs(value):.1f} {unit}"
        for value, words, unit in (
            (jaw["opening_deg"], ("opens", "closes"), "°,"),
            (jaw["opening_mm"], ("down", "up"), f"mm at the {jaw['point']},"),
            (jaw["sideways_mm"], ("left", "right"), "mm; condyles"),
            (jaw["condyles_forward_mm"], ("forward", "back"), "mm,"),
            (jaw["condyles_down_mm"], ("down", "up"), "mm"),
        )
    ]
    motion = " ".join(parts).replace(" °", "°")
    if jaw["faults"]:
        motion += f". Not anatomical: {', '.join(jaw['faults'])}"
    facts = {
        "Skin": f"mean {found['mean_mm']:.2f} mm, 95 % below {found['p95_mm']:.2f} mm, "
        f"greatest {found['max_mm']:.2f} mm; {100 * found['coverage']:.0f} % of the face seen",
        "Flesh": _flesh(found["flesh"], found["inverted"]),
        "Jaw": motion,
        "Contact": _contact(found["crossing"], found["scan_crossing"]),
        "Round trip": _trip(found["round_trip"]),
        "Solver": f"{SOLVERS[found['solver']]} {ENDINGS[found['status']]}; "
        f"{found['iterations']} steps, {found['seconds']:.1f} s",
    }
    if found["warnings"]:
        facts["Warnings"] = "; ".join(warning["message"] for warning in found["warnings"])
    return "".join(f"<dt>{words}</dt><dd>{escape(value)}</dd>" for words, value in facts.items())


def _flesh(flesh: dict[str, Any] | None, inverted: int) -> str:
    if flesh is None:
        return f"{inverted} inverted tets; more is not known, the rig is from an older version"
    return (
        f"{inverted} inverted tets; volume {flesh['volume_percent']:+.2f} %; tets between "
        f"{figure(flesh['det_least'])} and {figure(flesh['det_most'])} of their volume; residual "
        f"force {flesh['residual']:.0e}, {'stable' if flesh['minimum'] else 'unstable'}"
    )


def _contact(fit: dict[str, Any] | None, scan: dict[str, Any] | None) -> str:
    if fit is None:
        return "not known, the model names no lips"
    parts = []
    for name, words in CONTACTS.items():
        if fit[name] is not None:
            scanned = "" if scan is None else f" ({scan[name]:.1f} in the scan)"
            parts.append(f"{words} {fit[name]:.1f} mm{scanned}")
    return "; ".join(parts)


def _trip(trip: dict[str, Any] | None) -> str:
    if trip is None:
        return "not tried"
    if not trip["reached"]:
        return "the pose cannot be reached from rest"
    words = (
        f"simulated from rest: mean {figure(trip['skin_mean_mm'], 3)} mm, greatest "
        f"{figure(trip['skin_max_mm'], 3)} mm away; fitted again: mean "
        f"{figure(trip['refit_mean_mm'], 3)} mm"
    )
    if trip["activation_error"] is not None:
        words += (
            f", activations of the excited muscles within {100 * trip['activation_error']:.1f} %"
        )
    return words


def _regions(regions: dict[str, Any]) -> str:
    if not regions:
        return ""
    ordered = sorted(regions.items(), key=lambda item: -item[1]["mean_mm"])
    rows = "".join(
        row(
            escape(name.replace("_", " ")),
            ("", f"{seen['mean_mm']:.2f}"),
            ("", f"{seen['p95_mm']:.2f}"),
            ("", f"{seen['max_mm']:.2f}"),
            ("", f"{100 * seen['coverage']:.0f} %"),
        )
        for name, seen in ordered
    )
    return (
        "<details><summary>Regions</summary><table><thead><tr><th scope='col'>Region</th>"
        "<th scope='col'>Mean mm</th><th scope='col'>95 % mm</th><th scope='col'>Max mm</th>"
        f"<th scope='col'>Seen</th></tr></thead><tbody>{rows}</tbody></table></details>"
    )


def _faults(muscles: dict[str, Any]) -> str:
    faulty = {name: muscle["faults"] for name, muscle in muscles.items() if muscle["faults"]}
    if not faulty:
        return ""
    lines = "".join(
        f"<li>{escape(name)} {escape(', '.join(faults))}</li>" for name, faults in faulty.items()
    )
    return (
        f"<details><summary>{len(faulty)} muscles beyond what muscles can do</summary>"
        f"<ul>{lines}</ul></details>"
    )


MEANS = {"train_mean_mm": "mean of training scans", "test_mean_mm": "mean of unseen scans"}
FILES = {
    "rig.npz": "the rig in one file: model, matrix S and expressions",
    "rig.glb": "the skin with one named morph target per expression",
    "activations.npz": "muscle activations, jaw and flesh of every expression",
    "activations.csv": "the same activations as a table",
    "muscle_weights.npz": "the matrix S, tetrahedra × muscles",
    "report.json": "the figures of this page",
}

WHOLE = {"flesh.inverted", "muscles.beyond"}  # checks whose figures are counts
FEW = 4  # expressions that are named one by one, even where a check fails in all of them
LONG = 200  # letters of a detail that is only told with its expression


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
