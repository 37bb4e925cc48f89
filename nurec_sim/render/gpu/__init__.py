"""The CUDA back end: the frames of ``render.spec`` rendered by a GPU, forward and backward; needs the extra ``gpu``.

Nothing outside of this folder imports it, and it imports torch and CUDA's packages only where they are used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "gradients": ["DifferentiableRenderer"],
        "renderer": ["GpuRenderer"],
    },
)
