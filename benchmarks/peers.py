"""The forward problem solved by us and by ``liblaf-apple``, a published package for the same.

Both get the same block of flesh, held vertices, start and activations, and the energy of Phace

    E = sum_i V_i [ |F_i - R_i A_i|^2 + 3 (det F_i - det A_i)^2 ],

and solve it as their package does, in float64, each in a process of its own. ``active``: a quarter
of the tets contracts (det A = 1, which the peer takes for granted); ``passive``: the block is held
bent. R is the rotation that minimises the whole term; the peer takes polar(F) and differentiates as
if that were constant. Where A = I this is the same; else the peer solves another problem, so that
the energy with either R is measured at both ends, by a function that neither solver uses, and
``gradient_error`` is how far each solver's gradient is off its own energy's difference quotient.

The peer needs Python 3.12 or 3.13 and 2 GB for its environment, made once in the cache folder;
``skipped`` is why there is none. ``ratio`` is its time over ours with kernels compiled,
``ratio_cold`` with compiling them, ``ratio_cpu`` as ``ratio`` but in CPU seconds: the least of both
problems at top level. A peer that takes longer than ten minutes is stopped, and has no figures.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import report
from benchmarks.documents import Figures, Section, Table
from benchmarks.environments import UnavailableError, environment
from benchmarks.forward.ours import Ours
from benchmarks.forward.problem import Problem, active, energy, passive
from solver.surface import Floats

REQUIREMENTS = ("liblaf-apple==0.7.0", "warp-lang==1.16.0")
CELLS = (54, 24, 4)
QUICK_CELLS = (34, 15, 3)
TIME_LIMIT_S = 600.0
CHILD = Path(__file__).parent / "forward" / "child.py"
RATIOS = ("ratio", "ratio_cold", "ratio_cpu")


class StoppedError(Exception):
    """A solver did not end in time, or failed; the message is the reason."""


@dataclass(frozen=True)
class Answer:
    """Findings of :mod:`benchmarks.forward.child`; times of the first and of the second solve."""

    x: Floats
    seconds: Floats
    cpu: Floats
    iterations: int
    status: str
    gradient_error: float


def main() -> None:
    """Run from the command line."""
    parser = report.parser(__doc__ or "")
    parser.add_argument("--python", help="the peer's Python (default: one found on this machine)")
    options = parser.parse_args()
    report.finish(run(options), options, section)


def run(options: argparse.Namespace) -> Figures:
    """Solve both problems by both solvers and return the figures."""
    cells = QUICK_CELLS if options.quick else CELLS
    problems = {"active": active(cells), "passive": passive(cells)}
    mesh = problems["active"]
    figures: Figures = {"vertices": len(mesh.rest), "tets": len(mesh.tets)}
    try:
        peer = environment("liblaf-apple", REQUIREMENTS, options.python)
    except UnavailableError as error:
        peer = None
        figures["skipped"] = str(error)
    compared = {name: compare(problem, peer) for name, problem in problems.items()}
    solved = [found for found in compared.values() if "ratio" in found]
    least = {key: min(found[key] for found in solved) for key in RATIOS if solved}
    return {**figures, "peer": list(REQUIREMENTS), **least, "problems": compared}


def compare(problem: Problem, peer: Path | None) -> Figures:
    """Solve one problem by us and, in its interpreter, by the peer."""
    ours = answer("ours", Path(sys.executable), problem)
    figures: Figures = {"ours": measured(problem, ours)}
    if peer is None:
        return figures
    try:
        theirs = answer("apple", peer, problem)
    except StoppedError as error:
        return {**figures, "stopped": str(error)}
    cold, again = theirs.seconds / ours.seconds
    return {
        **figures,
        "peer": measured(problem, theirs),
        "ratio": float(again),
        "ratio_cold": float(cold),
        "ratio_cpu": float(theirs.cpu[1] / ours.cpu[1]),
        "max_position_difference_mm": float(np.linalg.norm(theirs.x - ours.x, axis=1).max()),
        "max_displacement_mm": float(np.linalg.norm(ours.x - problem.start, axis=1).max()),
    }


def answer(solver: str, python: Path, problem: Problem) -> Answer:
    """Run one solver in ``python`` with nothing compiled; raises :class:`StoppedError`."""
    with tempfile.TemporaryDirectory() as folder:
        given = Path(folder) / "problem.npz"
        found = Path(folder) / "answer.npz"
        np.savez(given, **asdict(problem))
        kernels = {"NUMBA_CACHE_DIR": f"{folder}/numba", "WARP_CACHE_PATH": f"{folder}/warp"}
        command = [str(python), str(CHILD), solver, str(given), str(found)]
        try:
            subprocess.run(
                command,
                check=True,
                capture_output=True,
                text=True,
                timeout=TIME_LIMIT_S,
                env={**os.environ, **kernels, "JAX_ENABLE_X64": "1", "JAX_PLATFORMS": "cpu"},
            )
        except subprocess.TimeoutExpired as error:
            raise StoppedError(f"stopped after {TIME_LIMIT_S:.0f} s") from error
        except subprocess.CalledProcessError as error:
            said = error.stderr.strip() or str(error)  # a killed process says nothing
            raise StoppedError(said.splitlines()[-1]) from error
        with np.load(found) as file:
            return Answer(
                x=file["x"],
                seconds=file["seconds"],
                cpu=file["cpu"],
                iterations=int(file["iterations"]),
                status=str(file["status"]),
                gradient_error=float(file["gradient_error"]),
            )


def measured(problem: Problem, found: Answer) -> dict[str, Any]:
    """Return a solver's times, and its end by the same functions for all."""
    truth = Ours(asdict(problem))
    at_start, at_end = (np.linalg.norm(truth.gradient(x)) for x in (problem.start, found.x))
    return {
        "seconds_cold": float(found.seconds[0]),
        "seconds": float(found.seconds[1]),
        "cpu_seconds": float(found.cpu[1]),
        "iterations": found.iterations,
        "status": found.status,
        "energy": energy(problem, found.x, polar_of_f=False),
        "energy_polar_f": energy(problem, found.x, polar_of_f=True),
        "gradient_left": float(at_end / at_start),
        "gradient_error": found.gradient_error,
        "inverted": truth.flesh.count_inverted(found.x),
    }


