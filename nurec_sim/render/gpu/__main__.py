"""``python -m nurec_sim.render.gpu`` says on which GPU frames would be drawn, or what is missing."""

from __future__ import annotations

import sys

from nurec_sim.errors import GpuError
from nurec_sim.render.gpu.launcher import CudaLauncher, architecture_of


def main() -> int:
    """0 where the kernels are ready to run, else 1."""
    import torch

    try:
        device = CudaLauncher().device
    except GpuError as error:
        print(error, file=sys.stderr)
        return 1
    print(f"{torch.cuda.get_device_name(device)}, {architecture_of(device)}: kernels compiled and loaded")
    return 0


if __name__ == "__main__":
    sys.exit(main())
