"""``report.html``: the certificate for a person to read, in one file that needs no network."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from html import escape
from importlib import resources
from io import BytesIO
from pathlib import Path
from string import Template
from typing import Any

from PIL import Image

from solver.anatomy.physiology import JAW_RANGES, JAW_SOURCE, MUSCLE_SOURCE
from solver.drawing.head import both_sides
from solver.fitting.contraction import STILL
from solver.rig.report.checks import overall
from solver.rig.report.report import expression_words, figure, millimetres, mover_notes, mover_words
from solver.rig.rig import ROLES

WORDS = {"good": "Good", "usable": "Usable", "bad": "Look at it"}
SHAPES = {  # told apart by shape, not by colour alone
    "good": '<circle cx="8" cy="8" r="7.2"/><path d="M4.6 8.3l2.3 2.4 4.5-5"/>',
    "usable": '<path d="M8 1.2L15.3 14.5H.7z"/><path d="M8 6v4.2M8 11.9v.8"/>',
    "bad": '<circle cx="8" cy="8" r="7.2"/><path d="M5.3 5.3l5.4 5.4M10.7 5.3l-5.4 5.4"/>',
}
TILES = {  # checks whose worst figure is shown large -> words
    "flesh.inverted": "inverted tets",
    "flesh.volume": "greatest change of volume",
    "muscles.beyond": "muscles out of range, at most",
    "trip.skin": "simulated from rest, at most",
}
WHOLE = {"flesh.inverted", "muscles.beyond"}  # checks whose figures are counts
MEANS = {"train_mean_mm": "mean of training scans", "test_mean_mm": "mean of unseen scans"}
FILES = {
    "rig.npz": "the rig in one file: model, matrix S and expressions",
    "rig.glb": "the skin with one named morph target per expression",
    "activations.npz": "muscle activations, jaw and flesh of every expression",
    "activations.csv": "the same activations as a table",
    "muscle_weights.npz": "the matrix S, tetrahedra × muscles",
    "report.json": "the figures of this page",
}
STRONG_PERCENT = 40.0  # change of a fibre's length at which a cell has its full colour
PICTURE_WIDTH, JPEG_QUALITY = 1400, 86  # of a fit's picture: sharp on a large screen
FEW = 4  # expressions that are named one by one, even where a check fails in all of them
LITTLE = 0.5  # information of a muscle below which most of what is to be known is not
MOST = 6  # muscles that contract most, shown with an expression
PARTS = {  # a check's code, or its beginning -> the part of an expression that has more of it
    "muscles": "muscles",
    "solver.warnings": "warnings",
}
LONG = 200  # letters of a detail that is only told with its expression


def write_page(path: Path, figures: dict[str, Any]) -> None:
    """Write the page of a rig's ``report.json`` values, with the pictures found beside ``path``."""
    page = resources.files(__package__).joinpath("report.html").read_text(encoding="utf-8")
    anchors = {name: f"e{number}" for number, name in enumerate(figures["expressions"])}
    words = {name: escape(value) for name, value in _words(figures).items()}
    markup = _markup(figures, anchors, path.parent)
    path.write_text(Template(page).substitute(words, **markup), encoding="utf-8")


def _words(figures: dict[str, Any]) -> dict[str, str]:
    made, checks = figures["made_with"], figures["checks"]
    template = made["template"]
    ranges = ", ".join(
        f"{name.replace('_', ' ')} {low:g} to {high:g}" for name, (low, high) in JAW_RANGES.items()
    )
    return {
        "verdict": figures["verdict"],
        "expression_count": f"{len(figures['expressions'])}",
        "muscle_count": f"{figures['muscles']}",
        "tet_count": f"{figures['tets']:,}",
        "check_count": f"{len(checks)}",
        "good_count": f"{sum(check['verdict'] == 'good' for check in checks)}",
        "muscle_source": MUSCLE_SOURCE,
        "jaw_ranges": ranges.replace("-", "−"),
        "jaw_source": JAW_SOURCE,
        "settings": ", ".join(f"{name} {value}" for name, value in figures["settings"].items()),
        "time": ", ".join(f"{name} {spent:.1f} s" for name, spent in figures["seconds"].items()),
        "versions": ", ".join(f"{name} {each}" for name, each in made["versions"].items() if each),
        "anatomy": f"{template['name']} {template['version']}",
        "template_sha256": template["content_sha256"],
        "model_sha256": made["model_sha256"],
        "weights_sha256": made["weights_sha256"],
    }


