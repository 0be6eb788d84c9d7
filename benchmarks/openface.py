"""Recordings of OpenFace: whether a face that plays one opens and widens as its landmarks do.

OpenFace finds 68 landmarks beside its action units, and nothing is driven by them. Four distances
between them, by that of the eyes, are compared over time with the same distances on the skin that
learned controls make of the units: ``r`` is their correlation, ``regression`` that of what a linear
regression on the units says, each half of the take by the other, and ``of_regression`` the ratio.
With ``--gaps`` a tenth of the frames have no face, in runs of 3 to 40; figures are of all frames.
"""

from __future__ import annotations

import argparse
import csv
import logging
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks import played_person, report
from benchmarks.documents import Figures, Section, Table
from benchmarks.played_person import PlayedPerson
from solver.animation import shape_weights
from solver.kinds.scene_recording import Recording
from solver.scans.openface import INTENSITIES, read_openface
from solver.surface import Floats

# pairs of landmarks of each distance: of the 68, and of the detector's on the template's skin
DISTANCES = {
    "mouth_opening": (((62, 66),), ((13, 14),)),
    "eye_opening": (
        ((37, 41), (38, 40), (43, 47), (44, 46)),
        ((160, 144), (158, 153), (385, 380), (387, 373)),
    ),
    "inner_brow": (((21, 39), (22, 42)), ((107, 133), (336, 362))),
    "lip_width": (((48, 54),), ((61, 291),)),
}
EYES = ((36, 45), (33, 263))
GAP_PART = 0.1
GAP_FRAMES = (3, 40)
QUICK_FRAMES = 60

Pair = tuple[int, int]
Columns = dict[str, np.ndarray]


def main() -> None:
    """Run from the command line."""
    parser = report.parser(__doc__ or "")
    played_person.add_options(parser)
    parser.add_argument("csv", type=Path, nargs="?", help="of OpenFace; quick runs make one")
    parser.add_argument("--landmarks", type=Path, help="NPZ of (f, 68, 3), where the CSV has none")
    parser.add_argument("--gaps", type=int, help="seed of frames without a face")
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    report.finish(run(options), options, section)


def run(options: argparse.Namespace) -> Figures:
    """Return the figures of the chosen person and take."""
    with tempfile.TemporaryDirectory() as folder:
        if options.csv is not None:
            table = _read(options.csv)
        elif options.quick:
            table = _made(QUICK_FRAMES)
        else:
            raise SystemExit("name a CSV of OpenFace")
        own = _landmarks(table, options.landmarks)
        path = Path(folder) / "take.csv"
        hidden = _write(path, table, options.gaps)
        take = read_openface(path, Recording(asset="take"))
    person = PlayedPerson.of(options)
    controls = person.controls()
    weights = shape_weights(take, controls.names)
    skins = [controls.skin(row).astype(np.float64) for row in weights]
    units = np.column_stack([table[name] for name in INTENSITIES if name in table])
    figures: Figures = {"frames": len(weights), "hidden": hidden, "r": {}, "regression": {}}
    for name, (theirs, ours) in DISTANCES.items():
        truth = _distances(own, theirs, EYES[0])
        played = _distances_on(person, skins, ours)
        figures["r"][name] = _correlation(played, truth)
        figures["regression"][name] = _correlation(_regressed(units, truth), truth)
    figures["of_regression"] = {
        name: round(figures["r"][name] / figures["regression"][name], 3) for name in DISTANCES
    }
    return figures


def _distances(places: Floats, pairs: Sequence[Pair], eyes: Pair) -> Floats:
    """Return the mean distance (f,) of pairs of points (f, n, 3), by that of the eyes."""
    each = [np.linalg.norm(places[:, a] - places[:, b], axis=1) for a, b in (*pairs, eyes)]
    return np.asarray(np.mean(each[:-1], axis=0) / each[-1])


def _distances_on(person: PlayedPerson, skins: Sequence[Floats], pairs: Sequence[Pair]) -> Floats:
    """Return the same of skins (v, 3), of pairs by their landmarks' numbers."""
    numbers = [number for pair in (*pairs, EYES[1]) for number in pair]
    points = person.points.select([str(number) for number in numbers])
    rows = [(k, k + 1) for k in range(0, len(numbers), 2)]
    return _distances(np.array([points.at(skin) for skin in skins]), rows[:-1], rows[-1])


