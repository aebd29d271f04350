"""Clips of strangers: the line of a fault is named, and small files ask for no more than they hold."""

from __future__ import annotations

import os

import numpy as np
import pytest

from warpgarment.bodies.amass import amass_length, read_amass
from warpgarment.bodies.bvh import LARGEST_FILE, MOST_JOINTS, bvh_length, read_bvh
from warpgarment.errors import MeshError

CLIP = """HIERARCHY
ROOT Pelvis
{
  OFFSET 1.5 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation
  JOINT Left Knee
  {
    OFFSET 0 -4 0
    CHANNELS 1 Xrotation
    End Site
    {
      OFFSET 0 -4 0
    }
  }
}

MOTION
Frames: 2
Frame Time: 0.02
0 9 0 0 0 0 30

0 9 1 0 90 0 0
"""


def test_clip(tmp_path):
    """A good clip would be refused or misread. Lengths exact; the knee is 4 below the pelvis within 1e-12."""
    (tmp_path / "a.bvh").write_text(CLIP)
    clip = read_bvh(tmp_path / "a.bvh")
    assert clip.names == ("Pelvis", "Left Knee")
    assert (len(clip), clip.fps) == (2, 50)
    assert bvh_length(tmp_path / "a.bvh") == (2, 50)
    np.testing.assert_allclose(clip.root, [[0, 9, 0], [0, 9, 1]])
    turned = clip.rotations[0, 1] @ [0, -4, 0]
    np.testing.assert_allclose(turned, [0, -4 * np.cos(np.pi / 6), -4 * np.sin(np.pi / 6)], atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("OFFSET 0 -4 0", "OFFSET 0 inf 0", "line 8: inf is not a finite number"),
        ("OFFSET 1.5 0 0", "OFFSET 1.5 -NaN 0", "line 4: -NaN is not a finite"),
        ("OFFSET 1.5 0 0", "OFFSET 1.5 0", "line 5: 'CHANNELS' is no number"),
        ("OFFSET 0 -4 0", "OFFSET 0 -4e7 0", "line 8: -4e7 is not a finite number of at most 1,000,000"),
        ("1 Xrotation", "1 Xscale", "line 9: channels are"),
        ("1 Xrotation", "1 xrotation", "line 9: channels are"),
        ("6 Xposition Y", "6 Yposition Y", "line 5: channels are .* 'Yposition'"),
        ("CHANNELS 1", "CHANNELS 12", "line 9: a joint has 0 to 6 channels, not 12"),
        ("CHANNELS 1", "CHANNELS -1", "line 9: a joint has 0 to 6 channels"),
        ("CHANNELS 1", "CHANNELS 0.5", "line 9: a joint has 0 to 6 channels"),
        ("JOINT Left", "ROOT Left", "line 6: a file has one ROOT"),
        ("  JOINT", "  BONE", "line 6: 'BONE' is not expected"),
        ("}\n\nMOTION", "MOTION", "incomplete"),
        ("}\n\nMOTION", "} }\nMOTION", "line 15: '}' is not expected"),
        ("Frames: 2", "Frames: 2.5", "line 18: '2.5' is no Frames"),
        ("Frames: 2", "Frames: -7", "line 18: "),
        ("Frames: 2", f"Frames: {'9' * 400}", "line 18: "),
        ("Frames: 2", "Frames: 700000000", "700,000,000 frames of 7 channels announced, 14 numbers found"),
        ("0.02", "nan", "line 19: "),
        ("0.02", "0.0.2", "line 19: "),
        ("9 1 0 90", "9 1 zero 90", "line 22: .* not a number"),
        ("9 1 0 90", "9 1 nan 90", r"1 of 2 frames hold NaN .*frame 1"),
        ("9 1 0 90", "9 1e9 0 90", "line 22: a number beyond"),
    ],
)
def test_line_is_named(tmp_path, old, new, message):
    """A damaged clip would be an error of Python, or a skeleton with NaN in it."""
    assert old in CLIP
    (tmp_path / "a.bvh").write_text(CLIP.replace(old, new, 1))
    with pytest.raises(MeshError, match=message):
        read_bvh(tmp_path / "a.bvh")


def test_sizes(tmp_path):
    """A pipe would be waited for, a hole of gigabytes read, and a thousand joints within each other be a recursion."""
    path = tmp_path / "a.bvh"
    path.write_text("HIERARCHY\nROOT a\n{\n" + "JOINT b\n{\n" * MOST_JOINTS + "MOTION\n")
    with pytest.raises(MeshError, match=f"line {2 * MOST_JOINTS + 2}: more than 4,096 joints"):
        read_bvh(path)
    with open(path, "r+b") as file:
        file.truncate(LARGEST_FILE + 1)
    for read in (read_bvh, bvh_length):
        with pytest.raises(MeshError, match=r"268,435,457 bytes; .* 268,435,456 at most"):
            read(path)
    path.unlink()
    os.mkfifo(path)
    for read in (read_bvh, bvh_length, read_amass, amass_length):
        with pytest.raises(MeshError, match="is a pipe"):
            read(path)