def _markup(figures: dict[str, Any], anchors: dict[str, str], folder: Path) -> dict[str, str]:
    expressions = figures["expressions"]
    articles = [
        _article(anchors[name], name, found, folder / f"fit_{name}.png")
        for name, found in expressions.items()
    ]
    there = {name: words for name, words in FILES.items() if (folder / name).exists()}
    return {
        "tag": _tag(figures["verdict"]),
        "use": _use(figures, anchors),
        "groups": _groups(figures["checks"]),
        "tiles": _tiles(figures),
        "todo": _todo(figures, anchors),
        "checks": _checks(figures["checks"], anchors),
        "rows": _rows(expressions, anchors),
        "articles": "\n".join(articles),
        "muscle_columns": "".join(_element("th", escape(each), scope="col") for each in anchors),
        "muscles": _muscles(expressions),
        "information": _information(figures["information"]),
        "fibres": _fibres(figures.get("fibres")),
        "files": _definitions({_element("a", name, href=name): there[name] for name in there}),
    }


# Small pieces: all markup but the pictures and signs comes from here.


def _element(tag: str, *content: str, **attributes: str) -> str:
    """Return an element with markup in it; ``class_`` is the class, attributes of "" are none."""
    given = "".join(
        f' {name.rstrip("_")}="{escape(value)}"' for name, value in attributes.items() if value
    )
    return f"<{tag}{given}>{''.join(content)}</{tag}>"


def _row(heading: str, *cells: tuple[str, str]) -> str:
    """Return a table's row from markup: its heading and cells of (class, content)."""
    inside = [_element("td", content, class_=kind) for kind, content in cells]
    return _element("tr", _element("th", heading, scope="row"), *inside)


def _definitions(facts: dict[str, str]) -> str:
    """Return a list's inside: markup -> text."""
    return "".join(
        _element("dt", words) + _element("dd", escape(value)) for words, value in facts.items()
    )


def _fold(summary: str, content: str) -> str:
    return _element("details", _element("summary", summary), content)


def _tag(verdict: str) -> str:
    sign = (
        '<svg viewBox="0 0 16 16" fill="none" stroke="currentColor" stroke-width="1.6" '
        f'aria-hidden="true">{SHAPES[verdict]}</svg>'
    )
    return _element("span", sign, WORDS[verdict], class_=f"tag {verdict}")


def _link(name: str, anchors: dict[str, str], code: str = "") -> str:
    """Return a link to an expression, to the part of it that a check's ``code`` speaks of."""
    return _element("a", escape(name), href=_place(name, anchors, code))


def _place(name: str, anchors: dict[str, str], code: str) -> str:
    parts = [part for start, part in PARTS.items() if code.startswith(start)]
    return "-".join([f"#{anchors[name]}", *parts])


# The rig as a whole.


def _use(figures: dict[str, Any], anchors: dict[str, str]) -> str:
    """Return what the rig is good for; each limit leads to the worst of it."""
    if "ready" not in figures:  # a certificate from before limits were named
        return escape(figures["use"])
    limits = [
        _element("a", escape(each["words"]), href=_place(each["expression"], anchors, each["code"]))
        for each in figures["limits"]
    ]
    return f"{'; '.join([escape(figures['ready']), *limits])}."


def _groups(checks: list[dict[str, Any]]) -> str:
    groups: dict[str, list[Any]] = {}
    for check in checks:
        groups.setdefault(check["group"], []).append(check["verdict"])
    return "".join(
        _element("li", escape(name), " ", _tag(overall(verdicts)))
        for name, verdicts in groups.items()
    )


def _tiles(figures: dict[str, Any]) -> str:
    worst = {check["code"]: check for check in figures["checks"]}
    tiles = [
        (words, figure(figures[key], 2), "mm")
        for key, words in MEANS.items()
        if figures[key] is not None
    ]
    tiles += [
        (words, figure(worst[code]["value"], 0 if code in WHOLE else 2), worst[code]["unit"])
        for code, words in TILES.items()
        if code in worst
    ]
    lines = []
    for words, value, unit in tiles:
        number = _element("strong", value, " ", _element("em", escape(unit)))
        lines.append(_element("div", number, escape(words), class_="tile"))
    return "\n".join(lines)