def excess(found: Figures) -> dict[str, dict[str, float]]:
    """Return how far each solver's energies are above the lower of both, in per cent."""
    ends = {who: found[who] for who in ("ours", "peer") if who in found}
    least = {key: min(end[key] for end in ends.values()) for key in ("energy", "energy_polar_f")}
    return {
        who: {f"{key}_excess": 100.0 * (end[key] / low - 1.0) for key, low in least.items()}
        for who, end in ends.items()
    }


def section(figures: Figures) -> Section:
    """Return the document's section."""
    columns = {
        "seconds_cold": "seconds, compiling too",
        "seconds": "seconds",
        "cpu_seconds": "CPU seconds",
        "iterations": "iterations",
        "energy_excess": "energy above the lower, %",
        "energy_polar_f_excess": "with R = polar(F), %",
        "gradient_left": "gradient left",
        "gradient_error": "error of its gradient",
    }
    rows = [
        [problem, name, *({**found[who], **excess(found)[who]}[key] for key in columns)]
        for problem, found in figures["problems"].items()
        for who, name in (("ours", "Myoface"), ("peer", "liblaf-apple"))
        if who in found
    ]
    parts: list[Table | str] = [Table(["problem", "solver", *columns.values()], rows)]
    for problem, found in figures["problems"].items():
        if "ratio" in found:
            parts.append(
                f"In `{problem}` ours is {found['ratio']:.0f} times as fast "
                f"({found['ratio_cpu']:.0f} by CPU seconds, {found['ratio_cold']:.0f} with "
                "compiling); the ends differ by "
                f"{found['max_position_difference_mm']:.2g} mm at most, where vertices move "
                f"{found['max_displacement_mm']:.2g} mm."
            )
        if "stopped" in found:
            parts.append(f"The peer did not end `{problem}`: {found['stopped']}.")
    if "skipped" in figures:
        parts.append(f"The peer was skipped: {figures['skipped']}.")
    return Section(
        title="Forward simulation against a peer",
        compared=(
            f"One equilibrium, {figures['vertices']:,} vertices and {figures['tets']:,} tets, by "
            f"Newton's method here and by the conjugate gradients of `{figures['peer'][0]}` (JAX "
            "and Warp), both in float64 with the energy of Phace (2017). `active`: a quarter of "
            "the tets contracts; `passive`: the block is held bent. The peer's rotation is "
            "polar(F), not the one that minimises the energy's term: the same where nothing is "
            "active, otherwise another problem, so both energies are given at both ends. `gradient "
            "left` is the norm of the energy's gradient over that at the start; the last column "
            "how far a solver's own gradient is from a difference quotient of its own energy, "
            "half way."
        ),
        parts=parts,
    )


if __name__ == "__main__":
    main()
