"""Fuzzing at full length: mutated requests through the server's handlers and a socket, and mutated scene archives.

``python benchmarks/fuzz.py [--requests 20000] [--archives 2000] [--seed 0]`` prints counts by status and ends with 1 if
anything crashed, hung, or ended with a status outside of the map. One request in twenty goes over a socket.
"""

from __future__ import annotations

import argparse
import logging
import sys
import tempfile
import time
import warnings
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "helpers"))


def main() -> int:
    """Runs all three parts; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--requests", type=int, default=20_000)
    parser.add_argument("--archives", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    from fuzz_archives import fuzz_archives
    from fuzz_requests import fuzz_handlers, fuzz_socket

    def report(done, tally) -> None:
        print(f"  {done:,} done, {len(tally.faults)} faults, slowest {tally.slowest_s:.2f} s", flush=True)

    over_socket = arguments.requests // 20
    faults = 0
    with tempfile.TemporaryDirectory() as folder:
        for name, run in (
            ("requests", lambda: fuzz_handlers(arguments.requests - over_socket, arguments.seed, report)),
            ("requests over a socket", lambda: fuzz_socket(over_socket, arguments.seed + 1)),
            ("archives", lambda: fuzz_archives(arguments.archives, Path(folder), arguments.seed, report)),
        ):
            begin = time.perf_counter()
            tally = run()
            total = sum(tally.codes.values())
            print(f"{total:,} {name} in {time.perf_counter() - begin:.0f} s, slowest {tally.slowest_s:.2f} s")
            print("  " + ", ".join(f"{count:,} {code}" for code, count in tally.codes.most_common()))
            for fault in tally.faults[:50]:
                print(f"  FAULT {fault}")
            faults += len(tally.faults)
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
