"""The section of docs/science/benchmarks.md about living flesh."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from benchmarks.documents import Figures, Plot, Section, Table

Part = Table | Plot | str


def section(figures: Figures) -> Section:
    """Return the section; it has the shows that were run."""
    parts = [
        part for name, tell in PARTS.items() if name in figures for part in tell(figures[name])
    ]
    return Section(
        title="Living flesh",
        compared="Simulation against known answers, and on a fitted person: contact with what the "
        "same scenes do without it, sliding with pinned flesh, edited persons with themselves "
        "before, a recording played by muscles with the shapes that it was made for.",
        parts=parts,
    )


def _checks(found: Figures) -> Sequence[Part]:
    rows = [
        ["uniform stretch, error relative to the bar's length", found["stretch_error"]],
        ["volume under pressure, error relative to the linear modulus", found["pressure_error"]],
        ["order of convergence when tets get smaller", found["refinement_order"]],
        ["momentum of flesh that flies, drift", found["momentum_drift"]],
        ["energy of flesh that flies, growth", found["energy_growth"]],
    ]
    return [Table(["check", "found"], [[words, f"{value:.2g}"] for words, value in rows])]


def _contact(found: Figures) -> Sequence[Part]:
    rows = [
        [
            scene.replace("_", " "),
            both["pressed_mm"],
            both["without"]["penetration_max_mm"],
            both["with"]["penetration_max_mm"],
            both["without"]["behind_teeth"],
            both["with"]["behind_teeth"],
            both["with"]["frame_s"],
        ]
        for scene, both in found.items()
    ]
    header = [
        "scene",
        "pressed, mm",
        "deepest without contact, mm",
        "with, mm",
        "vertices behind teeth without",
    ]
    return [Table([*header, "with", "a frame, s"], rows, "Contact")]


def _sliding(found: Figures) -> Sequence[Part]:
    rows = [
        [name, *(each["at_skull_mm"][key] for key in each["at_skull_mm"]), each["brows_mm"]]
        for name, each in found.items()
    ]
    keys = list(found["sliding"]["at_skull_mm"])
    header = ["flesh", *(f"along the skull, {key}, mm" for key in keys), "brows' skin, mm"]
    return [Table(header, rows, "Brows raised")]


def _speed(found: Figures) -> Sequence[Part]:
    keys = {"median_s": "median, s", "p95_s": "95 % below, s", "max_s": "longest, s"}
    rows = [
        [name.replace("_", "-"), *(found[name][key] for key in keys)]
        for name in ("quasi_static", "dynamic")
    ]
    caption = f"A frame with contact, {found['vertices']:,} vertices and {found['tets']:,} tets"
    parts: list[Part] = [Table(["", *keys.values()], rows, caption)]
    if found["sizes"]:
        sizes = [
            [each["edge_mm"], each["vertices"], each["tets"], each["quasi_static"]["median_s"]]
            for each in found["sizes"]
        ]
        parts.append(Table(["edge, mm", "vertices", "tets", "a frame, s"], sizes, "By size"))
    return parts


def _effects(found: Figures) -> Sequence[Part]:
    rows = [
        [
            name.replace("_", " "),
            each["change_ml"],
            each["moved_mm"],
            each["cheeks_over_nose"],
            *_means(each["motion_mm"], each["drift_mm"]),
            each["penetration_mm"],
        ]
        for name, each in found["edits"].items()
    ]
    header = [
        *("edit", "volume, ml", "face at rest moves, mm", "cheeks outward over nose and lips"),
        "expressions move, mm",
    ]
    keys = ("motion_mm", "blended_mm", "fibre_mm", "projected_mm")
    missed = [[name, *(each[key] for key in keys)] for name, each in found["fibres"].items()]
    names = ["expression", "moves, mm", "missed with six numbers a muscle, mm"]
    return [
        Table([*header, "and drift, mm", "deepest contact, mm"], rows, "Edits"),
        Table([*names, "fibres, fitted, mm", "fibres, projected, mm"], missed, "Fibre muscles"),
    ]


def _means(*each: Mapping[str, float | None]) -> list[float | None]:
    known = [[value for value in values.values() if value is not None] for values in each]
    return [sum(values) / len(values) if values else None for values in known]


def _performance(found: Figures) -> Sequence[Part]:
    glb = found["glb"]
    direct = found["direct_mm"]
    rows: list[list[Any]] = [
        ["frames", found["frames"]],
        ["inverted tets", found["inverted"]],
        ["deepest contact, mm", found["penetration_max_mm"]],
        ["a frame, median ms", found["frame_ms"]],
        ["off the shapes themselves, mean, mm", direct["mean"]],
        ["the same in the worst frame, mm", direct["worst_frame"]],
        ["GLB, MB", round(glb["bytes"] / 1e6, 2)],
        ["GLB, most a vertex is off, mm", glb["max_error_mm"]],
        ["GLB, errors of the Khronos validator", glb["errors"]],
    ]
    return [Table(["figure", "found"], rows, "A recording of ten seconds")]


def _jobs(found: Figures) -> Sequence[Part]:
    keys = ("seconds", "change_percent", "drift_mm", "penetration_mm", "inverted")
    rows = [[name.replace("_", " "), *(each[key] for key in keys)] for name, each in found.items()]
    header = ["job", "s", "volume, %", "expressions drift, mm", "deepest contact, mm", "inverted"]
    return [Table(header, rows, "As jobs of a service")]


PARTS: dict[str, Callable[[Figures], Sequence[Part]]] = {
    "checks": _checks,
    "contact": _contact,
    "sliding": _sliding,
    "speed": _speed,
    "effects": _effects,
    "performance": _performance,
    "jobs": _jobs,
}
