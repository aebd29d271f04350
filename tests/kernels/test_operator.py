"""What operators share: the constants of a solver travel as one list of tensors and come back by name."""

from __future__ import annotations

from typing import NamedTuple

import pytest
import torch
from support import meshes

from warpgarment.kernels.collision import CollisionSolver
from warpgarment.kernels.collision.operator import Model
from warpgarment.kernels.operator import pack, unpack
from warpgarment.kernels.poisson import PoissonSolver
from warpgarment.kernels.poisson.operator import matrix_of


class Inner(NamedTuple):
    values: torch.Tensor
    count: int


class Outer(NamedTuple):
    first: Inner
    explicit: bool
    second: Inner
    last: torch.Tensor


def test_a_model_comes_back_by_name():
    """A field is read from the place of another, or a number comes back as a tensor or of another type."""
    model = Outer(Inner(torch.arange(3.0), 2**40), True, Inner(torch.ones(0), -7), torch.eye(2))
    packed = pack(model)
    assert all(isinstance(tensor, torch.Tensor) for tensor in packed)
    assert packed[0] is model.first.values, "tensors are not copied"
    found = unpack(packed, Outer)
    assert (found.first.count, found.explicit, found.second.count) == (2**40, True, -7)
    assert [type(v) for v in (found.first.count, found.explicit)] == [int, bool]
    assert found.first.values is model.first.values
    assert found.second.values is model.second.values
    assert found.last is model.last


def test_a_list_of_another_length_is_refused():
    """Fields of a model that was packed by another version are taken for one another."""
    packed = pack(Inner(torch.ones(1), 1))
    with pytest.raises(ValueError, match="2 tensors are 1 too many for a Only"):
        unpack(packed, NamedTuple("Only", [("values", torch.Tensor)]))
    with pytest.raises(ValueError, match="2 tensors are too few for a Outer"):
        unpack(packed, Outer)


def test_solvers_say_what_they_solve_how():
    """A solver takes the number of one thing for that of another: counted from the arrays that say the same."""
    sheet, large = meshes.skirt(12, 6, waist=0.17), meshes.skirt(20, 8, waist=0.17)
    both = meshes.joined(sheet, large)
    rest, faces = torch.tensor(both.vertices), torch.tensor(both.faces)
    for most, factor_budget in ((10**6, 2**20), (len(sheet.vertices), 2**20), (0, 0)):
        solver = CollisionSolver(rest, faces, largest_compliance=most, factor_budget=factor_budget)
        model = unpack(solver._model, Model)
        assert model.one_core is True
        assert model.dense.inverted == int((model.dense.base >= 0).sum())
        assert model.dense.scratch == len(model.dense.values)  # no two components are equal
        assert model.dense.panels == sum(-(-len(part.vertices) // 16) for part in (sheet, large))
        assert model.factor.factored == int((model.factor.base >= 0).sum())
        assert model.factor.factored + model.factor.unfactored == solver.component_count == 2
        assert model.factor.explicit is False
        assert model.factor.places == sum(-(-len(part.vertices) // 4) * 4 for part in (sheet, large))
    matrix = matrix_of(PoissonSolver(rest, faces)._model)
    assert (matrix.factor.factored, matrix.factor.unfactored) == (2, 0)
    assert len(matrix.system.rows) == len(rest)
