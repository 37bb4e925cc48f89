"""PLY and sky files for tests, written without the code that is tested."""

import struct

import numpy as np

from nurec_sim import geometry

NEEDED = "x y z rot_0 rot_1 rot_2 rot_3 scale_0 scale_1 scale_2 opacity f_dc_0 f_dc_1 f_dc_2".split()


def ply(path, properties, rows, form="binary_little_endian", count=None, extra=()):
    """A PLY file written the simple way: ``properties`` are 'type name', rows hold a number for each."""
    codes = {"float": "f", "double": "d", "uchar": "B", "int": "i", "short": "h", "float32": "f", "uint8": "B"}
    lines = ["ply", f"format {form} 1.0", *extra, f"element vertex {len(rows) if count is None else count}",
             *(f"property {p}" for p in properties), "end_header", ""]  # fmt: skip
    if form == "ascii":
        body = "".join(" ".join(repr(float(v)) for v in row) + "\n" for row in rows).encode()
    else:
        order = "<" if "little" in form else ">"
        body = b"".join(struct.pack(order + "".join(codes[p.split()[0]] for p in properties), *row) for row in rows)
    path.write_bytes("\n".join(lines).encode() + body)
    return path


def values(n=5, k=0, seed=0):
    """Plausible values of ``n`` vertices by property name."""
    rng = np.random.default_rng(seed)
    names = [*NEEDED, *(f"f_rest_{i}" for i in range(3 * k))]
    return {name: rng.normal(size=n).astype(np.float32).astype(float) for name in names}


def standard(path, table, order=None, kind="float", **kwargs):
    names = order or list(table)
    rows = list(zip(*(table[name].tolist() for name in names), strict=True))
    return ply(path, [f"{kind} {name}" for name in names], rows, **kwargs)


def textured_sky(size=16):
    """A sky whose colour is a smooth function of the world direction."""
    return (geometry.cubemap_directions(size) * 0.4 + 0.5).astype(np.float32)
