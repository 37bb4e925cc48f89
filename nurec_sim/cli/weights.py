"""Commands for network weights: weights list, fetch, check, share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from nurec_sim.cli.console import OnePath, app, out, print_faults, print_table, progress

weights = tyro.extras.SubcommandApp()
app.command(
    weights,
    name="weights",
    help="Network weights: list, fetch released ones, check a file, deduplicate two files.",
)

Fetchable = Literal["pa-front", "pa-multiview", "pq-front", "da3-base"]
Checkable = Literal[
    "pa-front",
    "pa-multiview",
    "pq-front",
    "pa-full",
    "tiny",
    "tiny-selective",
    "tiny-sky-mlp",
    "lidar",
    "lidar-no-floor",
]


@weights.command(name="list")
def list_weights() -> None:
    """Show every network profile, its size, and the location of its weights.

    `reconstruct` uses the first of: --checkpoint PATH, the file in $INSTANT_NUREC_FULL_PT, bundled weights, fetched
    released weights.
    """
    from nurec_sim.network import PROFILES
    from nurec_sim.network.checkpoints import download
    from nurec_sim.network.checkpoints.released import RELEASED
    from nurec_sim.network.lidar.profiles import LIDAR_PROFILES

    profiles = [*PROFILES, *LIDAR_PROFILES]
    with progress("counting parameters"):
        from nurec_sim.network.checkpoints.fit import count_parameters

        parameters = {name: f"{count_parameters(name) / 1e6:.1f} M" for name in profiles}
    rows = []
    for name in (*profiles, *(name for name in RELEASED if name not in PROFILES)):
        released, shipped = RELEASED.get(name), download.shipped_weights(name)
        if shipped is not None:
            facts = (shipped.name, f"{shipped.stat().st_size:,}", "", "bundled")
        elif released is None:
            facts = ("", "", "", "not published")
        else:
            digest = released.sha256[:12] if released.sha256 else "not published"
            cached = download.cached_file(released)
            is_whole = cached is not None and cached.stat().st_size == released.size_bytes
            place = "missing" if cached is None else "fetched" if is_whole else "wrong size"
            facts = (released.filename.rsplit("/")[-1], f"{released.size_bytes:,}", digest, place)
        rows.append((name, parameters.get(name, ""), *facts))
    print_table("weights", rows, ("profile", "parameters", "file", "bytes", "SHA-256", "here"))
    repositories = ", ".join(dict.fromkeys(released.repository for released in RELEASED.values()))
    out.print(f"`nurec-sim weights fetch PROFILE` downloads missing files from {repositories} on Hugging Face;")
    out.print("training can start from da3-base.")


@weights.command
def fetch(
    profile: Annotated[Fetchable, tyro.conf.Positional], *, revision: str | None = None, to: Path | None = None
) -> None:
    """Download released weights from Hugging Face and check their size and digest.

    Needs the extra: pip install 'nurec-sim[hub]'. Interrupted downloads are resumed. The weights are subject to their
    owner's licence, which is printed. Exit status 1 if the file is not the released one.

    Args:
        profile: profile name; da3-base is a starting point for training.
        revision: commit, tag or branch of the repository; default: main.
        to: download to this folder instead of the Hugging Face cache ($HF_HOME); use the file with --checkpoint.
    """
    from nurec_sim.network.checkpoints import download
    from nurec_sim.network.checkpoints.released import RELEASED

    released = RELEASED[profile]
    out.print(f"{released.repository}: {released.filename}, {released.size_bytes:,} bytes ({released.license})")
    path = download.fetch(released, revision, to)
    known_by = "size and SHA-256 are" if released.sha256 else "size is"
    out.print(f"{known_by} right: {path}", soft_wrap=True, markup=False)
    if profile != "da3-base" and (revision or to):
        out.print(f"use it with --checkpoint {path}", soft_wrap=True, markup=False)


@weights.command
def check(path: OnePath, *, profile: Checkable | None = None) -> None:
    """Identify a weights file, its profile and its faults.

    Reads .pth files of torch.save, training checkpoints (.ckpt) and .safetensors, without executing code in them.
    Prints a table, then every fault as one line. Exit status 1 if there are faults.

    Args:
        path: the file.
        profile: expected profile; default: any matching one.
    """
    with progress(f"reading {path.name}"):
        from nurec_sim.network.checkpoints.fit import check_weights

        report = check_weights(path, profile)
    print_table(path.name, report.facts)
    print_faults(report.faults)
    out.print("no faults")


@weights.command
def share(path: OnePath, *, other: Path, to: Path) -> None:
    """Write a weights file without the tensors that are identical in another file.

    For profiles that differ in one part only: the small file is read together with the other one, which must stay
    unchanged in the same folder.

    Args:
        path: the complete file, .safetensors.
        other: the file with the shared tensors, .safetensors.
        to: the file to write, in the folder of the other one; an existing file is replaced.
    """
    from nurec_sim.network.checkpoints.shared import save_difference

    count = save_difference(path, other, to)
    out.print(f"{to}: {count} tensors shared with {other.name}; {to.stat().st_size:,} bytes", soft_wrap=True)
