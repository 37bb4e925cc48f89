"""Compiles the ``.proto`` files of this folder into ``descriptors.binpb`` (development only, needs grpcio-tools).

Run ``python protos/build.py`` after every change of a ``.proto`` file; a test compares the two.
"""

from __future__ import annotations

from pathlib import Path

HERE = Path(__file__).parent
SOURCES = ("common.proto", "sensorsim.proto", "egodriver.proto", "nurec_sim_v1.proto")


def compile_descriptors(target: Path) -> None:
    """Writes the descriptor set of all sources to ``target``.

    Raises:
        ModuleNotFoundError: grpcio-tools is not installed.
        RuntimeError: a source does not compile (protoc has printed why).
    """
    from grpc_tools import protoc

    if protoc.main(["protoc", f"-I{HERE}", f"--descriptor_set_out={target}", *SOURCES]) != 0:
        raise RuntimeError(f"protoc could not compile {', '.join(SOURCES)}")


if __name__ == "__main__":
    compile_descriptors(HERE / "descriptors.binpb")
