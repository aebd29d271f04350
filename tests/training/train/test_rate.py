"""The rate of training: operations are counted as PyTorch counts them, and peaks belong to the right devices."""

from __future__ import annotations

import pytest
import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from warpgarment.kernels.features.channels import FEATURES
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.faces import ARCHITECTURE
from warpgarment.nn.faces.network import ManifoldAwareTransformer
from warpgarment.nn.flops import peak_of, step_flops
from warpgarment.training.train.rate import Rate, spelt


@pytest.mark.parametrize("changes", [{}, {"manifold_heads": 0, "heads": 2}, {"manifold_heads": 4, "norm_first": False}])
def test_operations_are_those_pytorch_counts(changes):
    """The formula leaves a product out, or counts one that is not needed. Against PyTorch's own counter, exactly."""
    config = NetworkConfig.small(**({"embedding": 32, "layers": 2, "feed_forward": 48, "dropout": 0.0} | changes))
    network, samples, faces, components = ManifoldAwareTransformer(config), 3, 20, 2
    for head in (network.face_head, network.velocity_head):
        torch.nn.init.ones_(head.weight)
    x = torch.randn(samples, faces, config.history * FEATURES)
    v = torch.randn(samples, components, (config.history - 1) * 3)
    weights = torch.full((samples, faces, faces), 1.0 / faces)
    with sdpa_kernel(SDPBackend.MATH):
        with FlopCounterMode(display=False) as forward:
            output = network.forward_normalised(x, v, weights)
        with FlopCounterMode(display=False) as backward:
            sum(part.sum() for part in output).backward()
    assert samples * sum(ARCHITECTURE.flops(config, faces, components, weights)) == forward.get_total_flops()
    assert step_flops(config, samples, faces, components) == forward.get_total_flops() + backward.get_total_flops()


def test_peaks_belong_to_names():
    """A share of the peak is of another device's, or of one that is not known. Data sheets, dense bfloat16."""
    assert peak_of("NVIDIA H100 80GB HBM3") == 989e12
    assert peak_of("NVIDIA H100 PCIe") == 756e12
    assert peak_of("NVIDIA A100-SXM4-80GB") == 312e12
    assert peak_of("NVIDIA L40S") == 362e12
    assert peak_of("NVIDIA L4") == 121e12
    assert peak_of("NVIDIA L40") is None
    assert peak_of("NVIDIA H100 80GB HBM3 MIG 1g.10gb") is None


def test_rate_counts_running_time_only(monkeypatch):
    """Validation and saving count as training, or several devices as one. By hand."""
    now = [100.0]
    monkeypatch.setattr("warpgarment.training.train.rate.time.monotonic", lambda: now[0])
    rate = Rate(torch.device("cpu"), "bfloat16", processes=2)
    rate.peak = 10e12
    for seconds, counts in ((2.0, True), (50.0, False), (2.0, True)):
        (rate.go if counts else rate.stop)()
        now[0] += seconds
        if counts:
            rate.count(samples=8, flops=int(4e12))
    figures = rate.take()
    assert figures == pytest.approx(
        {"samples_per_second": 8.0, "model_tflops_per_second": 4.0, "matrix_peak_share": 0.2}
    )
    assert spelt(figures) == "8.0 samples/s, 4 TFLOP/s, 20.0% of the matrix peak"
    now[0] += 1.0
    rate.count(samples=3, flops=0)
    assert rate.take()["samples_per_second"] == pytest.approx(6.0)
