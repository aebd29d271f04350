"""Recorded velocities: an optional array of a sequence, which old ones do not have."""

from __future__ import annotations

import numpy as np
import pytest
from support import sequences as synthetic

from warpgarment.errors import MeshError
from warpgarment.training.data.sequence import Sequence
from warpgarment.training.data.verify import verify


def speeds(content: dict) -> None:
    shape = content["garment_vertices"].shape
    content["garment_velocities"] = np.random.default_rng(0).uniform(-3, 4, shape).astype(np.float32)


def test_velocities_come_back_and_are_stable(tmp_path):
    """They are lost, taken for positions, or change each time they are written. Half a step of a box of 7 m/s:
    0.053 mm/s; written again, equal bits."""
    content = synthetic.arrays(frames=4)
    speeds(content)
    sequence = Sequence.load(synthetic.write(tmp_path, "one", frames=4, spoil=speeds))
    np.testing.assert_allclose(sequence.velocities, content["garment_velocities"], atol=7.0 / 131070 * 1.01)
    np.testing.assert_allclose(sequence.vertices, content["garment_vertices"], atol=1e-4)
    again = sequence.arrays()
    kept = Sequence.load(synthetic.write(tmp_path, "two", frames=4, spoil=lambda c: (c.clear(), c.update(again))))
    np.testing.assert_array_equal(kept.velocities, sequence.velocities)


def test_sequences_without_velocities_stay_as_they_were(tmp_path):
    """Old sets are refused, or new ones without velocities have other files."""
    folder = synthetic.write(tmp_path, "one", frames=4)
    assert Sequence.load(folder).velocities is None
    assert "garment_velocities" not in Sequence.load(folder).arrays()
    assert not list(folder.glob("velocity*"))


@pytest.mark.parametrize("name", ["velocity_codes", "velocity_boxes"])
def test_half_of_them_is_missing(tmp_path, name):
    """A sequence that has lost a file is used without its velocities, and nobody is told."""
    folder = synthetic.write(tmp_path, "one", frames=4, spoil=speeds)
    (folder / f"{name}.npy").unlink()
    with pytest.raises(MeshError, match=name):
        Sequence.load(folder)


def test_velocities_of_other_frames_are_refused(tmp_path):
    """Velocities of another number of frames are written."""

    def short(content: dict) -> None:
        speeds(content)
        content["garment_velocities"] = content["garment_velocities"][:3]

    with pytest.raises(MeshError, match="T = 4"):
        synthetic.write(tmp_path, "one", frames=4, spoil=short)


def test_verify_reads_velocities(tmp_path):
    """Velocities that are not finite, or were changed, pass as sound."""

    def broken(content: dict) -> None:
        speeds(content)
        content["garment_velocities"][2, 1] = np.nan

    synthetic.write(tmp_path / "sound", "one", frames=4, spoil=speeds, manifest={"number": 0})
    assert verify(tmp_path / "sound").problems == []
    synthetic.write(tmp_path / "broken", "one", frames=4, spoil=broken, manifest={"number": 0})
    (problem,) = verify(tmp_path / "broken").problems
    assert "garment_velocities" in problem.what
    assert "first: frame 2" in problem.what
    path = tmp_path / "sound" / "one" / "velocity_codes.npy"
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    (problem,) = verify(tmp_path / "sound").problems
    assert "velocity_codes.npy does not have its checksum" in problem.what
