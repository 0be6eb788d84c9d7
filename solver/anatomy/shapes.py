"""What is known of how a topology varies: over persons and over expressions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class ShapeBasis:
    """Linear shapes of a template's skin, all displacements in mm from the template's neutral.

    identity
        (k, n, 3) float32, one standard deviation of each component; coefficients are independent
        with unit variance. k = 0 where nothing is known.
    expressions
        (e, n, 3) float32, each at its full strength (weight 1); weights lie in [0, 1].
    expression_names
        The e names, as ARKit calls them where it has one.
    """

    identity: NDArray[np.float32]
    expressions: NDArray[np.float32]
    expression_names: tuple[str, ...]
