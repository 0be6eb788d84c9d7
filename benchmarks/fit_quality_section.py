"""The section of docs/science/benchmarks.md on fit quality: tables and plots of its figures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from benchmarks import documents, plots
from benchmarks.documents import Figures, Plot, Section, Table
from benchmarks.subject_fits import CONTROLS
from benchmarks.subjects import SETS

DISTANCES = {
    "train_mean_mm": "training, mm",
    "test_mean_mm": "unseen, mm",
    "inverted": "inverted tets",
    "det_least": "flattest tet",
    "lip_crossing_max_mm": "lips crossing, mm",
    "bite_max_mm": "teeth in teeth beyond the neutral, mm",
    "condyle_out_mm": "condyles off their tracks, mm",
    "snap_max_mm": "simulated from rest, greatest, mm",
    "certificates_bad": "bad certificates",
    "certificates": "of",
    "rounds": "rounds",
    "geometry_seconds": "s",
    "geometry_cpu_seconds": "processor's s",
    "lips_mm": "lips in funnel and beam, mm",
    "nose_mm": "nose in sniff, mm",
}
MUSCLES = {
    "beyond": "muscles beyond, sum",
    "beyond_worst": "worst expression",
    "inside_out": "inside out",
    "volume_worst_percent": "change of volume, %",
    "fibres_longest": "longest fibres",
    "stretch_longest": "greatest stretch",
    "lengthened": "lengthened, sum",
    "at_bound": "at a bound, worst expression",
    "at_fibre_bound": "at that of lengthening",
    "closers": "closers in an open jaw, sum",
    "asymmetry": "left against right",
    "strayed": "flesh outside its muscle",
    "activation_error": "change by noise",
    "contraction_change": "of a contraction, most",
}
COMPARISONS = {
    "ablation_mean_mm": "geometric S, training, mm",
    "three_scans_test_mean_mm": "S of three scans, unseen, mm",
    "per_tet_train_mean_mm": "P, training, mm",
    "per_tet_max_mm": "P, greatest, mm",
    "per_tet_inverted": "P, inverted tets",
    "followed_S": "bump followed by S",
    "followed_P": "by P",
    "geometry_ratio": "fit of S within limits by free, processor's time",
}
DETAILS = {
    "mean_mm": "mean, mm",
    "p95_mm": "95 % below, mm",
    "max_mm": "max, mm",
    "inverted": "inverted tets",
    "lip_crossing_mm": "lips crossing, mm",
    "scan_lip_crossing_mm": "in the scan, mm",
    "beyond": "muscles beyond",
    "verdict": "certificate",
}


def section(figures: Figures) -> Section:
    """Return the document's section."""
    people: dict[str, Figures] = figures["subjects"]
    fitted: dict[tuple[str, ...], Figures] = {
        (subject, scans, controls): person[scans][controls]
        for subject, person in people.items()
        for scans in SETS
        for controls in CONTROLS
        if controls in person.get(scans, {})
    }
    compared: dict[tuple[str, ...], Figures] = {
        (subject, scans): person[scans]
        for subject, person in people.items()
        for scans in SETS
        if scans in person and COMPARISONS.keys() & person[scans].keys()
    }
    each = ["subject", "scans", "controls"]
    details = [
        [*which, name, found["role"], *(found[key] for key in DETAILS)]
        for which, of_set in fitted.items()
        for name, found in of_set["expressions"].items()
    ]
    alike = ", ".join(
        f"{found['same_muscle_other_person']:.2f} ({scans}, {controls})"
        for scans in SETS
        for controls in CONTROLS
        if (found := figures.get(scans, {}).get(controls))
        and found["same_muscle_other_person"] is not None
    )
    parts: list[Table | Plot | str] = [
        Table(
            [*each, *DISTANCES.values()],
            _rows({which: {**it, **it.get("hard", {})} for which, it in fitted.items()}, DISTANCES),
        ),
        Table(
            [*each, *MUSCLES.values()],
            _rows({which: {**it, **it["round_trip"]} for which, it in fitted.items()}, MUSCLES),
        ),
    ]
    if alike:
        parts.append(f"Contractions of two people's muscles in the same expression: {alike}.")
    if compared:
        header = ["subject", "scans", *COMPARISONS.values()]
        parts.append(Table(header, _rows(compared, COMPARISONS)))
    return Section(
        title="Fit quality",
        compared=(
            "Fitted faces against the scans they were fitted to, vertex by vertex over the face "
            "skin. S is fitted to the training scans; the unseen ones are fitted by activations "
            "and jaw alone. The strong scans are a laugh, a scream, a whistle, a pout and a snarl "
            "of one side, with the unseen scans of the standard ones. Muscles, jaw and contact are "
            "as the rig's certificate has them; noise is 0.2 mm on the unseen scans. A "
            "muscle is at a bound of what muscles can do with less than a tenth left of the way "
            "from rest to it. For "
            "comparison: the training scans by activations with the geometric "
            "S of the model, and by the per-tet model P; the unseen scans with an S of the first "
            "three training scans; and how much of a bump of 6 mm on the cheek of an unseen scan, "
            "which no face can make, each model follows."
        ),
        parts=[
            *parts,
            *_plots(fitted),
            Table([*each, "expression", "role", *DETAILS.values()], details),
        ],
    )


def _rows(found: Mapping[tuple[str, ...], Figures], columns: Mapping[str, str]) -> list[list[Any]]:
    return [[*which, *(figures.get(key) for key in columns)] for which, figures in found.items()]


def _plots(fitted: Mapping[tuple[str, ...], Figures]) -> list[Plot]:
    """Return a plot of the mean distances for each set and controls, all subjects side by side."""
    drawn = []
    for scans, controls in dict.fromkeys(which[1:] for which in fitted):
        of_people = {
            subject: figures["expressions"]
            for (subject, *which), figures in fitted.items()
            if which == [scans, controls]
        }
        names = [
            name
            for name in next(iter(of_people.values()))
            if all(name in expressions for expressions in of_people.values())
        ]
        means = {
            subject: [expressions[name]["mean_mm"] for name in names]
            for subject, expressions in of_people.items()
        }
        plot = documents.IMAGES / f"fit_quality-errors-{scans}-{controls}.png"
        plots.bars(plot, "Mean distance to the scan", "mm", names, means)
        caption = f"Mean distance to the scan of every expression, {scans}, {controls} controls"
        drawn.append(Plot(plot, caption))
    return drawn
