"""The recipes of docs/extending.md, carried out to the letter, with files that are not part of the package."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import pytest
from support.scenes import body, network, skirt, walk

import warpgarment as wg
from warpgarment.objects.garment import Garment

TEXT = (Path(__file__).parents[1] / "docs" / "extending.md").read_text()


@pytest.fixture
def recipes(tmp_path, monkeypatch):
    """Writes the blocks of a section that are files into a folder on the path; gives the others, to run."""

    def of_section(heading: str) -> list[str]:
        section = TEXT.split(f"## {heading}\n")[1].split("\n## ")[0]
        rest = []
        for block in re.findall(r"```python\n(.*?)```", section, re.DOTALL):
            if named := re.match(r"# (\w+)\.py\n", block):
                (tmp_path / f"{named[1]}.py").write_text(block)
                monkeypatch.delitem(sys.modules, named[1], raising=False)
            else:
                rest.append(block)
        return rest

    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(wg.Simulator, "from_pretrained", lambda name: wg.Simulator(network(), "cpu"))
    yield of_section
    for name in ("floor", "speed_limit"):
        sys.modules.pop(name, None)


def test_a_contact_source(recipes):
    """A contact source from outside would not be asked, or its contacts not be solved.

    A skirt whose hem is 5 cm below a floor is above it after 4 frames; without the floor it stays below. It stays out
    of the body too.
    """
    up = np.float32([0.0, 0.25, 0.0])
    garment, motion = Garment(skirt().vertices + up, skirt().faces), body(5, lambda t: (0.02 * t, 0.25, 0.0))
    without = wg.Simulator(network(), "cpu").rollout(garment, motion)
    assert without.vertices[-1, :, 1].min() < -0.04
    (usage,) = recipes("A contact source")
    space = {"garment": garment, "body": motion}
    exec(usage, space)
    result = space["motion"]
    assert result.vertices[0, :, 1].min() < -0.04
    assert result.vertices[-1, :, 1].min() > 0.0
    assert result.status[-1].max_penetration < 1e-3


def test_a_stencil_is_refused_by_the_name_of_its_source(recipes):
    """Contacts between several vertices would be taken for contacts of single ones."""
    (usage,) = recipes("A contact source")
    space = {"garment": skirt(), "body": walk(2)}
    exec(usage, space)
    floor = space["sim"].contact_sources[1]
    find = floor.find
    floor.find = lambda vertices, frame: find(vertices, frame)._replace(vertex=vertices)
    with pytest.raises(ValueError, match="contact source 'floor': `vertex` and `weight` are given"):
        space["sim"].rollout(skirt(), walk(2))


def test_a_corrector(recipes):
    """A corrector from outside would not be called, not be timed, or not count in the forecast of memory.

    2 cm a frame, to 1e-6 m, of a body that carries the skirt along by 5 cm a frame.
    """
    motion = body(4, lambda t: (0.0, 0.05 * t, 0.0))
    (usage,) = recipes("A corrector")
    space = {"garment": skirt(), "body": motion}
    exec(usage, space)
    sim, moved = space["sim"], np.linalg.norm(np.diff(space["motion"].vertices, axis=0), axis=2)
    assert moved.max() == pytest.approx(0.02, abs=1e-6)
    free = wg.Simulator(network(), "cpu").rollout(skirt(), motion).vertices
    assert np.linalg.norm(np.diff(free, axis=0), axis=2).max() > 0.03
    assert sim.timings["speed limit"] > 0.0
    forecast = wg.memory.predict([skirt()], [motion], sim.network.config, correctors=sim.correctors)
    assert forecast.parts["speed limit, steps"] == 16 * 112
