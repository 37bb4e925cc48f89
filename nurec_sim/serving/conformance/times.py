"""Rules about frames in time: half-open intervals, the ends of a recording."""

from __future__ import annotations

import grpc

from nurec_sim.serving.conformance.kit import check
from nurec_sim.serving.conformance.target import Target

Code = grpc.StatusCode
FAR_US = 60_000_000


def _at(target: Target, start_us: int, end_us: int):
    """A request for [start, end) from where the camera is at the nearest time of the path."""
    nearest = min(max(start_us, target.path.start_us), target.path.end_us)
    request = target.request(t_us=nearest)
    request.frame_start_us, request.frame_end_us = start_us, end_us
    return request


@check("time-first-instant")
def first_instant(target: Target) -> str:
    """The first pose of the path renders: [t, t + 1)."""
    t_us = target.path.start_us
    return f"{target.picture(_at(target, t_us, t_us + 1)).shape[1::-1]} at {t_us}"


@check("time-last-instant")
def last_instant(target: Target) -> str:
    """The last pose of the path renders: [t_last, t_last + 1)."""
    t_us = target.path.end_us
    return f"{target.picture(_at(target, t_us, t_us + 1)).shape[1::-1]} at {t_us}"


@check("time-before")
def before(target: Target) -> str:
    """A frame long before the recording is OUT_OF_RANGE."""
    end_us = max(2, target.path.start_us - FAR_US)
    return target.refused("render_rgb", _at(target, end_us - 1, end_us), Code.OUT_OF_RANGE)


@check("time-after")
def after(target: Target) -> str:
    """A frame long after the recording is OUT_OF_RANGE."""
    start_us = target.path.end_us + FAR_US
    return target.refused("render_rgb", _at(target, start_us, start_us + 1), Code.OUT_OF_RANGE)


@check("time-empty")
def empty(target: Target) -> str:
    """An empty frame [t, t) is INVALID_ARGUMENT: intervals are half-open."""
    return target.refused("render_rgb", _at(target, target.middle_us, target.middle_us), Code.INVALID_ARGUMENT)


@check("time-reversed")
def reversed_frame(target: Target) -> str:
    """A frame that ends before it starts is INVALID_ARGUMENT."""
    return target.refused("render_rgb", _at(target, target.middle_us, target.middle_us - 5), Code.INVALID_ARGUMENT)


@check("time-long-exposure")
def long_exposure(target: Target) -> str:
    """An exposure of 30 ms renders like any other."""
    t_us = target.middle_us
    return f"{target.picture(_at(target, t_us, t_us + 30_000)).shape[1::-1]}"
