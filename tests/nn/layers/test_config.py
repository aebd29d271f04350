"""Settings of a LayersNet that cannot be."""

from __future__ import annotations

import pytest

from warpgarment.nn import checkpoint
from warpgarment.nn.layers.config import LayersNetConfig
from warpgarment.nn.layers.network import LayersNet


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"history": 4}, "history of a LayersNet is 3 frames, got 4"),
        ({"world_heads": 8}, "world_heads must lie between 1 and heads - 1 = 7, got 8"),
        ({"rotation": "none"}, 'rotation must be "orthogonal" or "published", got \'none\''),
        ({"embedding": 16}, "a head must be at least 4 wide to be turned, got 2"),
        ({"body_radius": 0.0}, "body_radius must be positive and finite, got 0"),
        ({"patch_radius": float("nan")}, "patch_radius must be positive and finite, got nan"),
        ({"patch_neighbours": 0}, "patch_neighbours must be at least 1, got 0"),
    ],
)
def test_settings_that_cannot_be(settings, message):
    """A network would be made that fails later, or computes nothing."""
    with pytest.raises(ValueError, match=message):
        LayersNetConfig(**settings)


def test_the_paper_is_a_setting(tmp_path):
    """The published form would not be what a file of it holds, or not differ from this project's."""
    paper = LayersNetConfig.paper()
    assert (paper.rotation, paper.heading, paper.decoder, paper.feed_forward) == ("published", "world", 268, 256)
    assert LayersNetConfig().rotation == "orthogonal"
    assert LayersNetConfig().heading == "canonical"
    LayersNet(paper).save(tmp_path / "paper.safetensors")
    assert checkpoint.load(tmp_path / "paper.safetensors").config == paper
