"""Renders Gaussian scenes: cameras of any lens and shutter, spinning LiDARs; ``spec`` is the readable reference.

Public names load on first use, so that importing the package costs nothing.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submodules=["spec"],
    submod_attrs={
        "cpu.renderer": ["CpuRenderer"],
        "device": ["Renderer", "choose_device", "make_renderer"],
        "images.encode": ["encode_image"],
        "images.still": ["render_view"],
        "images.sweep": ["render_sweep"],
        "requests": ["check_request"],
    },
)
