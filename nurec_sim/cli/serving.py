"""Commands that serve scenes over gRPC: serve, and serve-grpc with the command line of NVIDIA's renderer."""

from __future__ import annotations

import dataclasses
import glob
import inspect
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from nurec_sim.cli.console import Paths, app, chosen_device, err, progress
from nurec_sim.cli.nre_flags import sort_flags
from nurec_sim.cli.operation import (
    NO_FLAGS,
    Operation,
    OperationFlags,
    scene_dirs,
    server_options,
    service_options,
    warn,
)
from nurec_sim.errors import NurecSimError

if TYPE_CHECKING:
    from nurec_sim.serving.sensor_service import ServiceOptions
    from nurec_sim.serving.server import ServerOptions
    from nurec_sim.serving.store import SceneStore


@app.command
def serve(
    sources: Paths,
    *,
    host: str = "127.0.0.1",
    port: int = 8080,
    threads: int | None = None,
    cache: Path | None = None,
    cache_size: int = 10,
    cache_gb: float | None = None,
    ego_mask_dir: Path | None = None,
    operation: Operation = NO_FLAGS,
) -> None:
    """Serve scenes over gRPC, for AlpaSim, CARLA and NuRec clients. Ctrl-C stops.

    Prints `Serving on <host>:<port>` when ready. Clips are reconstructed on first use and cached. Remote clients
    require TLS, a token, or --insecure.

    Args:
        sources: scene archives, clips, or folders of them.
        host: address to listen on; default: localhost only.
        port: 0 selects a free one.
        threads: CPU threads that work on one frame; half of the cores if not given, so that many clients get the most.
        cache: where reconstructed clips are kept; $NUREC_SIM_CACHE or ~/.cache/nurec_sim if not given.
        cache_size: maximum number of scenes in memory.
        cache_gb: maximum memory for scenes in gigabytes; default: half of the machine's.
        ego_mask_dir: images of the ego car, FOLDER/<rig>/<camera>.png.
        operation: access, limits and monitoring.
    """
    from nurec_sim.serving.server import check_exposure

    options = server_options(operation)
    protected = options.tls is not None or options.token is not None
    check_exposure(host, protected=protected, insecure=operation.insecure)
    store = _store(sources, cache_size, cache_dir=cache, threads=threads, gigabytes=cache_gb, device=_device(operation))
    if not store.ids and operation.upload_dir is None:
        raise NurecSimError("nothing to serve: " + ("; ".join(store.faults.values()) or "give archives or clips"))
    chosen = service_options(operation, ego_mask_dir=ego_mask_dir, scene_dirs=scene_dirs(operation, sources))
    _run(store, host, port, chosen, options, operation)


@app.command(name="serve-grpc")
def serve_grpc(
    *,
    artifact_glob: str | None = None,
    host: str = "localhost",
    port: int = 8080,
    egocar_hood_dir: Path | None = None,
    enable_editing_actors: bool = False,
    cache_size: int = 10,
    max_workers: int | None = None,
    download_cache_dir: Path | None = None,
    download_cache_size: int = 5,
    test_scenes_are_valid: bool = False,
    operation: Operation = NO_FLAGS,
) -> None:
    """Serve scene archives with the command line of NVIDIA's renderer, as AlpaSim starts it.

    Accepts every flag of that renderer, as `--flag value` or `--flag=value`; those that do not apply (--renderer,
    --no-enable-nrend, --use-gsplat, --ray-chunk-size, --enable-timing, --metrics-output-dir, --multiproc-workers, and
    the difix and harmonizer families) are ignored with one warning. Prints
    `Serving on <host>:<port>` when ready. Accepts remote clients without TLS or token: restrict network access.

    Args:
        artifact_glob: archives to serve, such as 'scenes/**/*.usdz'; must end in .usdz.
        host: address to listen on; 0.0.0.0 for all.
        port: 0 selects a free one.
        egocar_hood_dir: images of the ego car, FOLDER/<rig>/<camera>.png.
        enable_editing_actors: render only the moving actors listed in a request, if it lists any.
        cache_size: maximum number of scenes in memory.
        max_workers: frames rendered concurrently; default: the number of cores.
        download_cache_dir: folder for scenes downloaded from client URLs.
        download_cache_size: maximum number of downloaded scenes.
        test_scenes_are_valid: load every scene first, and exit with 1 if one is invalid.
        operation: access, limits and monitoring.
    """
    from nurec_sim.serving.server import is_loopback

    options = server_options(operation)
    if not (is_loopback(host) or operation.insecure or options.tls or options.token):
        warn(
            f"any client that can reach {host}:{port} may call; protect it by --tls-cert and --tls-key, or --token-file"
        )
    if max_workers is not None and operation.workers is None:
        operation = dataclasses.replace(operation, workers=max_workers)
    matches = _matches(artifact_glob)
    store = _store(matches, cache_size, device=_device(operation))
    if artifact_glob is not None and not store.ids:
        raise NurecSimError("nothing to serve: " + "; ".join(store.faults.values()))
    if test_scenes_are_valid:
        _test_scenes(store)
    chosen = service_options(
        operation,
        ego_mask_dir=egocar_hood_dir,
        only_listed_actors=enable_editing_actors,
        download_cache_dir=download_cache_dir,
        download_cache_size=download_cache_size,
        scene_dirs=scene_dirs(operation, [*_glob_folder(artifact_glob), *matches]),
    )
    _run(store, host, port, chosen, options, operation)


