"""Files on disk: written completely or not at all, tried beforehand, opened with limits, kept as caches."""
