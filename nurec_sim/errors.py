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
    │   └── TooLargeError      more pixels or items than allowed      (gRPC RESOURCE_EXHAUSTED)
    ├── PlanError        a policy answered something that cannot be driven
    ├── ScenarioError    a scenario file is wrong
    ├── GpuError         the CUDA back end cannot be used here
    ├── ServerError      a sensor server cannot be reached, or failed
    └── RunError         a run folder or a file in it cannot be read or written

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


class PlanError(NurecSimError):
    """A policy answered something that cannot be driven."""


class ScenarioError(NurecSimError):
    """A scenario file is wrong."""


class GpuError(NurecSimError):
    """The CUDA back end cannot be used here: no GPU, a package missing, kernels that do not compile."""


class ServerError(NurecSimError):
    """A sensor server cannot be reached, or failed."""


class RunError(NurecSimError):
    """A run folder, or a file in it, cannot be read or written."""
