"""The CPU back end: Numba kernels and the stages that run them."""
