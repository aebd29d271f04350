"""Layers of networks in training on a CPU: kernels forward and back."""
