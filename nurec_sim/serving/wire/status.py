"""Which gRPC status an error of ours becomes on the wire, and back."""

from __future__ import annotations

import grpc

from nurec_sim import errors

_CODES: tuple[tuple[type[errors.NurecSimError], grpc.StatusCode], ...] = (
    (errors.UnknownSceneError, grpc.StatusCode.NOT_FOUND),
    (errors.OutOfRangeError, grpc.StatusCode.OUT_OF_RANGE),
    (errors.TooLargeError, grpc.StatusCode.RESOURCE_EXHAUSTED),
    (errors.NotAllowedError, grpc.StatusCode.PERMISSION_DENIED),
    (errors.UnsupportedError, grpc.StatusCode.UNIMPLEMENTED),
    (errors.RequestError, grpc.StatusCode.INVALID_ARGUMENT),
    (errors.ArchiveError, grpc.StatusCode.FAILED_PRECONDITION),
    (errors.ClipError, grpc.StatusCode.FAILED_PRECONDITION),
    (errors.ReconstructError, grpc.StatusCode.FAILED_PRECONDITION),
    (errors.WeightsError, grpc.StatusCode.FAILED_PRECONDITION),
    (errors.SceneInUseError, grpc.StatusCode.FAILED_PRECONDITION),
    (errors.CancelledError, grpc.StatusCode.CANCELLED),
    (errors.DeadlinePassedError, grpc.StatusCode.DEADLINE_EXCEEDED),
    (errors.UnknownSessionError, grpc.StatusCode.NOT_FOUND),
    (errors.SessionExistsError, grpc.StatusCode.ALREADY_EXISTS),
    (errors.SessionError, grpc.StatusCode.FAILED_PRECONDITION),
    (errors.PlanError, grpc.StatusCode.ABORTED),
)
_GRPC_SAYS_TOO = (grpc.StatusCode.UNIMPLEMENTED, grpc.StatusCode.DEADLINE_EXCEEDED)
"""Statuses that gRPC itself also produces; for clients they are a ``ServerError``."""
_CODE_OF_NUMBER = {code.value[0]: code for code in grpc.StatusCode}


def code_of(error: Exception) -> grpc.StatusCode:
    """Status of an error; INTERNAL for what was not raised on purpose."""
    return next((code for kind, code in _CODES if isinstance(error, kind)), grpc.StatusCode.INTERNAL)


def number_of(error: Exception) -> int:
    """The same status as the number that travels on the wire."""
    return code_of(error).value[0]


def text_of(error: Exception) -> str:
    """The text of an error that is fit for a client."""
    return str(error) if isinstance(error, errors.NurecSimError) else f"internal error: {type(error).__name__}: {error}"


def error_of(code: grpc.StatusCode | int, text: str) -> errors.NurecSimError:
    """The error of a status; ``ServerError`` where there is none."""
    if isinstance(code, int):
        code = _CODE_OF_NUMBER.get(code, grpc.StatusCode.UNKNOWN)
    kind = next((kind for kind, known in _CODES if known is code and code not in _GRPC_SAYS_TOO), None)
    return kind(text) if kind else errors.ServerError(f"{code.name}: {text}")
