"""Outputs: whole or not at all, tried before the work, and nothing of dead processes beside them."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import time

import numpy as np
import pytest

from warpgarment.errors import MeshError, OutputError, UsageError
from warpgarment.io.disk import leftovers
from warpgarment.io.disk.atomic import atomic_file, atomic_folder
from warpgarment.io.disk.outputs import check_writable
from warpgarment.objects.motion import GarmentMotion

CLOTH = np.random.default_rng(1).normal(0, 1, (300, 30, 3)).astype(np.float32)


def motion(frames: int = 300) -> GarmentMotion:
    return GarmentMotion(CLOTH[:frames], np.arange(30, dtype=np.int32).reshape(10, 3))


@pytest.fixture
def small_disk():
    """Files may grow to 9 kB; the motion's 108 kB of positions do not fit."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (9000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.fixture
def dead_process() -> int:
    """The number of a process that has ended."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


@pytest.mark.parametrize("name", ["m.npz", "m.pc2", "m.mdd", "m.abc", "m.usda", "m.usdc"])
def test_a_full_disk_is_a_named_error_and_the_old_file_stays(tmp_path, small_disk, name):
    """A full disk would end in a traceback, in half a file, or in the loss of the old one."""
    old = tmp_path / name
    old.write_bytes(b"before")
    with pytest.raises(OutputError, match=name):
        motion().save(old)
    assert old.read_bytes() == b"before"
    assert os.listdir(tmp_path) == [name]


def test_a_full_disk_leaves_a_folder_as_it_was(tmp_path, small_disk):
    """A folder of OBJ would be replaced by half of the new one. 10 kB of text each do not fit."""
    motion(2).save(tmp_path / "m")
    before = {p.name: p.read_bytes() for p in (tmp_path / "m").iterdir()}
    big = GarmentMotion(np.zeros((1, 3000, 3), np.float32), [[0, 1, 2]])
    with pytest.raises(OutputError, match="m: cannot be written"):
        big.save(tmp_path / "m")
    assert {p.name: p.read_bytes() for p in (tmp_path / "m").iterdir()} == before
    assert os.listdir(tmp_path) == ["m"]


@pytest.mark.parametrize("suffix", [".NPZ", ".Pc2", ".USDA", ".uSd"])
def test_suffixes_in_any_case_come_back(tmp_path, suffix):
    """Names as Windows tools write them would be refused, or refused only at the end. Bit for bit."""
    motion(3).save(tmp_path / f"m{suffix}")
    np.testing.assert_array_equal(GarmentMotion.load(tmp_path / f"m{suffix}", fps=30.0).vertices, CLOTH[:3])


def test_folders_with_dots(tmp_path):
    """`sh010.v002` could not be written at all, or a file name that exists as a folder would be filled."""
    with pytest.raises(UsageError, match="slash"):
        motion(2).save(tmp_path / "sh.v1")
    motion(2).save(f"{tmp_path}/sh.v1/")
    assert len(list((tmp_path / "sh.v1").glob("*.obj"))) == 2
    motion(3).save(tmp_path / "sh.v1")  # it exists now
    assert len(list((tmp_path / "sh.v1").glob("*.obj"))) == 3
    motion(2).save(f"{tmp_path}/sh.npz/")
    assert (tmp_path / "sh.npz").is_dir()
    with pytest.raises(IsADirectoryError):
        motion(2).save(tmp_path / "sh.npz")


def test_what_cannot_be_written_is_refused_before(tmp_path):
    """A simulation of hours would be thrown away for its output's name. Nothing is left by the trial."""
    (tmp_path / "file").write_text("")
    (tmp_path / "folder.npz").mkdir()
    for name, words in {
        "file/a.npz": "not a folder", "file/b/c/a.npz": "not a folder", f"{'n' * 256}.npz": "260 bytes",
        f"new/{'ü' * 130}/a.npz": "260 bytes", "folder.npz": "is a folder",
    }.items():  # fmt: skip
        with pytest.raises(OutputError, match=words):
            check_writable(tmp_path / name)
    with pytest.raises(OutputError, match="not a folder"):
        check_writable(tmp_path / "file", folder=True)
    check_writable(tmp_path / "new" / "er" / "a.npz")
    check_writable(tmp_path / ("n" * 251 + ".npz"))
    check_writable(tmp_path / "folder.npz", folder=True)
    assert sorted(os.listdir(tmp_path)) == ["file", "folder.npz"]


def test_the_longest_name_is_written(tmp_path):
    """The hidden name beside it would be longer than the disk allows."""
    motion(2).save(tmp_path / ("n" * 251 + ".npz"))
    motion(2).save(tmp_path / ("ü" * 127))
    assert len(os.listdir(tmp_path)) == 2


def test_leftovers_of_dead_processes_go(tmp_path, dead_process):
    """Half files pile up for ever, or the file is removed that a living process, or this one, is writing."""
    place = leftovers._place()

    def left(label: str, days: float = 0.0, folder: bool = False):
        path = tmp_path / f".{label}.partial.npz"
        (path.mkdir() if folder else path.write_bytes(b"half"))
        if folder:
            (path / "frame").write_text("")
        os.utime(path, (time.time() - 86400 * days,) * 2)
        return path

    go = [
        left(f"a.{place}-{dead_process}-01234567"),
        left(f"another.b.{place}-{dead_process}-01234567", folder=True),
        left("a.00000000-1-01234567", days=4),  # of another machine
        left("a.01234567", days=4),
        left(f"a.{place}-{os.getpid()}-01234567"),  # of one before that had our number
    ]
    stay = [
        left(f"a.{place}-{os.getppid()}-01234567", days=9),
        left("a.00000000-1-89abcdef", days=1),
        left("a.76543210"),
        left("mine.0123", days=9),
    ]
    with atomic_file(tmp_path / "x.npz") as writing:
        writing.write_text("half")
        with atomic_file(tmp_path / "y.npz") as other:  # another save of this process, at the same time
            other.write_text("whole")
        assert writing.exists()
    assert not [path.name for path in go if path.exists()]
    assert not [path.name for path in stay if not path.exists()]


def test_a_folder_moved_aside_by_a_dead_process_is_put_back(tmp_path, dead_process):
    """Killed between two renames, a process leaves the only copy of a folder under a hidden name: it would be removed
    as a leftover, and the save that follows may fail."""
    aside = tmp_path / f".shot.{leftovers._place()}-{dead_process}-01234567.aside.v2"
    aside.mkdir()
    (aside / "frame_0000.obj").write_text("old")
    motion(2).save(tmp_path / "other.npz")  # not its business
    assert aside.exists()
    with pytest.raises(MeshError), atomic_folder(tmp_path / "shot.v2", "frame_*.obj"):
        raise MeshError("no good")
    assert (tmp_path / "shot.v2" / "frame_0000.obj").read_text() == "old"
    assert sorted(os.listdir(tmp_path)) == ["other.npz", "shot.v2"]
