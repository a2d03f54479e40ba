"""Fused kernels for CUDA: when one answers (`fused`), how it is tried beside its torch twin first.

Modules named `*_kernel` import Triton and are imported by `fused` and `trials` alone.
"""