def _todo(figures: dict[str, Any], anchors: dict[str, str]) -> str:
    failed = [check for check in figures["checks"] if check["verdict"] != "good"]
    failed.sort(key=lambda check: check["verdict"] != "bad")
    told = [(check["verdict"], _advice(check, anchors)) for check in failed]
    warnings = [
        _element("p", escape(each["message"]), " ", _element("code", escape(each["code"])))
        for each in figures["warnings"]
    ]
    told += [("usable", words) for words in warnings]
    if not told:
        return _element("p", "Nothing. Use the rig.")
    lines = [_element("li", _tag(verdict), _element("div", words)) for verdict, words in told]
    return _element("ul", *lines, class_="todo")


def _advice(check: dict[str, Any], anchors: dict[str, str]) -> str:
    told = check["detail"] if len(check["detail"]) < LONG else check.get("says", "")
    detail = f": {escape(told)}" if 0 < len(told) < LONG else ""
    code = check["code"]
    others = [_link(name, anchors, code) for name in check["failed"] if name != check["worst"]]
    more = f" Also in {', '.join(others)}." if others else ""
    if len(check["failed"]) == len(anchors) > FEW:
        more = " So in every expression."
    where = f": {_value(check)} in {_link(check['worst'], anchors, code)}{detail}.{more}"
    title = _element("b", _element("a", escape(check["title"]), href=f"#{code}"))
    return _element("p", title, where) + _element("p", escape(check["advice"]))


def _checks(checks: list[dict[str, Any]], anchors: dict[str, str]) -> str:
    lines, group = [], None
    for check in checks:
        if check["group"] != group:
            group = check["group"]
            heading = _element("th", escape(group), class_="group", colspan="6", scope="rowgroup")
            lines.append(_element("tr", heading))
        lines.append(
            _row(
                _element("span", escape(check["title"]), id=check["code"])
                + _element("small", escape(check["meaning"])),
                ("left", _tag(check["verdict"])),
                ("nowrap", _value(check)),
                (
                    "left",
                    "" if check["value"] == 0 else _link(check["worst"], anchors, check["code"]),
                ),
                ("nowrap", _limit(check, "good")),
                ("nowrap", _limit(check, "usable")),
            )
        )
    return "\n".join(lines)


def _value(check: dict[str, Any]) -> str:
    words = "none" if check["value"] == 0 else f"{figure(check['value'])} {check['unit']}"
    return escape(words.strip())


def _limit(check: dict[str, Any], name: str) -> str:
    if check[name] is None:
        return "any"
    if check[name] == 0:
        return "none"
    return f"{'≥' if check['least'] else '≤'} {figure(check[name])}"


def _rows(expressions: dict[str, Any], anchors: dict[str, str]) -> str:
    widest = max((found["mean_mm"] for found in expressions.values()), default=0.0) or 1.0
    lines = []
    for name, found in expressions.items():
        trip = found["round_trip"]
        mean, p95, most = millimetres(found)
        bar = _element("i", style=f"width:{100 * found['mean_mm'] / widest:.0f}%")
        lines.append(
            _row(
                _link(name, anchors),
                ("left", _tag(found["verdict"])),
                ("left", ROLES.get(found["role"], escape(found["role"]))),
                ("bar", bar + _element("b", mean)),
                ("", p95),
                ("", most),
                ("nowrap", f"{100 * found['coverage']:.0f} %"),
                ("nowrap", f"{found['jaw_motion']['opening_mm']:.1f} mm".replace("-", "−")),
                ("nowrap", "" if trip is None else f"{figure(trip['skin_mean_mm'], 2)} mm"),
                ("", str(found["iterations"])),
                ("", f"{found['seconds']:.1f}"),
            )
        )
    return "\n".join(lines)