@app.command
def health(address: str, *, root_ca: Path | None = None, timeout: float = 4.0) -> None:
    """Check the health of a gRPC server; exit status 1 if it is not serving."""
    # Only for the command list: `cli.main` calls the other module directly for a fast start.
    from nurec_sim.serving.health import check_health

    check_health(address, root_ca=root_ca, timeout_s=timeout)


def sort_serve_grpc(arguments: Sequence[str]) -> list[str]:
    """The arguments of ``serve-grpc`` without those that do not apply, with one warning.

    Raises:
        NurecSimError: unknown flag.
    """
    own = [p for p in inspect.signature(serve_grpc).parameters.values() if p.name != "operation"]
    kinds = [(p.name, p.default) for p in own] + [(f.name, f.default) for f in dataclasses.fields(OperationFlags)]
    switches = [name.replace("_", "-") for name, default in kinds if isinstance(default, bool)]
    values = [name.replace("_", "-") for name, default in kinds if not isinstance(default, bool)]
    lists = [name.replace("_", "-") for name, default in kinds if isinstance(default, tuple)]
    sorted_ = sort_flags(arguments, switches, values, lists)
    if sorted_.ignored:
        warn(f"these flags have no effect on this renderer: {', '.join(dict.fromkeys(sorted_.ignored))}")
    return sorted_.arguments


def _store(
    sources: Sequence[str | Path],
    capacity: int,
    *,
    cache_dir: Path | None = None,
    threads: int | None = None,
    gigabytes: float | None = None,
    device: str = "auto",
) -> SceneStore:
    """Scene store of the sources.

    Raises:
        NurecSimError: a limit is not positive, or the device cannot be used.
    """
    from nurec_sim.compute.cores import usable_cores
    from nurec_sim.serving.store import SceneStore

    if threads is not None and threads < 1:
        raise NurecSimError(f"--threads must be at least 1, got {threads}")
    max_bytes = None if gigabytes is None else int(gigabytes * 1e9)
    try:
        return SceneStore(
            sources,
            capacity=capacity,
            max_bytes=max_bytes,
            cache_dir=cache_dir,
            device=device,
            threads=threads or max(1, usable_cores() // 2),
            on_progress=err.print,
        )
    except ValueError as error:
        raise NurecSimError(str(error)) from None


def _device(flags: OperationFlags) -> str:
    """The device to render on; lines that are not JSON have no place in a log of JSON."""
    return chosen_device(flags.device, quiet=flags.log_format == "json")


def _run(
    store: SceneStore, host: str, port: int, options: ServiceOptions, listening: ServerOptions, flags: OperationFlags
) -> None:
    from nurec_sim.serving.scene_service import SceneOptions
    from nurec_sim.serving.server import SensorServer, run_until_signal

    scene_options = SceneOptions(upload_dir=flags.upload_dir, clip_dirs=flags.clip_dirs)
    try:
        run_until_signal(
            SensorServer(store, host, port, options=options, scene_options=scene_options, server_options=listening)
        )
    except OSError as error:
        raise NurecSimError(str(error)) from None


def _matches(pattern: str | None) -> list[str]:
    """Archives that a pattern matches.

    Raises:
        NurecSimError: it does not end in .usdz, or matches nothing.
    """
    if pattern is None:
        return []
    if not pattern.endswith(".usdz"):
        raise NurecSimError(f"--artifact-glob must end in .usdz, got {pattern!r}; try {pattern.rstrip('/')}/**/*.usdz")
    found = sorted(glob.glob(pattern, recursive=True))
    if not found:
        raise NurecSimError(f"--artifact-glob {pattern!r} matches no file")
    return found


def _glob_folder(pattern: str | None) -> list[Path]:
    """The folder of a pattern: its parts before the first wildcard."""
    if pattern is None:
        return []
    parts = Path(pattern).parent.parts
    fixed = next((i for i, part in enumerate(parts) if glob.has_magic(part)), len(parts))
    return [Path(*parts[:fixed])]


def _test_scenes(store: SceneStore) -> None:
    """Loads every scene once.

    Raises:
        NurecSimError: some are invalid; the text lists them.
    """
    bad = dict(store.faults)
    with progress("loading") as advance:
        for index, scene_id in enumerate(store.ids):
            advance(scene_id, index / len(store.ids))
            try:
                store.get(scene_id)
            except NurecSimError as error:
                bad[scene_id] = str(error)
    if bad:
        texts = "".join(f"\n  {name}: {reason}" for name, reason in bad.items())
        raise NurecSimError(f"{len(bad)} of {len(store.ids) + len(store.faults)} scenes are invalid:{texts}")
