"""Many shots in one run: `warpgarment simulate --jobs jobs.jsonl`."""
