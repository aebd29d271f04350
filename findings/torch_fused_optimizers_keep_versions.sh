#!/usr/bin/env bash
# PyTorch: fused optimizers change weights and leave their versions as they were
#
# Expected: an optimizer's step counts as a change in place: `weight._version` grows, what was made from the weight
#           can be found stale by it, and a backward pass through a graph from before the step is refused, since
#           a saved tensor has been modified.
# Seen:     so it is with AdamW as it is by default. With fused=True (AdamW, Adam, SGD, Adagrad, on the CPU too) the
#           version stays 0 after the step, and the backward pass gives a gradient with the new weight, without a word.
# Versions: torch 2.13.0, numpy 2.4.6, Python 3.11, on the CPU.
# So:       whatever is kept beside weights (packed or quantised copies, folded norms) also needs to know of optimizer
#           steps: torch.optim.optimizer.register_optimizer_step_post_hook counts those of all optimizers
#           (warpgarment/nn/patches/changes.py). A test with the default optimizer does not show it.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
"${PYTHON:-python3}" -m venv "$work/venv"
"$work/venv/bin/python" -m pip install -qq --disable-pip-version-check torch==2.13.0 numpy==2.4.6
cat >"$work/show.py" <<'PY'
import torch


def version_after(kind, **options):
    """The version of a weight after a step that changes it."""
    weight = torch.nn.Parameter(torch.ones(4))
    weight.grad = torch.ones(4)
    kind([weight], lr=0.5, **options).step()
    assert not torch.equal(weight.detach(), torch.ones(4))
    return weight._version


def late_gradient(fused):
    """d(w x)/dx by a backward pass after a step, where w was 1; None if it is refused."""
    weight, x = torch.nn.Parameter(torch.ones(1)), torch.ones(1, requires_grad=True)
    result = weight * x
    weight.grad = torch.ones(1)
    torch.optim.AdamW([weight], lr=0.5, weight_decay=0.0, fused=fused).step()
    try:
        result.sum().backward()
    except RuntimeError:
        return None
    return float(x.grad)


print("torch", torch.__version__)
kinds = (torch.optim.AdamW, torch.optim.Adam, torch.optim.SGD, torch.optim.Adagrad)
plain = {kind.__name__: version_after(kind) for kind in kinds}
fused = {kind.__name__: version_after(kind, fused=True) for kind in kinds}
late = late_gradient(False), late_gradient(True)
print("expected: versions grow, and a late backward pass is refused, fused or not")
print(f"seen:     versions {plain}, fused {fused}")
print(f"          late gradient of w x, w = 1: plain {late[0]}, fused {late[1]}")
still = min(plain.values()) > 0 and not any(fused.values()) and late[0] is None and abs(late[1] - 0.5) < 1e-3
raise SystemExit(0 if still else "this has changed")
PY
"$work/venv/bin/python" "$work/show.py"
