"""Readers of motion files under the names from before they were the library's."""

from __future__ import annotations

import numpy as np
from support.bodies import write_amass, write_bvh

from warpgarment.bodies import amass, bvh
from warpgarment.training.motions import clips


def test_old_names_read_the_same(tmp_path):
    """A script that imports them reads another clip, or stops. Equal bits."""
    joints = [("Hips", None, (0.0, 1.0, 0.0)), ("Spine", "Hips", (0.0, 0.2, 0.0))]
    path = write_bvh(tmp_path / "a.bvh", joints, [[0.0, 1.0, 0.0, 10.0, 20.0, 30.0, 1.0, 2.0, 3.0]] * 3, fps=60.0)
    old, new = clips.read_bvh(path, "y"), bvh.read_bvh(path, "y")
    np.testing.assert_array_equal(old.rotations, new.rotations)
    assert clips.bvh_length(path) == bvh.bvh_length(path) == (3, 60.0)
    moved = write_amass(tmp_path / "a.npz", {"left_knee": np.array([0.1, 0.0, 0.0])}, 4, 30.0)
    for up in ("y", "z"):
        np.testing.assert_array_equal(clips.read_amass(moved, up).rotations, amass.read_amass(moved, up).rotations)