def _muscles(expressions: dict[str, Any]) -> str:
    """Return the bodies of muscles by expressions, both sides of a muscle together.

    Compartments are folded under their whole.
    """
    names = next(iter(expressions.values()))["muscles"] if expressions else {}
    bodies = []
    for whole, parts in _by_whole(names, sorted(names, key=lambda name: (both_sides(name), name))):
        of_each = [[found["muscles"][name] for name in parts] for found in expressions.values()]
        heading = escape(whole)
        rows = []
        if len(parts) > 1:
            heading = _fold(heading, "")
            for part, *cells in zip(parts, *of_each, strict=True):
                name = _element("th", escape(part.removeprefix(f"{whole}.")), scope="row")
                rows.append(_element("tr", name, *map(_muscle_cell, cells), class_="part"))
        cells = [_muscle_cell(_whole_muscle(parts, each)) for each in of_each]
        first = _element("tr", _element("th", heading, scope="row"), *cells)
        bodies.append(_element("tbody", first, *rows))
    return "\n".join(bodies)


def _by_whole(muscles: dict[str, Any], names: Iterable[str]) -> list[tuple[str, list[str]]]:
    """Return each whole among the ``names`` of muscles with its parts; alone it is its own."""
    found: dict[str, list[str]] = {}
    for name in names:
        # reports from before compartments have whole muscles only
        found.setdefault(muscles[name].get("whole", name), []).append(name)
    return list(found.items())


def _whole_muscle(names: list[str], parts: list[dict[str, Any]]) -> dict[str, Any]:
    """Return what is shown of a whole: its part that contracts most, and the faults of all."""
    if len(parts) == 1:
        return parts[0]
    fibres = min((part["fibres"] for part in parts if part["fibres"] is not None), default=None)
    faults = [
        f"{name} {each}" for name, part in zip(names, parts, strict=True) for each in part["faults"]
    ]
    return {"fibres": fibres, "faults": faults}


def _muscle_cell(muscle: dict[str, Any]) -> str:
    if muscle["fibres"] is None:
        return _element("td")
    contraction = 1.0 - muscle["fibres"]
    percent = 100.0 * contraction
    strength = 0.75 * min(abs(percent) / STRONG_PERCENT, 1.0)
    colour = "pull" if contraction > 0 else "push"
    is_still = STILL.is_still(contraction)
    return _element(
        "td",
        f"{percent:.0f}".replace("-", "−") if not is_still else "·",
        class_="fault" if muscle["faults"] else "",
        title="; ".join(muscle["faults"]),
        style="" if is_still else f"background:rgba(var(--{colour}),{strength:.2f})",
    )


def _information(found: dict[str, Any] | None) -> str:
    """Return the fold of muscles little known, the least first, and of pairs not separated."""
    if found is None:
        return ""
    known = sorted(found["muscles"].items(), key=lambda item: item[1])
    space = "\N{NO-BREAK SPACE}"
    little = [f"{name} {100 * part:.0f}{space}%" for name, part in known if part < LITTLE]
    pairs = [
        f"{' and '.join(pair['muscles'])} ({pair['correlation']:+.2f})".replace("-", "−")
        for pair in found["confused"]
    ]
    summary = (
        f"The training scans ({found['scans']}) determine {len(known) - len(little)} of "
        f"{len(known)} muscles: of how much flesh each fills, and where, more than half of the "
        "uncertainty is gone."
    )
    lists = {"Less known": little, "Not separated (correlation)": pairs}
    facts = {name: "; ".join(items) for name, items in lists.items() if items}
    inside = _element("p", summary) + _element("dl", _definitions(facts))
    return _fold("Muscles the scans determine", inside)


def _fibres(found: dict[str, Any] | None) -> str:
    """Return the fold of fibre muscles calibrated to the scans, beside S; "" without any."""
    if found is None:
        return ""
    heads = ("Expression", "S mm", "Calibrated mm", "Not calibrated mm")
    keys = ("blended_mm", "fibre_mm", "uncalibrated_mm")
    rows = [
        _row(escape(name), *(("", figure(fit[key], 2)) for key in keys))
        for name, fit in found["expressions"].items()
    ]
    columns = [_element("th", words, scope="col") for words in heads]
    head = _element("thead", _element("tr", *columns))
    means = [
        f"{words} {figure(found['means'][f'{role}_fibre_mm'], 2)} mm"
        for role, words in (("train", "training scans"), ("test", "unseen scans"))
        if found["means"][f"{role}_fibre_mm"] is not None
    ]
    summary = f"Fibre muscles, one activation each: {', '.join(means)} on average"
    return _fold(summary, _element("table", head, _element("tbody", *rows)))


