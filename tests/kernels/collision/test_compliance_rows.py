"""Rows of the inverse of B, against a dense inverse in float64: whenever they are made, with whichever others."""

import numpy as np
import pytest
import torch
from reference import collision as reference
from support import meshes
from support.poison import poison_outputs

from warpgarment.kernels import collision
from warpgarment.kernels.collision import compliance_rows
from warpgarment.kernels.collision.operator import Model
from warpgarment.kernels.operator import unpack


@pytest.fixture(autouse=True)
def poisoned(monkeypatch):
    """Every output and work array starts as NaN."""
    return poison_outputs(monkeypatch)


SMALL, LARGE = meshes.skirt(22, 8, waist=0.16), meshes.skirt(24, 9, waist=0.17)


def model_of(*rests: meshes.Mesh, **options) -> Model:
    rest = meshes.joined(*rests)
    tensors = torch.tensor(rest.vertices), torch.tensor(rest.faces)
    return unpack(collision.CollisionSolver(*tensors, largest_compliance=0, **options)._model, Model)


def normals(model: Model, vertices) -> torch.Tensor:
    """Contacts at these vertices."""
    normal = torch.zeros((len(model.vertex_component), 3), dtype=torch.float64)
    normal[vertices, 1] = 1.0
    return normal


def row(model: Model, vertex: int) -> np.ndarray:
    """The row that is kept of a vertex, in the order of the vertices of its component."""
    rows, component = model.rows, int(model.vertex_component[vertex])
    size = int(model.system.start[component + 1] - model.system.start[component])
    slot = int(rows.slot[rows.key[vertex]])
    assert slot >= 0
    first = int(rows.room[rows.block[component]]) + slot * (-(-size // 16) * 16)
    return rows.values[first : first + size].numpy()


def exact(rest: meshes.Mesh) -> np.ndarray:
    return np.linalg.inv(reference.base(rest.vertices, rest.faces, 0.5, 1e-3).toarray())


def test_rows_are_those_of_the_inverse():
    """Forces would push cloth at other vertices than those in contact. Three garments, two of them equal, which share
    rows; float32 rounding of the largest entry, and what the factor loses, 1e-6 of it."""
    model = model_of(SMALL, LARGE, SMALL)
    starts = np.cumsum([0, len(SMALL.vertices), len(LARGE.vertices)])
    rng = np.random.default_rng(0)
    expected = [exact(SMALL), exact(LARGE), exact(SMALL)]
    for count in (1, 3, 30):
        chosen = [rng.choice(len(z), count, replace=False) for z in expected]
        normal = normals(model, np.concatenate([start + part for start, part in zip(starts, chosen, strict=True)]))
        lines = compliance_rows.lines_of(model.system, model.factor, model.rows, model.vertex_component, normal)
        assert (lines.base >= 0).all()
        assert lines.base[0] == lines.base[2] != lines.base[1]
        assert lines.entries == 3 * count * (-(-count // 16) * 16)
        for start, part, z in zip(starts, chosen, expected, strict=True):
            for vertex in part:
                found = row(model, start + vertex)
                np.testing.assert_allclose(found, z[vertex], rtol=0, atol=1e-6 * np.abs(z).max())


def test_rows_do_not_depend_on_what_was_kept():
    """A rollout would change with what was simulated before it. Bit for bit, one by one, together, and after rows were
    dropped for want of room."""
    entries = 20 * (-(-len(LARGE.vertices) // 16) * 16)
    together, single, short = model_of(LARGE), model_of(LARGE), model_of(LARGE, row_budget=entries)
    chosen = np.arange(5, 125, 6)
    compliance_rows.lines_of(
        together.system, together.factor, together.rows, together.vertex_component, normals(together, chosen)
    )
    for vertex in chosen[::-1]:
        compliance_rows.lines_of(
            single.system, single.factor, single.rows, single.vertex_component, normals(single, [vertex])
        )
    for other in (np.arange(1, 21), chosen, chosen[3:9], np.arange(40, 55), chosen):
        compliance_rows.lines_of(short.system, short.factor, short.rows, short.vertex_component, normals(short, other))
        assert short.rows.used[0] <= 20
        assert sorted(short.rows.slot[short.rows.slot >= 0].tolist()) == list(range(int(short.rows.used[0])))
    for vertex in chosen:
        assert np.array_equal(row(together, vertex), row(single, vertex))
        assert np.array_equal(row(together, vertex), row(short, vertex))


def test_more_contacts_than_rows_are_solved_otherwise():
    """Memory would grow without a limit, or such a garment have no forces. To 0.02 mm, which is what is promised, the
    result is that without rows."""
    entries = 2 * 20 * (-(-len(LARGE.vertices) // 16) * 16)
    few, none = ({"largest_compliance": 0, "row_budget": budget} for budget in (entries, 0))
    both = meshes.joined(SMALL, LARGE)
    rest, faces = torch.tensor(both.vertices), torch.tensor(both.faces)
    contacts = collision.contact_set.Contacts(torch.zeros(len(rest), 3).double(), torch.zeros(len(rest), 3).double(), 0)
    contacts.normal[:15, 0] = 1.0  # of the small skirt
    contacts.normal[len(SMALL.vertices) : len(SMALL.vertices) + 60, 0] = 1.0
    contacts.anchor[:, 0] = 0.3
    results = [collision.CollisionSolver(rest, faces, **options).solve(rest, contacts) for options in (few, none)]
    np.testing.assert_allclose(*results, rtol=0, atol=2e-5)
    assert (results[0] - rest).abs().max() > 0.01
    model = model_of(SMALL, LARGE, row_budget=entries)
    lines = compliance_rows.lines_of(model.system, model.factor, model.rows, model.vertex_component, contacts.normal)
    assert lines.base[0] >= 0 > lines.base[1]
