"""The built-in head as a subject model without tets of its own: for what only touches its skin."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp

from solver.errors import InputError
from solver.model import JawFrame
from solver.templates.builtin.build import builtin_template
from tests.solver.block import block_model


def builtin_head():
    """Return the head with its skin for flesh: every vertex of the flesh follows itself.

    The mandible's vertices come after them.
    """
    try:
        template = builtin_template()
    except InputError as error:
        pytest.skip(error.message)
    skin = template.skin
    flesh = np.setdiff1d(
        skin.faces[template.flesh_faces],
        np.concatenate([template.attached_cranium, template.attached_mandible]),
    )
    count = len(flesh)
    rest = np.vstack([skin.vertices[flesh], template.mandible.vertices])
    rows = sp.csr_array((np.ones(count), (np.arange(count), np.arange(count))), (count, len(rest)))
    return replace(
        block_model(),
        rest=rest,
        mandible=np.arange(count, len(rest)),
        skin=skin,
        embedded=flesh,
        embedding=rows,
        offset=np.zeros((count, 3)),
        attached_mandible=template.attached_mandible,
        face=template.face_vertices,
        jaw=JawFrame(template.condyles.mean(axis=0), np.eye(3)),
        bones={"cranium": template.cranium, "mandible": template.mandible},
        regions=template.regions,
    )
