"""Solve one problem twice by one solver: ``python child.py SOLVER PROBLEM.npz ANSWER.npz``.

Needs nothing but NumPy and what the solver imports, which is a file beside this one with
``prepare(problem) -> Solver``. The first solve compiles kernels, the second finds them compiled;
both make everything else anew.
"""

from __future__ import annotations

import importlib
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np

Array = np.ndarray[Any, np.dtype[np.float64]]

STEP_MM = 1e-4


class Solver(Protocol):
    """A package's own way to solve the problem; positions are (p, 3)."""

    def solve(self) -> tuple[Array, int, str]:
        """Return the solution, how many iterations it took, and how the solver says it ended."""

    def energy(self, x: Array) -> float:
        """Return what is minimised."""

    def gradient(self, x: Array) -> Array:
        """Return what the package takes for the derivative, (p, 3), zero at held vertices."""


def main() -> None:
    """Run from the command line."""
    name, problem_file, answer_file = sys.argv[1:]
    prepare: Callable[[Mapping[str, Array]], Solver] = importlib.import_module(name).prepare
    with np.load(problem_file) as file:
        problem = dict(file)
    seconds = []
    cpu = []
    for _ in range(2):
        begin = time.perf_counter()
        cpu_begin = time.process_time()
        solver = prepare(problem)
        x, iterations, status = solver.solve()
        seconds.append(time.perf_counter() - begin)
        cpu.append(time.process_time() - cpu_begin)
    error = gradient_error(solver, problem["start"], x)
    np.savez(
        answer_file,
        x=x,
        seconds=seconds,
        cpu=cpu,
        iterations=iterations,
        status=status,
        gradient_error=error,
    )


def gradient_error(solver: Solver, start: Array, end: Array) -> float:
    """Return how far the gradient half way, along the way, is off the difference quotient."""
    middle = (start + end) / 2.0
    way = end - start
    way = way * (STEP_MM / np.abs(way).max())
    difference = (solver.energy(middle + way) - solver.energy(middle - way)) / 2.0
    return float(abs((solver.gradient(middle) * way).sum() / difference - 1.0))


if __name__ == "__main__":
    main()
