"""Single images as self-contained video key frames: H.264 access units and AV1 temporal units."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np
from jaxtyping import UInt8

from nurec_sim.errors import RequestError


@dataclass(frozen=True)
class _Encoder:
    """One encoder of FFmpeg: its settings, the largest quantiser, and the sizes that it takes."""

    name: str
    worst: int
    settings: dict[str, str] = field(default_factory=dict)
    min_px: int = 1
    odd_sizes: bool = True
    """Whether it takes odd sizes with colours at half of the resolution; if not, those get colours at the full one."""


_ENCODERS = {
    "avc": (_Encoder("libx264", 51, {"preset": "veryfast", "tune": "zerolatency"}, odd_sizes=False),),
    "av1": (
        _Encoder("libsvtav1", 63, {"preset": "10", "svtav1-params": "lp=1"}, min_px=4),
        _Encoder("libaom-av1", 63, {"cpu-used": "8", "usage": "allintra"}),
    ),
}


def is_available(video_format: str) -> bool:
    """Whether this installation of PyAV can encode ``avc`` or ``av1``."""
    return _encoder_of(video_format) is not None


def encode_frame(rgb: UInt8[np.ndarray, "h w 3"], video_format: str, quality: int) -> bytes:
    """One key frame: for ``avc`` in Annex B form with its parameter sets, for ``av1`` as OBUs with a sequence header.

    Args:
        rgb: the image.
        video_format: ``avc`` or ``av1``.
        quality: 1..100; the quantiser falls from its largest value to 0 with it.

    Raises:
        RequestError: there is no encoder here, or the image is too small for it.
    """
    import av

    encoder = _encoder_of(video_format)
    if encoder is None:
        raise RequestError(f"there is no encoder for {video_format!r} in this installation of PyAV")
    height, width = rgb.shape[:2]
    if min(height, width) < encoder.min_px:
        raise RequestError(
            f"the {video_format} encoder takes sides of at least {encoder.min_px} pixels, got {width}x{height}"
        )
    halved = encoder.odd_sizes or (height % 2 == 0 and width % 2 == 0)
    os.environ.setdefault("SVT_LOG", "1")  # errors only: SVT-AV1 would write its settings to stderr for every frame
    context = av.VideoCodecContext.create(encoder.name, "w")
    assert isinstance(context, av.VideoCodecContext)  # the annotation of `create` says less
    context.width, context.height, context.pix_fmt = width, height, "yuv420p" if halved else "yuv444p"
    context.time_base, context.framerate = Fraction(1, 30), Fraction(30)
    context.thread_count = 1  # the same bytes on any machine
    context.options = encoder.settings | {"crf": str(round(encoder.worst * (100 - quality) / 100))}
    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24").reformat(format=context.pix_fmt)
    frame.pts = 0
    try:
        return b"".join(bytes(packet) for packet in (*context.encode(frame), *context.encode(None)))
    except av.FFmpegError as error:
        raise RequestError(f"an image of {width}x{height} cannot be encoded as {video_format}: {error}") from error


def _encoder_of(video_format: str) -> _Encoder | None:
    import av

    for encoder in _ENCODERS[video_format]:
        try:
            av.Codec(encoder.name, "w")
        except ValueError:  # av.codec.codec.UnknownCodecError
            continue
        return encoder
    return None
