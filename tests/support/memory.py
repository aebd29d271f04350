"""What torch allocates."""

from __future__ import annotations

import gc

import numpy as np
import torch


def allocated(call) -> int:
    """The most bytes that torch had allocated at a time, above what it had before."""
    gc.collect()  # what earlier tests left would be given back within the call, as memory that it does not take
    activities = [torch.profiler.ProfilerActivity.CPU]
    with torch.profiler.profile(activities=activities, profile_memory=True) as profile:
        call()
    events = [event for event in profile.profiler.kineto_results.events() if event.name() == "[memory]"]
    changes = [event.nbytes() for event in sorted(events, key=lambda event: event.start_ns())]
    return int(np.cumsum(changes).max())
