"""The references: the problems as published, in full space, solved by IPOPT.

Slow and trusted. x is a variable and the equilibrium a constraint, with exact sparse Jacobians and
the Gauss-Newton Hessian of the objective (the curvature of the constraint is left out, as in the
papers).
"""

from solver.fitting.reference.expression import (
    NotConvergedError,
    ReferenceSolution,
    activations,
    forward,
    per_tet,
)
from solver.fitting.reference.geometry import geometry

__all__ = [
    "NotConvergedError",
    "ReferenceSolution",
    "activations",
    "forward",
    "geometry",
    "per_tet",
]
