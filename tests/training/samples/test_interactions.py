"""The cache of body interactions: its values are those that were computed, even after damage to its files."""

from __future__ import annotations

import threading
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
from support import sequences as synthetic_sequences

from warpgarment.training.data.sequence import Sequence
from warpgarment.training.samples import interactions


@pytest.fixture
def folder(tmp_path) -> Path:
    return synthetic_sequences.write(tmp_path / "s", "one", frames=4)


@pytest.fixture
def computed(folder, monkeypatch) -> list[np.ndarray]:
    """The arrays that were computed rather than read; each sequence of this file has the same."""
    calls, compute = [], interactions.compute

    def counted(*arguments):
        calls.append(compute(*arguments))
        return calls[-1]

    monkeypatch.setattr(interactions, "compute", counted)
    return calls


def _content(place: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(place.iterdir())}


def test_a_flipped_bit_anywhere_is_noticed(folder, computed, tmp_path):
    """A network is trained on damaged distances: one bit of a cache file is another, in its header or its numbers, and
    the file is trusted. Eight places of each of three files; bit for bit what was computed, and written again."""
    sequence, cache = Sequence.load(folder), tmp_path / "cache"
    expected = [np.array(part) for part in interactions.cached(sequence, folder, cache)]
    (place,) = cache.iterdir()
    whole = _content(place)
    assert sorted(whole) == ["geodesics.npy", "interaction.npy", "manifest.json"]
    flips = 0
    for name, content in whole.items():
        for at in sorted({0, 9, 20, *np.linspace(64, len(content) - 1, 5).astype(int)}):
            damaged = bytearray(content)
            damaged[at] ^= 1 << (at + flips) % 8
            (place / name).write_bytes(damaged)
            flips += 1
            found = interactions.cached(sequence, folder, cache)
            for a, b in zip(found, expected, strict=True):
                np.testing.assert_array_equal(a, b, err_msg=f"{name}, byte {at}")
            assert len(computed) == 1 + flips, f"{name}, byte {at}: trusted"
            assert _content(place) == whole
    assert flips >= 20
    interactions.cached(sequence, folder, cache)
    assert len(computed) == 1 + flips, "what is whole is not computed again"


@pytest.mark.parametrize("missing", ["geodesics.npy", "interaction.npy", "manifest.json"])
def test_an_incomplete_folder_is_completed(folder, computed, tmp_path, missing):
    """A file that somebody removed stops every run from then on."""
    sequence, cache = Sequence.load(folder), tmp_path / "cache"
    interactions.cached(sequence, folder, cache)
    (place,) = cache.iterdir()
    whole = _content(place)
    (place / missing).unlink()
    interactions.cached(sequence, folder, cache)
    assert _content(place) == whole
    assert len(computed) == 2


@pytest.mark.parametrize("damaged", [False, True])
def test_of_several_writers_the_first_wins(folder, tmp_path, monkeypatch, damaged):
    """Processes that start together spoil one another's files, or fail: all compute at once, one folder is left, and it
    is not replaced under those who read it already."""
    cache, sequence = tmp_path / "cache", Sequence.load(folder)
    expected = [np.array(part) for part in interactions.cached(sequence, folder, tmp_path / "before")]
    if damaged:
        interactions.cached(sequence, folder, cache)
        next(cache.glob("one-*/interaction.npy")).write_bytes(b"damaged")
    writers, gate = 6, threading.Barrier(6)
    found, failed, files = [], [], []

    def together(*_):
        gate.wait(timeout=60)
        return expected[0]

    def write():
        try:
            found.append(interactions.cached(sequence, folder, cache))
            files.append(next(cache.glob("one-*/interaction.npy")).stat().st_ino)
        except Exception as error:
            failed.append(error)

    monkeypatch.setattr(interactions, "compute", together)
    threads = [threading.Thread(target=write) for _ in range(writers)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failed
    assert len(found) == writers
    for arrays in found:
        for a, b in zip(arrays, expected, strict=True):
            np.testing.assert_array_equal(a, b)
    assert [path.name for path in cache.iterdir()] == [f"one-{interactions.key_of(folder)}"], "rubbish is left"
    monkeypatch.setattr(interactions, "compute", lambda *_: pytest.fail("what is left is not whole"))
    interactions.cached(sequence, folder, cache)
    assert len(set(files)) == 1


def test_a_write_that_stops_midway_leaves_nothing(folder, tmp_path, monkeypatch):
    """A run that is stopped while it fills its cache leaves half a folder under the name of a whole one."""
    save, cache = np.save, tmp_path / "cache"

    def stopped(path, array):
        if Path(path).name == "geodesics.npy":
            raise KeyboardInterrupt
        save(path, array)

    with monkeypatch.context() as patch:
        patch.setattr(np, "save", stopped)
        with pytest.raises(KeyboardInterrupt):
            interactions.cached(Sequence.load(folder), folder, cache)
    assert not list(cache.iterdir())


def test_key_depends_on_the_version(folder, monkeypatch):
    """Values that an older version computed otherwise would be used."""
    key = interactions.key_of(folder)
    assert interactions.warpgarment.__version__ == version("warpgarment")
    monkeypatch.setattr(interactions.warpgarment, "__version__", "another")
    assert interactions.key_of(folder) != key
