"""The certificate's page: what it says of one expression, and of the muscles in all of them."""

from __future__ import annotations

import base64
from html import escape
from io import BytesIO
from pathlib import Path
from typing import Any

from PIL import Image

from solver.drawing.colours import both_sides
from solver.rig.web_markup import figure, row, tag

PICTURE_WIDTH, JPEG_QUALITY = 1400, 86
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
STRONG_PERCENT = 40.0
"""Change of a fibre's length at which a cell has its full colour."""


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
        return "the pose can not be reached from rest"
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
