"""Ground truth on disk, in a separate folder that readers of the log never access; see docs/world.md.

A folder appears complete or not at all.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32

from nurec_sim.errors import ClipError
from nurec_sim.files.new_files import writing
from nurec_sim.world.plan.town import TownPlan
from nurec_sim.world.sense.isp import CameraResponse
from nurec_sim.world.sense.scan import LidarResponse

if TYPE_CHECKING:
    from nurec_sim.world.sense.truth import TrueView

PLAN_FILE, RESPONSES_FILE = "plan.json", "responses.json"


class TruthFolder:
    """Collects truth beside ``path`` and moves it there when the ``with`` block ends without an error.

    Raises:
        ClipError: ``path`` exists.
        WriteError: it cannot be written.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        if self.path.exists():
            raise ClipError(f"{str(self.path)!r} exists; choose another folder for the truth")

    def __enter__(self) -> TruthFolder:
        with writing(self.path):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            # On the same file system as the target, so that the final rename is atomic.
            self._work = Path(tempfile.mkdtemp(prefix=f".{self.path.name}.", dir=self.path.parent))
            self._folder = self._work / "truth"
            self._folder.mkdir()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                with writing(self.path):
                    os.replace(self._folder, self.path)
        finally:
            shutil.rmtree(self._work, ignore_errors=True)

    def add_plan(self, plan: TownPlan, responses: Mapping[str, CameraResponse | LidarResponse]) -> None:
        """Adds the plan and the response of each sensor."""
        known = {name: dataclasses.asdict(response) for name, response in responses.items()}
        with writing(self.path):
            (self._folder / PLAN_FILE).write_text(plan.to_json(), encoding="utf-8")
            (self._folder / RESPONSES_FILE).write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")

    def add_view(self, camera_id: str, index: int, view: TrueView, flow_m: Float32[np.ndarray, "h w 3"]) -> None:
        """Adds the truth of one image.

        Args:
            camera_id: the camera; names the subfolder.
            index: number of the image among those of its camera; names the file.
            view: the image with its ground truth; its colours are not stored.
            flow_m: motion (m) of each pixel's point until the next image, along the world's axes.
        """
        file = self._folder / camera_id / f"{index:04d}.npz"
        with writing(self.path):
            file.parent.mkdir(exist_ok=True)
            np.savez_compressed(
                file,
                allow_pickle=False,
                depth_m=view.depth_m,
                surface=view.surface,
                instance=view.instance.astype(np.uint16),
                # Half precision halves the files; unit normals and flow keep three digits.
                normal=view.normal.astype(np.float16),
                flow_m=flow_m.astype(np.float16),
            )
