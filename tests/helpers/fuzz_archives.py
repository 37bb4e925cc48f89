"""Mutated scene archives: whatever is in one, it is read or refused with an ``ArchiveError``."""

from __future__ import annotations

import hashlib
import json
import random
import time
from pathlib import Path

from fuzz_requests import Tally
from mutations import damage
from serving_world import scene

from nurec_sim.errors import ArchiveError
from nurec_sim.files.zip_package import Package, write_package
from nurec_sim.scene import read_scene, write_scene
from nurec_sim.scene.archive import MANIFEST

LIMIT_S = 30.0
_NUMBERS = (0, 1, -1, 2**31, 2**63, 1e308, -0.5, None, True, "", "x", [], {}, [[]])


def fuzz_archives(count: int, folder: Path, seed: int = 0, report=lambda done, tally: None) -> Tally:
    """Archives with damaged bytes, and archives whose members were changed and whose hashes fit again."""
    tally = Tally()
    good = write_scene(scene(), folder / "good.usdz")
    whole = good.read_bytes()
    with Package(good) as package:
        members = {name: bytes(package.read(name)) for name in package.names}
    path = folder / "mutated.usdz"
    for number in range(count):
        rng = random.Random(f"{seed}/{number}")
        if rng.random() < 0.4:
            path.write_bytes(damage(rng, whole))
        else:
            _forge(rng, members, path)
        begin = time.perf_counter()
        try:
            read_scene(path)
            tally.codes["read"] += 1
        except ArchiveError as error:
            tally.codes["ArchiveError"] += 1
            if not str(error):
                tally.faults.append(f"archive {number}: refused without a reason")
        except Exception as error:
            tally.codes[type(error).__name__] += 1
            tally.faults.append(f"archive {number}: {type(error).__name__}: {str(error)[:300]}")
        seconds = time.perf_counter() - begin
        tally.slowest_s = max(tally.slowest_s, seconds)
        if seconds > LIMIT_S:
            tally.faults.append(f"archive {number}: took {seconds:.1f} s")
        if number % 100 == 99:
            report(number + 1, tally)
    return tally


def _forge(rng: random.Random, members: dict[str, bytes], path: Path) -> None:
    """An archive with one or two members changed, and a manifest that agrees with them."""
    changed = dict(members)
    for _ in range(rng.choice((1, 1, 2))):
        name = rng.choice(sorted(changed))
        data = changed[name]
        if rng.random() < 0.08:
            del changed[name]
        elif name.endswith(".json") and rng.random() < 0.7:
            changed[name] = _changed_json(rng, data)
        else:
            changed[name] = damage(rng, data)
    if MANIFEST in changed:
        try:
            manifest = json.loads(changed[MANIFEST])
            hashed = {name: data for name, data in changed.items() if name != MANIFEST}
            manifest["sha256"] = {name: hashlib.sha256(data).hexdigest() for name, data in hashed.items()}
            changed[MANIFEST] = json.dumps(manifest).encode()
        except (ValueError, TypeError):
            pass  # the manifest itself is damaged
    write_package(path, changed)


def _changed_json(rng: random.Random, data: bytes) -> bytes:
    """The document with one value replaced, at any depth."""
    document = json.loads(data)
    holder = document
    while isinstance(holder, dict | list) and len(holder):
        key = rng.choice(sorted(holder)) if isinstance(holder, dict) else rng.randrange(len(holder))
        inner = holder[key]
        if not isinstance(inner, dict | list) or not len(inner) or rng.random() < 0.3:
            holder[key] = rng.choice(_NUMBERS)
            break
        holder = inner
    return json.dumps(document).encode()
