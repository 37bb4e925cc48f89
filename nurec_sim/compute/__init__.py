"""How kernels are compiled, and how long computations give way to others."""
