"""A small block of flesh with teeth and fibres, and shapes of its skin."""

from dataclasses import replace

import numpy as np

from solver.mechanics.boundary import move_jaw
from solver.surface import Surface
from tests.solver.block import block_model

OPEN = np.array([0.15, 0.0, 0.0, 0.0, 1.0])  # rad and mm, of the jaw in the shape "open"


def tracked_block(shape=(5, 4, 3)):
    """Return the block with four lower teeth behind its skin and fibres along x."""
    plain = block_model(shape)
    teeth = np.array([[15.0, 8.0, 0.0], [25.0, 8.0, 0.0], [35.0, 8.0, 0.0], [25.0, 5.0, -4.0]])
    count = len(plain.skin.vertices)
    ids = count + np.arange(len(teeth))
    fibres = np.zeros((plain.weights.nnz, 3))
    fibres[plain.weights.indices > 0, 0] = 1.0
    return replace(
        plain,
        skin=Surface(np.vstack([plain.skin.vertices, teeth]), plain.skin.faces),
        attached_mandible=ids,
        regions={"lower_teeth": ids},
        fibres=fibres,
    )


def block_shapes(model):
    """Return name -> motion (V, 3): a skin that is drawn aside, one that bulges, an open jaw."""
    skin = model.skin.vertices
    middle = np.exp(-(((skin[:, :2] - [25.0, 20.0]) / 15.0) ** 2).sum(axis=1))
    aside = np.zeros_like(skin)
    bulge = np.zeros_like(skin)
    aside[:, 0] = 2.0 * middle
    bulge[:, 2] = 1.5 * middle
    aside[model.attached_mandible] = bulge[model.attached_mandible] = 0.0
    low = np.clip((25.0 - skin[:, 1]) / 15.0, 0.0, 1.0)
    low[model.attached_mandible] = 1.0
    opened = low[:, None] * (move_jaw(model.jaw, skin, OPEN) - skin)
    return {"aside": aside, "bulge": bulge, "open": opened}
