"""Rules about image formats and sizes."""

from __future__ import annotations

import grpc
import numpy as np

from nurec_sim.serving.conformance.kit import check
from nurec_sim.serving.conformance.target import HEIGHT_PX, Failed, Skipped, Target, decode, difference, expect
from nurec_sim.serving.wire import ImageFormat

Code = grpc.StatusCode


@check("png")
def png(target: Target) -> str:
    """A PNG comes in the requested size and shows something."""
    data = target.call("render_rgb", target.request()).image_bytes
    expect(data.startswith(b"\x89PNG"), f"it begins with {data[:8]!r}")
    image = decode(data)
    width = target.width(target.camera().intrinsics)
    expect(image.shape[:2] == (HEIGHT_PX, width), f"{width}x{HEIGHT_PX} was asked, got {image.shape[1::-1]}")
    expect(int(image.max()) > 10, "the picture is black")
    return f"{image.shape[1]}x{image.shape[0]}, mean {image.mean():.0f}"


@check("jpeg")
def jpeg(target: Target) -> str:
    """A JPEG of quality 95 is close to the PNG."""
    request = target.request(image_format=ImageFormat.JPEG)
    data = target.call("render_rgb", request).image_bytes
    expect(data.startswith(b"\xff\xd8"), f"it begins with {data[:8]!r}")
    gap = difference(decode(data), target.picture(target.request()))
    expect(gap < 8, f"it differs from the PNG by {gap:.1f} steps on average")
    return f"{gap:.2f} steps from the PNG"


@check("jpeg-quality")
def jpeg_quality(target: Target) -> str:
    """image_quality of a JPEG is heeded, and 95 if it is left out."""
    sizes = {}
    for quality in (0, 20, 95):
        request = target.request(image_format=ImageFormat.JPEG)
        request.image_quality = quality
        sizes[quality] = len(target.call("render_rgb", request).image_bytes)
    expect(sizes[20] < sizes[95], f"quality 20 takes {sizes[20]} bytes, quality 95 takes {sizes[95]}")
    expect(sizes[0] == sizes[95], f"without a quality it takes {sizes[0]} bytes, with 95 it takes {sizes[95]}")
    return f"{sizes[20]:,} bytes at 20, {sizes[95]:,} at 95"


@check("rgb-planar")
def rgb_planar(target: Target) -> str:
    """RGB_UINT8_PLANAR is all red, then all green, then all blue bytes, the same pixels as the PNG."""
    image = target.picture(target.request())
    data = target.call("render_rgb", target.request(image_format=ImageFormat.RGB_UINT8_PLANAR)).image_bytes
    expect(len(data) == image.size, f"{image.size} bytes are expected, got {len(data)}")
    planes = np.moveaxis(np.frombuffer(data, np.uint8).reshape(3, *image.shape[:2]), 0, 2)
    gap = difference(planes, image)
    expect(gap < 0.5, f"it differs from the PNG by {gap:.1f} steps on average")
    return f"{len(data):,} bytes"


def _optional_format(target: Target, image_format: int, read) -> str:
    """A format that a server may refuse, but then as INVALID_ARGUMENT."""
    request = target.request(image_format=image_format)
    try:
        data = target.call("render_rgb", request).image_bytes
    except grpc.RpcError as error:
        if error.code() == Code.INVALID_ARGUMENT:
            raise Skipped(f"not offered: {error.details()}") from error
        raise Failed(f"INVALID_ARGUMENT or a picture is expected, got {error.code().name}") from error
    gap = difference(read(data), target.picture(target.request()))
    expect(gap < 12, f"it differs from the PNG by {gap:.1f} steps on average")
    return f"{len(data):,} bytes, {gap:.2f} steps from the PNG"


@check("jpeg2000")
def jpeg2000(target: Target) -> str:
    """JPEG2000, if offered, is close to the PNG."""
    return _optional_format(target, ImageFormat.JPEG2000, decode)


@check("avc")
def avc(target: Target) -> str:
    """AVC, if offered, is one H.264 access unit that decodes alone."""
    return _optional_format(target, ImageFormat.AVC, lambda data: _decode_video(data, "h264"))


@check("av1")
def av1(target: Target) -> str:
    """AV1, if offered, is one temporal unit that decodes alone."""
    return _optional_format(target, ImageFormat.AV1, lambda data: _decode_video(data, "libdav1d"))


def _decode_video(data: bytes, decoder: str) -> np.ndarray:
    import av

    try:
        context = av.CodecContext.create(decoder, "r")
    except ValueError as error:
        raise Skipped(f"there is no decoder {decoder} here") from error
    assert isinstance(context, av.VideoCodecContext)
    frames = [*context.decode(av.Packet(data)), *context.decode(None)]
    expect(len(frames) == 1, f"one frame is expected, {len(frames)} were decoded")
    return frames[0].to_ndarray(format="rgb24")


@check("format-unknown")
def format_unknown(target: Target) -> str:
    """An image format that does not exist is INVALID_ARGUMENT."""
    return target.refused("render_rgb", target.request(image_format=77), Code.INVALID_ARGUMENT)


@check("deterministic")
def deterministic(target: Target) -> str:
    """The same request gives the same bytes, also when many ask at once."""
    request = target.request()
    calls = [target.begin("render_rgb", request) for _ in range(8)]
    different = {call.result().image_bytes for call in calls}
    expect(len(different) == 1, f"8 equal requests gave {len(different)} different pictures")
    return "8 calls at once, one picture"


@check("size-from-aspect")
def size_from_aspect(target: Target) -> str:
    """With resolution_w of 1 or 0 the width follows from the height and the intrinsics' aspect ratio."""
    wanted = target.width(target.camera().intrinsics)
    for width in (1, 0):
        image = target.changed(lambda r, width=width: setattr(r, "resolution_w", width))
        expect(image.shape[0] == HEIGHT_PX, f"height {HEIGHT_PX} was asked, got {image.shape[0]}")
        expect(abs(image.shape[1] - wanted) <= 1, f"width {width}: {wanted} follows, got {image.shape[1]}")
    return f"{wanted}x{HEIGHT_PX}"


@check("size-keeps-view")
def size_keeps_view(target: Target) -> str:
    """Native intrinsics with a smaller size show all of the field of view, smaller."""
    import cv2

    spec = target.camera().intrinsics
    height = max(2 * HEIGHT_PX, min(spec.resolution_h, 360))

    def larger(request) -> None:
        request.resolution_h, request.resolution_w = height, target.width(spec, height)

    small, large = target.changed(), target.changed(larger)
    size = small.shape[1::-1]
    whole = cv2.resize(large, size, interpolation=cv2.INTER_AREA)
    rows, columns = large.shape[0] // 4, large.shape[1] // 4
    middle = cv2.resize(large[rows:-rows, columns:-columns], size, interpolation=cv2.INTER_AREA)
    shown, cropped = difference(small, whole), difference(small, middle)
    if difference(whole, middle) < 2:
        raise Skipped("the picture has too little in it to tell")
    apart = difference(whole, middle)
    expect(shown < cropped, f"the small picture is nearer to a crop ({cropped:.1f}) than to the whole ({shown:.1f})")
    expect(shown < max(4, apart / 2), f"it differs from the whole by {shown:.1f} steps, as a crop would ({apart:.1f})")
    return f"{shown:.1f} steps from the large picture, {cropped:.1f} from its middle"
