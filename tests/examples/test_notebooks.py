"""The notebooks are thin: valid, without outputs, and their cells run one after the other on a short walk."""

from __future__ import annotations

from pathlib import Path

import nbformat
import pytest
from PIL import Image
from support.documentation import stage

import warpgarment as wg

NOTEBOOKS = sorted((Path(__file__).resolve().parents[2] / "examples" / "notebooks").glob("*.ipynb"))


def test_there_are_notebooks() -> None:
    """The tests below would pass on an empty folder."""
    assert len(NOTEBOOKS) == 5


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook(path, tmp_path, monkeypatch) -> None:
    """A notebook that no program opens, that carries somebody's outputs, or of which a cell fails or draws nothing."""
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(not cell.outputs and cell.execution_count is None for cell in cells)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(wg.demo, "assets", lambda *_: stage.assets())
    known: dict = {}
    for number, cell in enumerate(cells):
        exec(compile(cell.source, f"{path.name}, cell {number}", "exec"), known)
    (picture,) = (tmp_path / "out").glob("*.png")
    assert min(Image.open(picture).size) > 200