# One expression: its picture, figures, regions and faults.


def _article(anchor: str, name: str, found: dict[str, Any], picture: Path) -> str:
    return _element(
        "article",
        _element("header", _element("h3", escape(name)), _tag(found["verdict"])),
        _picture(picture, name),
        _element("dl", _definitions(expression_words(found))),
        _element("div", _warnings(found["warnings"]), id=f"{anchor}-warnings"),
        _element(
            "div",
            _movers(found.get("movers")),
            _uneven((found.get("movers") or {}).get("uneven", [])),
            _faults(found["muscles"]),
            id=f"{anchor}-muscles",
        ),
        _regions(found["by_region"]),
        id=anchor,
    )


def _warnings(warnings: list[dict[str, Any]]) -> str:
    """Return warnings, each with the code by which the handbook of errors has it."""
    lines = [
        _element("li", escape(each["message"]), " ", _element("code", escape(each["code"])))
        for each in warnings
    ]
    return _element("p", "Warnings") + _element("ul", *lines) if lines else ""


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


def _regions(regions: dict[str, Any]) -> str:
    if not regions:
        return ""
    heads = ("Region", "Mean mm", "95 % mm", "Max mm", "Seen")
    rows = []
    for name, seen in sorted(regions.items(), key=lambda item: -item[1]["mean_mm"]):
        cells = (*millimetres(seen), f"{100 * seen['coverage']:.0f} %")
        rows.append(_row(escape(name.replace("_", " ")), *(("", words) for words in cells)))
    columns = [_element("th", words, scope="col") for words in heads]
    head = _element("thead", _element("tr", *columns))
    return _fold("Regions", _element("table", head, _element("tbody", *rows)))


def _movers(found: dict[str, Any] | None) -> str:
    """Return the table of who contracts most, and of all whom literature names or excludes.

    There is none of an older certificate, nor of muscles without fibres.
    """
    if not found or not found["contractions"]:
        return ""
    by_muscle = {each["muscle"]: each["contraction"] for each in found["contractions"]}
    notes = mover_notes(found["actions"])
    most = [name for name, by in by_muscle.items() if by > 0.0][:MOST]
    shown = {name: by for name, by in by_muscle.items() if name in most or name in notes}
    widest = max(map(abs, shown.values()), default=0.0) or 1.0
    rows = []
    for name, by in shown.items():
        kind = "pull" if by > 0.0 else "push"
        width = f"width:{100 * abs(by) / widest:.0f}%;background:rgba(var(--{kind}),.3)"
        number = _element("b", f"{100 * by:.0f}\N{NO-BREAK SPACE}%".replace("-", "−"))
        makes, against = notes.get(name, ("", ""))
        fault = _element("span", escape(against), class_="tag bad") if against else ""
        rows.append(
            _row(
                escape(name),
                ("bar", _element("i", style=width) + number),
                ("left", "; ".join(filter(None, (escape(makes), fault)))),
            )
        )
    caption = _element("caption", escape(mover_words(found["actions"])))
    return _element("table", caption, _element("tbody", *rows), class_="movers")


def _uneven(words: list[str]) -> str:
    """Return the fold of muscles that contract more than those of the other side."""
    lines = [_element("li", escape(each)) for each in words]
    summary = "Left against right, where the scan moves alike on both"
    return _fold(summary, _element("ul", *lines)) if lines else ""


def _faults(muscles: dict[str, Any]) -> str:
    """Return the fold of what muscles cannot do, a line for each whole muscle."""
    faulty = [name for name, muscle in muscles.items() if muscle["faults"]]
    lines = []
    for _, parts in _by_whole(muscles, faulty):
        words = "; ".join(f"{name} {', '.join(muscles[name]['faults'])}" for name in parts)
        lines.append(_element("li", escape(words)))
    muscles_words = "1 muscle" if len(faulty) == 1 else f"{len(faulty)} muscles"
    summary = f"{muscles_words} beyond what muscles can do"
    return _fold(summary, _element("ul", *lines)) if lines else ""
