"""The light template of Anny's bodies, kept in a cache."""

import numpy as np

from warpgarment.bodies import anny
from warpgarment.io.npz import write_npz


def test_a_damaged_template_is_made_again(tmp_path, monkeypatch):
    """Bodies of a whole data set are built on a bit that has turned, or generation ends at each start in an error of
    zip's. Damage at 12 places, a file cut short, empty, of another kind: the numbers are those that were computed."""
    made = []

    def build():
        made.append(1)
        return {name: np.arange(40.0) + k for k, name in enumerate(anny._TEMPLATE)}

    monkeypatch.setenv("WARPGARMENT_CACHE", str(tmp_path))
    monkeypatch.setattr(anny, "_build_template", build)

    def template():
        anny.anny_bodies.cache_clear()
        try:
            return anny.anny_bodies()._data
        finally:
            anny.anny_bodies.cache_clear()

    right = template()
    (path,) = tmp_path.glob("*.npz")
    whole = path.read_bytes()
    write_npz(tmp_path / "other.npz", {"faces": np.zeros(3)})
    damaged = [whole[: len(whole) // 2], b"", b"text", (tmp_path / "other.npz").read_bytes()]
    for at in np.linspace(200, len(whole) - 30, 12).astype(int):
        damaged.append(whole[:at] + bytes([whole[at] ^ 4]) + whole[at + 1 :])
    for content in damaged:
        path.write_bytes(content)
        found = template()
        assert all(np.array_equal(found[name], right[name]) for name in anny._TEMPLATE)
    assert len(made) >= 5
    count = len(made)
    path.write_bytes(whole)
    template()
    assert len(made) == count, "a whole file is not made again"


def test_a_template_that_cannot_be_kept_is_used(tmp_path, monkeypatch):
    """A read-only home would stop the generation for the sake of a cache."""
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("WARPGARMENT_CACHE", str(tmp_path / "file"))
    monkeypatch.setattr(anny, "_build_template", lambda: {name: np.zeros(1) for name in anny._TEMPLATE})
    anny.anny_bodies.cache_clear()
    assert set(anny.anny_bodies()._data) == set(anny._TEMPLATE)
    anny.anny_bodies.cache_clear()
