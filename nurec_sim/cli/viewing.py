"""The command ``view``: scenes, logs, runs and servers in a browser."""

from __future__ import annotations

import contextlib
import signal
import threading
from pathlib import Path
from typing import Annotated

import tyro

from nurec_sim.cli.console import app, chosen_device, out, progress
from nurec_sim.cli.operation import warn

Sources = Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="PATH|HOST:PORT...")]


@app.command
def view(
    sources: Sources,
    *,
    clip: Path | None = None,
    host: str = "127.0.0.1",
    port: int = 8081,
    insecure: bool = False,
    threads: int | None = None,
    cache: Path | None = None,
    device: str = "auto",
) -> None:
    """Look at scenes, logs, runs and servers in a browser. Ctrl-C stops.

    Several reconstructions of one log are compared with a wipe. Pictures are rendered here, so a browser on another
    machine needs no GPU: forward the port with ssh -L. Needs the package viser: pip install "nurec-sim[view]"
    (docs/viewer.md).

    Args:
        sources: scene archives, logs, a run folder (with its scene, unless that is in the cache), and HOST:PORT or
            HOST:PORT/SCENE of servers.
        clip: the log whose recorded images are compared; default: the first log among the sources.
        host: address to listen on; default: localhost only.
        port: 0 selects a free one.
        insecure: listen on an address that other machines can reach; anybody there can look and move things.
        threads: CPU threads that work on one frame; default: all cores.
        cache: where reconstructed logs are kept; $NUREC_SIM_CACHE or ~/.cache/nurec_sim if not given.
        device: render device: auto (a GPU if available), cpu, cuda or cuda:N.
    """
    from nurec_sim.errors import ServerError
    from nurec_sim.serving.server import is_loopback
    from nurec_sim.view import Viewer, open_sources
    from nurec_sim.view.viewer import import_viser

    import_viser()  # before anything slow
    if not (is_loopback(host) or insecure):
        raise ServerError(
            f"refused to listen at {host!r}, which other machines can reach; forward the port with ssh -L instead, or "
            "give --insecure if the network is trusted"
        )
    with contextlib.ExitStack() as stack:
        with progress("opening") as advance:
            opened = open_sources(
                sources, clip, device=chosen_device(device), threads=threads, cache_dir=cache, progress=advance,
                stack=stack,
            )  # fmt: skip
        for note in opened.notes:
            warn(note)
        stopped = threading.Event()
        viewer = stack.enter_context(Viewer(opened, host, port))
        with progress("preparing the renderer"):
            viewer.warm_up()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: stopped.set())
        out.print(f"Viewing {opened.worlds[0].id} at http://{host}:{viewer.port} (Ctrl-C stops)", soft_wrap=True)
        out.print(
            f"from another machine: ssh -L {viewer.port}:127.0.0.1:{viewer.port} THIS_MACHINE, then the same address",
            soft_wrap=True,
        )
        stopped.wait()
    out.print("stopped")
