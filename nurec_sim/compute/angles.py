"""Angles in kernels that process many points: arithmetic only, so that compilers do several at once."""

from __future__ import annotations

import math

from nurec_sim.compute.kernels import unchecked_inner

_FLAT, _STEEP = math.tan(math.pi / 8), math.tan(3 * math.pi / 8)
_P = (-8.750608600031904122785e-1, -1.615753718733365076637e1, -7.500855792314704667340e1, -1.228866684490136173410e2,
      -6.485021904942025371773e1)  # fmt: skip
_Q = (2.485846490142306297962e1, 1.650270098316988542046e2, 4.328810604912902668951e2, 4.853903996359136964868e2,
      1.945506571482613964425e2)  # fmt: skip
"""Rational approximation of the arctangent up to tan(pi / 8), from the Cephes mathematical library (``atan.c``)."""
_REST = 6.123233995736765886130e-17
"""What pi / 2 as a float lacks."""


@unchecked_inner
def arctan2(y: float, x: float) -> float:
    """The angle of a finite vector as ``math.atan2`` gives it, within three units of the last digit; 0 for no vector.

    The signs of zeros do not count: a vector along the negative x axis has the angle pi.
    """
    across, along = abs(y), abs(x)
    steep, flat = across > _STEEP * along, across <= _FLAT * along
    # Turned by -90 or -45 degrees: the tangent is then within tan(pi / 8).
    top = -along if steep else (across if flat else across - along)
    base = across if steep else (along if flat else across + along)
    tangent = top / (base + 1e-300)
    z = tangent * tangent
    p = (((_P[0] * z + _P[1]) * z + _P[2]) * z + _P[3]) * z + _P[4]
    q = ((((z + _Q[0]) * z + _Q[1]) * z + _Q[2]) * z + _Q[3]) * z + _Q[4]
    start = math.pi / 2 if steep else (0.0 if flat else math.pi / 4)
    rest = _REST if steep else (0.0 if flat else 0.5 * _REST)
    angle = start + (tangent * (z * p / q) + rest + tangent)
    angle = math.pi - angle if x < 0 else angle
    return -angle if y < 0 else angle
