"""Source of a training run's samples: clips generated in the background, and a stream of samples for each stage."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import Protocol

from nurec_sim.network.profiles import PROFILES
from nurec_sim.training.config import Stage, TrainingConfig
from nurec_sim.training.data.cache import ClipCache
from nurec_sim.training.data.sample import TrainingSample
from nurec_sim.training.data.stream import SampleStream
from nurec_sim.training.processes import Processes


class Samples(Protocol):
    """Samples for a trainer; sample k of a run does not depend on the process or the time of the request."""

    def stream(self, stage: Stage, step: int, processes: Processes) -> AbstractContextManager[Iterator[TrainingSample]]:
        """Samples of a stage, starting at a step (counted over all stages)."""

    def data_hash(self) -> str:
        """Identifies the data in the metadata of the weights."""


class TownSamples:
    """Samples of procedural towns generated on the fly; use it as a context manager.

    Args:
        config: the recipe.
        folder: folder of clips, shared by runs with the same data settings.
        generators: processes that generate clips, started by the first process of a run only.
        loaders: processes that prepare samples; 0 uses a thread.
        processes: this process among those of the run.
        report: called with messages about background errors.
    """

    def __init__(
        self,
        config: TrainingConfig,
        folder: Path,
        generators: int = 1,
        loaders: int = 0,
        processes: Processes | None = None,
        report: Callable[[str], None] | None = None,
    ) -> None:
        self.config, self.generators, self.loaders = config, generators, loaders
        self.first = processes is None or processes.first
        data = config.data
        self.cache = ClipCache(folder, data.clip_settings(), data.clips, data.first_town, report)
        self._open = ExitStack()

    def __enter__(self) -> TownSamples:
        if self.first and self.generators:
            self.cache.start(self.generators, refresh=self.config.data.refresh)
        self._open.callback(self.cache.close)
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def stream(self, stage: Stage, step: int, processes: Processes) -> SampleStream:
        """Samples of a stage, starting at a step."""
        profile = PROFILES[self.config.profile]
        settings = self.config.data.window_settings(profile, stage.pixels, stage.targets)
        return SampleStream(
            self.cache.clips,
            settings,
            self.config.seed,
            step,
            self.loaders,
            processes.rank,
            processes.count,
            check=self.cache.check,
        )

    def data_hash(self) -> str:
        """SHA-256 of the existing clips."""
        return self.cache.data_hash()
