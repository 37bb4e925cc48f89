"""Verbs that talk to a running server: upload."""

from __future__ import annotations

from pathlib import Path

from nurec_sim.cli.console import OnePath, app, out, progress
from nurec_sim.errors import NurecSimError


@app.command
def upload(
    source: OnePath,
    *,
    server: str = "127.0.0.1:8080",
    reconstruct: bool = False,
    token_file: Path | None = None,
    root_ca: Path | None = None,
    client_cert: Path | None = None,
    client_key: Path | None = None,
) -> None:
    """Upload a scene archive or a zipped clip to a running server, which serves it from then on.

    The server must have been started with --upload-dir. The token may be given in $NUREC_SIM_TOKEN.

    Args:
        source: a scene archive (.usdz), or a clip (.zip).
        server: HOST:PORT.
        reconstruct: reconstruct the clip now instead of on first use.
        token_file: file with the server's token.
        root_ca: root certificates (PEM) for TLS; default: unencrypted.
        client_cert: client certificate (PEM) for mutual TLS.
        client_key: its private key (PEM).
    """
    from nurec_sim.serving.scene_client import SceneClient
    from nurec_sim.serving.server import read_token

    if reconstruct and source.suffix != ".zip":
        raise NurecSimError(f"--reconstruct is for clips, {source.name} is not one")
    try:
        with SceneClient(
            server, token=read_token(token_file), root_ca=root_ca, client_cert=client_cert, client_key=client_key
        ) as client:
            client.stats()  # fails here, at the timeout, if there is no server
            with progress("uploading") as advance:
                scene_id = client.upload(source, advance)
            if reconstruct:
                with progress("reconstructing") as advance:
                    client.reconstruct(scene_id=scene_id, progress=advance)
    except OSError as error:
        raise NurecSimError(f"{error.filename or source}: {error.strerror or error}") from None
    out.print(f"uploaded as {scene_id}", soft_wrap=True)
