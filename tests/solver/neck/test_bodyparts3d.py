"""The neck of BodyParts3D's man beside the built-in one."""

import numpy as np
import pytest

from solver.neck.bodyparts3d import read_neck
from solver.neck.builtin import builtin_neck
from solver.neck.motion import follow, reachable
from solver.templates.bodyparts3d import read_parts
from tests.fixtures import data_folder


@pytest.mark.long
def test_attachments_come_from_his_meshes_and_hold_his_head():
    read = read_neck(read_parts(data_folder("bodyparts3d")))
    assert read.joints_mm.max() < 8.0
    assert read.median_mm < 25.0
    assert len(read.ends_mm) >= 30
    own = builtin_neck().moved(read.placed)
    for ours, his in zip(own.muscles, read.neck.muscles, strict=True):
        assert (ours.name in read.ends_mm) == (his.source != ours.source)
        fibre = (his.length - his.tendon) / his.fibre
        assert 0.9 < fibre < 1.1
    times = np.arange(0.0, 1.0, 0.02)
    motion = follow(read.neck, reachable(read.neck, times, np.zeros((50, 3))))
    assert motion.off_deg.max() < 0.5