def _regressed(units: Floats, values: Floats) -> Floats:
    """Return what a linear regression on units (f, 17) says of values (f,), half by half."""
    said = np.empty(len(values))
    half = len(values) // 2
    rows = np.column_stack([units, np.ones(len(units))])
    for learned, told in ((slice(None, half), slice(half, None)), (slice(half, None), slice(half))):
        said[told] = rows[told] @ np.linalg.lstsq(rows[learned], values[learned], rcond=None)[0]
    return said


def _correlation(first: Floats, second: Floats) -> float:
    return round(float(np.corrcoef(first, second)[0, 1]), 3)


def _read(path: Path) -> Columns:
    with path.open(newline="", encoding="utf-8-sig") as file:
        header, *rows = csv.reader(file)
    values = np.array(rows, np.float64).T
    return dict(zip(map(str.strip, header), values, strict=True))


def _write(path: Path, table: Columns, seed: int | None) -> int:
    """Write a take, with frames that have no face by a ``seed``; return their number."""
    count = len(table["timestamp"])
    success = np.ones(count)
    if seed is not None:
        random = np.random.default_rng(seed)
        while (success == 0.0).sum() < GAP_PART * count:
            length = int(random.integers(*GAP_FRAMES, endpoint=True))
            begin = int(random.integers(0, count - length))
            success[begin : begin + length] = 0.0
    written = {**table, "success": success}
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(written)
        rows.writerows(np.column_stack([*written.values()]).tolist())
    return int((success == 0.0).sum())


def _landmarks(table: Columns, file: Path | None) -> Floats:
    """Return the landmarks (f, 68, 3) of a file, or of the table."""
    if file is not None:
        with np.load(file) as data:
            return np.asarray(data["landmarks"], np.float64)
    names = [[f"{axis}_{number}" for axis in "XYZ"] for number in range(68)]
    if names[0][0] not in table:
        raise SystemExit("the CSV has no landmarks (X_0 ...): give --landmarks")
    return np.array([[table[name] for name in each] for each in names]).transpose(2, 0, 1)


def _made(count: int) -> Columns:
    """Return a take whose mouth opens and smiles and whose lids and brows move, with landmarks."""
    time = np.arange(count) / 30.0
    waves = {"AU26_r": 1.0, "AU12_r": 1.7, "AU45_r": 2.3, "AU01_r": 0.6}
    table = {"timestamp": time} | {name: np.zeros(count) for name in INTENSITIES}
    table |= {name: 2.0 * (1.0 - np.cos(2.0 * np.pi * hz * time)) for name, hz in waves.items()}
    places = np.zeros((count, 68, 3))
    places[:, [36, 45, 48, 54], 0] = (-45.0, 45.0, -25.0, 25.0)
    places[:, [48, 54], 0] += np.outer(table["AU12_r"], (-1.0, 1.0))
    places[:, 66, 1] = 4.0 * table["AU26_r"]
    places[:, [41, 40, 47, 46], 1] = 10.0 - 2.0 * table["AU45_r"][:, None]
    places[:, [39, 42], 1] = 15.0 + table["AU01_r"][:, None]
    axes = {f"{axis}_{n}": places[:, n, k] for n in range(68) for k, axis in enumerate("XYZ")}
    return table | axes


def section(figures: Figures) -> Section:
    """Return the section of docs/science/benchmarks.md."""
    rows = [
        [
            name.replace("_", " "),
            figures["r"][name],
            figures["regression"][name],
            figures["of_regression"][name],
        ]
        for name in DISTANCES
    ]
    heads = ["distance", "played", "regression on the units", "ratio"]
    return Section(
        title="Recordings of OpenFace",
        compared=f"Distances of OpenFace's landmarks over {figures['frames']} frames, of which "
        f"{figures['hidden']} were hidden, against those of the face that plays its action units: "
        "correlations.",
        parts=[Table(heads, rows)],
    )


if __name__ == "__main__":
    main()
