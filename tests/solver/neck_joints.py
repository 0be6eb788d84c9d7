"""The small person's head turned by a neck, and the joints that an animation of it has."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from solver.neck.anatomy import BODIES
from solver.neck.builtin import builtin_neck
from solver.neck.place import find_rim, head_joint, place_neck
from solver.neck.posture import share_out
from solver.neck.skin import NeckSkin, two_bones
from solver.rig.frames.joints import Joints
from solver.surface import Floats
from tests.fixtures import small_model


def turned_head(degrees: Floats) -> tuple[Joints, np.ndarray, Floats]:
    """Return joints, skins (f, v, 3) in the head's frame, and heads (f, 6) turned by (f, 3)."""
    model = small_model()
    rim = find_rim(model, head_joint(model))
    neck = place_neck(model, builtin_neck(), rim).neck
    skin = NeckSkin.of(model, neck, rim)
    poses = [share_out(neck, turn.as_matrix()) for turn in Rotation.from_rotvec(degrees, True)]
    skins = []
    heads = []
    for pose in poses:
        head = pose.matrices[-1]
        skins.append((skin.skin(pose.matrices) - head[:3, 3]) @ head[:3, :3])
        heads.append([*Rotation.from_matrix(pose.head).as_rotvec(), *head[:3, 3]])
    turns = np.array([np.vstack([np.zeros(3), pose.turns]) for pose in poses])
    rest = np.vstack([np.zeros(3), neck.centres])
    unposed = np.tile(model.skin.vertices.astype(np.float32), (len(poses), 1, 1))
    joints = Joints(BODIES, rest, turns, *two_bones(skin.places), unposed)
    return joints, np.array(skins, np.float32), np.array(heads)
