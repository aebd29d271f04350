"""What type checkers and editors are told of the simulator: one garment in, one result out; a list in, a list out."""

from __future__ import annotations

import typing
from collections.abc import Sequence

import numpy as np
import pytest

import warpgarment as wg
from warpgarment.sim.state import SimulationState

ONE = SimulationState[np.ndarray, wg.RolloutStatus]
SEVERAL = SimulationState[list[np.ndarray], list[wg.RolloutStatus]]


@pytest.mark.skipif(not hasattr(typing, "get_overloads"), reason="Python 3.10 does not keep overloads")
@pytest.mark.parametrize(
    ("method", "kinds"),
    [
        (
            "rollout",
            {
                wg.Garment: wg.GarmentMotion,
                Sequence[wg.Garment]: list[wg.GarmentMotion],
                Sequence[wg.Outfit]: list[list[wg.GarmentMotion]],
            },
        ),
        ("start", {wg.Garment: ONE, Sequence[wg.Garment]: SEVERAL}),
    ],
)
def test_overloads_tell_one_from_several(method, kinds):
    """An editor takes the result for anything, or a list for a single motion; other arguments must be those of the
    method itself."""
    function = getattr(wg.Simulator, method)
    own = typing.get_type_hints(function)
    returned = {}
    for overload in typing.get_overloads(function):
        hints = typing.get_type_hints(overload)
        returned[hints.pop("garment")] = hints.pop("return")
        assert hints == {name: kind for name, kind in own.items() if name not in ("garment", "return")}
        assert overload.__kwdefaults__ == function.__kwdefaults__
    assert returned == kinds


def test_an_outfit_is_a_sequence_of_garments():
    """An editor would take an outfit for no argument of `rollout`, or its result for anything."""
    assert issubclass(wg.Outfit, Sequence)
    assert wg.Outfit.__orig_bases__ == (Sequence[wg.Garment],)


def test_a_step_gives_what_it_was_given():
    """The vertices of a state, or of the next one, are of any type."""
    hints = typing.get_type_hints(wg.Simulator.step)
    assert hints["state"] == hints["return"]
    vertices, status = typing.get_args(hints["return"])
    assert typing.get_type_hints(SimulationState.vertices.fget)["return"] is vertices
    assert typing.get_type_hints(SimulationState.status.fget)["return"] is status
    assert vertices is not status
