"""Every error that nurec_sim raises on purpose.

::

    NurecSimError
    ├── ClipError        a driving log is missing something or contradicts itself
    ├── ArchiveError     a scene archive cannot be read, or must not be
    ├── ReconstructError a clip lacks what the reconstruction method needs
    ├── WeightsError     weights of the network are missing, damaged, or of another network
    ├── RequestError     a render request is malformed                (gRPC INVALID_ARGUMENT)
    │   ├── UnknownSceneError  no such scene                          (gRPC NOT_FOUND)
    │   ├── OutOfRangeError    a time outside the scene               (gRPC OUT_OF_RANGE)
    │   ├── TooLargeError      more pixels or items than allowed      (gRPC RESOURCE_EXHAUSTED)
    │   ├── UnsupportedError   a procedure that this server lacks      (gRPC UNIMPLEMENTED)
    │   └── NotAllowedError    what this server was told not to do     (gRPC PERMISSION_DENIED)
    ├── SceneInUseError  a scene cannot be taken away now             (gRPC FAILED_PRECONDITION)
    ├── CancelledError   work was cancelled: nobody waits for it      (gRPC CANCELLED)
    ├── DeadlinePassedError  the client's deadline passed before the answer  (gRPC DEADLINE_EXCEEDED)
    ├── PlanError        a policy failed, or answered what cannot be driven  (gRPC ABORTED)
    │   └── PolicyError        it raised, tried to end the process, or did not answer in time
    ├── SessionError     a driving session lacks what it is asked for (gRPC FAILED_PRECONDITION)
    │   ├── UnknownSessionError  no such session                      (gRPC NOT_FOUND)
    │   └── SessionExistsError   a session of that id is open         (gRPC ALREADY_EXISTS)
    ├── ScenarioError    a scenario file is wrong
    ├── GpuError         the CUDA back end cannot be used here
    ├── ServerError      a sensor server cannot be reached, or failed
    ├── RunError         a run folder or a file in it cannot be read or written
    ├── TrainingError    a recipe, its data or its checkpoints are wrong
    └── WriteError       a file or a folder cannot be written (an OSError too)

Texts say what was wrong, what was given and what is allowed.
"""


class NurecSimError(Exception):
    """Base of all errors raised on purpose; catch it to tell them from bugs."""


class ClipError(NurecSimError):
    """A driving log is missing something or contradicts itself."""


class ArchiveError(NurecSimError):
    """A scene archive cannot be read, or must not be."""


class ReconstructError(NurecSimError):
    """A clip lacks what the reconstruction method needs."""


class WeightsError(NurecSimError):
    """Weights of the network are missing, damaged, or of another network."""


class RequestError(NurecSimError):
    """A render request is malformed."""


class UnknownSceneError(RequestError):
    """No scene of that name is served."""


class OutOfRangeError(RequestError):
    """A time outside of what the scene covers."""


class TooLargeError(RequestError):
    """A request for more pixels, beams or items than allowed."""


class UnsupportedError(RequestError):
    """A procedure that the interface knows and this server does not offer."""


class SceneInUseError(NurecSimError):
    """A scene cannot be taken away while somebody uses it."""


class CancelledError(NurecSimError):
    """Work was cancelled: nobody waits for its result any more."""


class DeadlinePassedError(NurecSimError):
    """The time that a client, or a server, allows passed before there was an answer."""


class NotAllowedError(RequestError):
    """Something that this server could do and was started without permission for."""


class PlanError(NurecSimError):
    """A policy failed, or answered something that cannot be driven."""


class PolicyError(PlanError):
    """A policy raised, tried to end the process, or did not answer in time."""


class SessionError(NurecSimError):
    """A driving session lacks what it is asked for."""


class UnknownSessionError(SessionError):
    """No driving session of that id is open."""


class SessionExistsError(SessionError):
    """A driving session of that id is open already."""


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
