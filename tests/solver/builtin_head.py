"""A head with the built-in face, without tets of its own: for what only touches its skin."""

from dataclasses import replace

import numpy as np
import scipy.sparse as sp

from solver.model import SubjectModel
from tests.fixtures import small_model


def builtin_head() -> SubjectModel:
    """Return the small person with its skin for flesh: every vertex of the flesh follows itself.

    The mandible's vertices come after them.
    """
    model = small_model()
    count = len(model.embedded)
    mandible = model.bones["mandible"].vertices
    rest = np.vstack([model.skin.vertices[model.embedded], mandible])
    own = np.arange(count)
    return replace(
        model,
        rest=rest,
        mandible=np.arange(count, len(rest)),
        embedding=sp.csr_array((np.ones(count), (own, own)), (count, len(rest))),
        offset=np.zeros((count, 3)),
    )
