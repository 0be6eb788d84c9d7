"""A small block of flesh as a subject model: two muscles, a jaw, skin on its front."""

from dataclasses import replace

import numpy as np
import scipy.sparse as sp

from solver.anatomy.build import divide_muscles, number_compartments
from solver.anatomy.template import Compartments, Muscle
from solver.fitting.face import Pose
from solver.model import JawFrame, SubjectModel
from solver.surface import Surface

CUBE = np.array(
    [[0, 1, 3, 7], [0, 3, 2, 7], [0, 2, 6, 7], [0, 6, 4, 7], [0, 4, 5, 7], [0, 5, 1, 7]]
)


def grid(shape, size):
    """Return vertices of a box of ``size`` mm cut into ``shape`` cubes, and Kuhn's tets."""
    counts = np.array(shape) + 1
    index = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), -1).reshape(-1, 3)
    vertices = index / np.array(shape) * np.array(size, dtype=float)
    number = np.arange(len(index)).reshape(counts)
    corner = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(-1, 3)
    cells = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 3)
    corners = cells[:, None, :] + corner[None]
    cubes = number[corners[..., 0], corners[..., 1], corners[..., 2]]
    tets = cubes[:, CUBE].reshape(-1, 4)
    edges = vertices[tets[:, 1:]] - vertices[tets[:, :1]]
    flipped = np.linalg.det(edges) < 0
    tets[flipped] = tets[flipped][:, [0, 2, 1, 3]]
    return vertices, tets


def block_model(shape=(5, 4, 3)):
    """Back (z = 0) on the cranium above, on the mandible below; two muscles and passive flesh."""
    vertices, tets = grid(shape, (50.0, 40.0, 15.0))
    back = vertices[:, 2] == 0.0
    cranium = np.flatnonzero(back & (vertices[:, 1] > 20.0))
    mandible = np.flatnonzero(back & (vertices[:, 1] < 15.0))
    centre = vertices[tets].mean(axis=1)
    share = np.zeros((len(tets), 3))
    share[:, 1] = np.clip((30.0 - centre[:, 0]) / 30.0, 0.0, 1.0) * 0.8
    share[:, 2] = np.clip((centre[:, 0] - 20.0) / 30.0, 0.0, 1.0) * 0.8
    share[:, 0] = 1.0 - share[:, 1:].sum(axis=1)
    front = np.flatnonzero(vertices[:, 2] == 15.0)
    picks = np.arange(len(front))
    embedding = sp.csr_array(
        (np.ones(len(front)), (picks, front)), shape=(len(front), len(vertices))
    )
    faces = np.stack([picks[:-2], picks[1:-1], picks[2:]], axis=1)
    return SubjectModel(
        rest=vertices,
        tets=tets,
        cranium=cranium,
        mandible=mandible,
        cut=np.zeros(0, int),
        sliding=np.zeros(0, int),
        muscle_names=("left", "right"),
        weights=dense_pattern(share),
        skin=Surface(vertices[front], faces),
        embedded=picks,
        embedding=embedding,
        offset=np.zeros((len(front), 3)),
        attached_mandible=np.zeros(0, int),
        face=picks,
        jaw=JawFrame(np.array([25.0, 20.0, -30.0]), np.eye(3)),
        muscles={},
        bones={},
        regions={},
        template={"name": "block", "version": "1", "sha256": ""},
    )


def head_block(cells=(8, 6, 2)):
    """Return a block as large as a head, its skin triangulated, with a left and a right region."""
    small = block_model(cells)
    scale = 3.0
    columns = cells[0] + 1
    rows = cells[1] + 1
    number = np.arange(columns * rows).reshape(columns, rows)
    corners = [number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]]
    a, b, c, d = (each.ravel() for each in corners)
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    skin = Surface(small.skin.vertices * scale, faces)
    left = skin.vertices[:, 0] > 75.0
    return replace(
        small,
        rest=small.rest * scale,
        skin=skin,
        embedding=in_tets(small),
        jaw=JawFrame(small.jaw.origin * scale, np.eye(3)),
        regions={"left": np.flatnonzero(left), "right": np.flatnonzero(~left)},
    )


def in_tets(model):
    """Return the embedding with a tet's four corners in every row, as contact has it."""
    vertices = model.embedding.indices
    tets = [np.flatnonzero((model.tets == vertex).any(axis=1))[0] for vertex in vertices]
    corners = model.tets[tets]
    shares = (corners == vertices[:, None]).astype(float)
    indptr = 4 * np.arange(len(vertices) + 1)
    return sp.csr_array((shares.ravel(), corners.ravel(), indptr), shape=model.embedding.shape)


def dense_pattern(values):
    """Return CSR with every entry stored, zeros too: all columns are candidates."""
    rows, columns = values.shape
    indptr = np.arange(rows + 1) * columns
    return sp.csr_array(
        (values.ravel(), np.tile(np.arange(columns), rows), indptr), shape=values.shape
    )


def poses(count):
    """Contractions along x of both muscles, jaw open by some degrees."""
    rng = np.random.default_rng(4)
    found = []
    for _ in range(count):
        stretch = rng.uniform(0.7, 1.0, 2)
        a = np.array([[s, 0.05, 0.0, 1.0 / np.sqrt(s), 0.0, 1.0 / np.sqrt(s)] for s in stretch])
        found.append(Pose(a, np.array([rng.uniform(0.0, 0.15), 0.02, 0.2, -0.5, 0.4])))
    return found


def thinner(S: sp.csr_array, column: int, part: float = 0.3) -> sp.csr_array:
    """Return S with ``part`` of a muscle in the first half of its tets, where flesh is passive.

    All of it thinner alike would be made up for by more activation.
    """
    dense = S.toarray()
    own = np.flatnonzero(dense[:, column])
    half = own[: len(own) // 2]
    dense[half, 0] += (1.0 - part) * dense[half, column]
    dense[half, column] *= part
    rows = np.repeat(np.arange(S.shape[0]), np.diff(S.indptr))
    found = S.copy()
    found.data = dense[rows, S.indices]
    return found


def divided_block(shape=(5, 4, 3)):
    """The block, its muscles with fibres along x, each in a lower and an upper compartment."""
    model = block_model(shape)
    x = np.array([1.0, 0.0, 0.0])
    nothing = Surface(np.zeros((0, 3)), np.zeros((0, 3), int))
    halves = Compartments("superior", ("lower", "upper"))
    muscles = tuple(
        Muscle(name, nothing, x, 0 * x, 50 * x, compartments=halves) for name in model.muscle_names
    )
    fibres = np.where(model.weights.indices[:, None] > 0, x, 0.0)
    mesh = model.rest, model.tets, model.weights
    divided = divide_muscles(
        model.weights, muscles, number_compartments(*mesh, fibres, muscles, 25.0)
    )
    return replace(
        model,
        weights=divided.weights,
        muscle_names=divided.names,
        wholes=divided.wholes,
        fibres=fibres,
    )


def differences(function, pose, step=1e-5):
    """Return the central differences of a ``function`` of poses."""
    moves = step * np.eye(pose.layout.size)
    ends = ((function(pose.add(move)), function(pose.add(-move))) for move in moves)
    return np.array([(ahead - behind) / (2.0 * step) for ahead, behind in ends])
