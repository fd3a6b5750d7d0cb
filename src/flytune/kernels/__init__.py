"""Kernels: a JAX function of one element as one compiled loop over a batch (docs/concepts/kernels.md)."""
