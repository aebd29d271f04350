"""Outfits as objects: what they hold, and what they refuse."""

from __future__ import annotations

from dataclasses import FrozenInstanceError

import pytest
from support.scenes import skirt

from warpgarment.errors import UsageError
from warpgarment.objects.material import Material
from warpgarment.objects.outfit import Outfit


def test_an_outfit_is_a_sequence_that_does_not_change():
    """A list that the user goes on filling would change an outfit, or one material would be for the first garment."""
    garments = [skirt(), skirt()]
    outfit = Outfit(garments, Material.denim())
    garments.clear()
    assert len(outfit) == 2
    assert list(outfit) == [outfit[0], outfit[-1]]
    assert outfit[:1] == (outfit[0],)
    assert outfit.materials == (Material.denim(),) * 2
    assert Outfit(skirt())[0].name == "skirt"
    assert Outfit(list(outfit), [None, Material()]).materials == (None, Material())
    assert repr(outfit) == "Outfit(skirt under skirt)"
    with pytest.raises(FrozenInstanceError):
        outfit.garments = ()


def test_outfits_that_cannot_be_are_refused():
    """The mistake would surface frames later, or as an error about indices."""
    same = skirt()
    with pytest.raises(UsageError, match=r"without garments. Give at least one"):
        Outfit([])
    with pytest.raises(UsageError, match="same garment twice"):
        Outfit([same, same])
    with pytest.raises(UsageError, match=r"2 garments and 1 materials. Give one for each"):
        Outfit([skirt(), skirt()], [Material()])
    with pytest.raises(TypeError, match="made of garments, got str"):
        Outfit(["shirt.obj"])
    with pytest.raises(TypeError, match="expected a Material or None, got str"):
        Outfit([skirt()], ["cotton"])
