"""All errors that nurec_sim raises deliberately.

::

    NurecSimError
    ├── ClipError        a driving log is missing something or contradicts itself
    │   └── UnknownFormatError  no log reader knows what lies there
    ├── ArchiveError     a scene archive cannot be read, or must not be
    ├── ReconstructError a clip lacks what the reconstruction method needs
    ├── WeightsError     weights of the network are missing, damaged, or of another network
    ├── RequestError     a render request is malformed                (gRPC INVALID_ARGUMENT)
    │   ├── UnknownSceneError  no such scene                          (gRPC NOT_FOUND)
    │   ├── OutOfRangeError    a time outside the scene               (gRPC OUT_OF_RANGE)
    │   ├── TooLargeError      more pixels or items than allowed      (gRPC RESOURCE_EXHAUSTED)
    │   ├── UnsupportedError   a procedure that this server lacks      (gRPC UNIMPLEMENTED)
    │   └── NotAllowedError    not permitted by the server's options   (gRPC PERMISSION_DENIED)
    ├── SceneInUseError  a scene cannot be removed while in use       (gRPC FAILED_PRECONDITION)
    ├── CancelledError   work was cancelled, its result is not needed (gRPC CANCELLED)
    ├── DeadlinePassedError  the client's deadline passed before the answer  (gRPC DEADLINE_EXCEEDED)
    ├── PlanError        a policy failed, or its plan cannot be driven  (gRPC ABORTED)
    │   └── PolicyError        it raised, tried to end the process, or did not answer in time
    ├── SessionError     a driving session lacks what was requested   (gRPC FAILED_PRECONDITION)
    │   ├── UnknownSessionError  no such session                      (gRPC NOT_FOUND)
    │   └── SessionExistsError   a session of that id is open         (gRPC ALREADY_EXISTS)
    ├── ScenarioError    a scenario file is wrong
    ├── GpuError         the CUDA back end cannot be used here
    ├── ServerError      a sensor server cannot be reached, or failed
    ├── RunError         a run folder or a file in it cannot be read or written
    ├── TrainingError    a recipe, its data or its checkpoints are wrong
    └── WriteError       a file or a folder cannot be written (an OSError too)

Error texts state what was wrong, what was given and what is allowed.
"""


class NurecSimError(Exception):
    """Base of all deliberate errors; catching it separates them from bugs."""


class ClipError(NurecSimError):
    """A driving log is missing something or contradicts itself."""


class UnknownFormatError(ClipError):
    """No log reader knows what lies at a path."""


class ArchiveError(NurecSimError):
    """A scene archive cannot be read, or must not be."""


class ReconstructError(NurecSimError):
    """A clip lacks what the reconstruction method needs."""


class WeightsError(NurecSimError):
    """Weights of the network are missing, damaged, or of another network."""


class RequestError(NurecSimError):
    """A render request is malformed."""


class UnknownSceneError(RequestError):
    """No scene with that name is served."""


class OutOfRangeError(RequestError):
    """A time outside of what the scene covers."""


class TooLargeError(RequestError):
    """A request for more pixels, beams or items than allowed."""


class UnsupportedError(RequestError):
    """A procedure of the interface that this server does not implement."""


class SceneInUseError(NurecSimError):
    """A scene cannot be removed while it is in use."""


class CancelledError(NurecSimError):
    """Work was cancelled: its result is no longer needed."""


class DeadlinePassedError(NurecSimError):
    """The deadline of a client or a server passed before the response was ready."""


class NotAllowedError(RequestError):
    """An operation that the server implements, but was not started with permission for."""


class PlanError(NurecSimError):
    """A policy failed, or returned a plan that cannot be driven."""


class PolicyError(PlanError):
    """A policy raised, tried to end the process, or did not answer in time."""


class SessionError(NurecSimError):
    """A driving session lacks what was requested."""


class UnknownSessionError(SessionError):
    """No driving session with that id is open."""


class SessionExistsError(SessionError):
    """A driving session with that id is already open."""


class ScenarioError(NurecSimError):
    """A scenario file is wrong."""


class GpuError(NurecSimError):
    """The CUDA back end cannot be used here: no GPU, a package missing, kernels that do not compile."""


class ServerError(NurecSimError):
    """A sensor server cannot be reached, or failed."""


class RunError(NurecSimError):
    """A run folder, or a file in it, cannot be read or written."""


class TrainingError(NurecSimError):
    """A training recipe, its data or its checkpoints are wrong."""


class WriteError(NurecSimError, OSError):
    """A file or a folder cannot be written: ``errno``, what is wrong and what to do (``strerror``), ``filename``."""

    def __str__(self) -> str:
        return f"cannot write {self.filename}: {self.strerror}"
