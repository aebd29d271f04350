"""Frames on a CPU without Python between their kernels: pieces of them are recorded, and then replayed."""
