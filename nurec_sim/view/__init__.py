"""The viewer: scenes, rollouts and logs in a browser; pictures come from the renderer.

The browser side is viser (extra ``view``). Each browser tab has a session of its own: ``state`` holds what it looks at,
``picture`` turns that into an image, ``drawing`` does so in a thread, ``panel`` and ``handles`` change the state.

Public names load on first use, so that importing the package costs nothing.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "picture": ["Painter"],
        "sources": ["Opened", "World", "open_sources"],
        "state": ["Session", "View"],
        "viewer": ["Viewer"],
    },
)
