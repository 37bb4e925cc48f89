"""Tasks of a study on a cluster, through Ray. No shared disk: files travel through Ray's object store.

Each task runs in a folder of its own on a node: with the files that it reads, written from objects that reach a node
once, however many of its tasks need them. What it writes comes back while it runs, so a lost node loses no finished
rollout: its tasks go on elsewhere from what has arrived.
"""

from __future__ import annotations

import dataclasses
import logging
import os
import socket
import tempfile
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from nurec_sim import __version__
from nurec_sim.errors import RunError
from nurec_sim.files.new_files import write_file
from nurec_sim.study.executor import ONE_THREAD, TICK_S
from nurec_sim.study.tasks import Task

if TYPE_CHECKING:
    from ray import ObjectRef

MOST_LOSSES = 5
"""A task that was lost so often is given up: it may be what kills its workers."""
MOST_OBJECTS = 64
"""Files of the study that are kept in the object store at a time."""
SEND_EVERY_S, CONNECT_S = 1.0, 5.0
Files = dict[str, bytes | None]
"""Content by path below the folder of the study; None for a removed file."""
Stamps = dict[str, tuple[int, int]]
"""Time of change in ns and size in bytes by path below the folder of the study."""


class RayCluster:
    """An ``Executor`` on a Ray cluster: one task per CPU. A context manager, which disconnects at the end.

    Args:
        address: ``host:port`` of the cluster's head, ``auto`` for a cluster that this machine belongs to, or ``local``
            for a cluster of this machine alone, which ends with the study.

    Raises:
        RunError: Ray is not installed, or there is no cluster.
    """

    def __init__(self, address: str) -> None:
        try:
            import ray
        except ModuleNotFoundError:
            raise RunError("a cluster needs Ray: pip install 'nurec-sim[fleet]'") from None
        if address.startswith("ray://"):
            raise RunError(f"Ray's client protocol cannot stream results, got {address}; start on a node of the "
                           "cluster, and give host:port of its head, or auto")  # fmt: skip
        self._ray = ray
        try:
            if ":" in address:
                # Ray itself would try for minutes.
                host, _, port = address.rpartition(":")
                socket.create_connection((host, int(port)), CONNECT_S).close()
            ray.init(
                address=None if address == "local" else address,
                runtime_env={"env_vars": dict.fromkeys(ONE_THREAD, "1")},
                log_to_driver=False,
                logging_level=logging.ERROR,
                include_dashboard=False if address == "local" else None,
            )
        except (OSError, ValueError, RuntimeError) as error:
            reason = str(error).strip().splitlines()[0]
            raise RunError(f"no Ray cluster can be reached at {address}: {reason}") from None
        self._work = ray.remote(num_cpus=1, max_retries=0, num_returns="streaming")(_run_on_node)
        self._objects: OrderedDict[Path, ObjectRef] = OrderedDict()

    def __enter__(self) -> Self:
        """This executor."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Disconnects; the cluster drops tasks in work."""
        self._objects.clear()
        self._ray.shutdown()

    @property
    def jobs(self) -> int:
        """CPUs of the cluster at this moment."""
        return max(1, int(self._ray.cluster_resources().get("CPU", 0)))

    def run(
        self, work: Callable[[Task], list[str]], tasks: Sequence[Task], tick: Callable[[], None]
    ) -> Iterator[tuple[Task, list[str]]]:
        """See ``Executor.run``; tasks that were lost with their node are repeated on another one.

        Raises:
            RunError: a task was lost ``MOST_LOSSES`` times, or a node has another version of nurec_sim.
        """
        from ray.exceptions import RayError, RayTaskError

        queue, running, losses = deque(tasks), dict[Any, Task](), Counter[str]()
        while queue or running:
            # Twice as many as run at a time, so that no CPU waits for the next task's files.
            while queue and len(running) < 2 * self.jobs:
                task = queue.popleft()
                running[self._start(work, task)] = task
            ready, _ = self._ray.wait(list(running), timeout=TICK_S)
            tick()
            stream: Any
            for stream in ready:
                task = running[stream]
                try:
                    reply = self._ray.get(next(stream))
                except RayTaskError as error:
                    raise error.cause from None
                except RayError as error:
                    del running[stream]
                    losses[task.title] += 1
                    if losses[task.title] >= MOST_LOSSES:
                        raise RunError(f"{task.title} was lost {MOST_LOSSES} times with its worker, perhaps for want "
                                       f"of memory: {str(error).splitlines()[0]}") from None  # fmt: skip
                    queue.appendleft(task)
                    continue
                if isinstance(reply, dict):
                    _keep(reply, task.folder)
                else:
                    del running[stream]
                    yield task, reply

    def _start(self, work: Callable[[Task], list[str]], task: Task) -> Any:
        paths = task.inputs()
        names = [path.relative_to(task.folder).as_posix() for path in paths]
        return self._work.remote(__version__, work, task, names, *(self._object(path) for path in paths))

    def _object(self, path: Path) -> ObjectRef:
        """The content of a file as an object; kept for the next tasks that read it."""
        if path not in self._objects:
            self._objects[path] = self._ray.put(path.read_bytes())
        self._objects.move_to_end(path)
        while len(self._objects) > MOST_OBJECTS:
            self._objects.popitem(last=False)
        return self._objects[path]


def _keep(files: Files, folder: Path) -> None:
    for name, content in files.items():
        path = folder / name
        if content is None:
            path.unlink(missing_ok=True)
        else:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_file(path, content)


def _run_on_node(
    version: str, work: Callable[[Task], list[str]], task: Task, names: Sequence[str], *contents: bytes
) -> Iterator[Files | list[str]]:
    """Runs a task on a node; gives what has changed in its folder about once a second, and its messages at the end.

    Args:
        version: of nurec_sim where the study was started.
        work: the function of the task.
        task: the task.
        names: paths below the folder of the study of the files that it reads.
        contents: their contents.
    """
    if version != __version__:
        raise RunError(f"{os.uname().nodename} has nurec_sim {__version__}, the study was started with {version}; "
                       "install the same version on every node")  # fmt: skip
    with tempfile.TemporaryDirectory(prefix="nurec_sim_") as place, ThreadPoolExecutor(1) as thread:
        folder = Path(place)
        _keep(dict(zip(names, contents, strict=True)), folder)
        sent: Stamps = {}
        _changes(folder, sent)
        future = thread.submit(work, dataclasses.replace(task, folder=folder))
        ended = False
        while not ended:
            ended = bool(wait([future], SEND_EVERY_S).done)
            if files := _changes(folder, sent):
                yield files
        yield future.result()


def _changes(folder: Path, sent: Stamps) -> Files:
    """Files that have changed or gone since they were sent; ``sent`` is brought up to date.

    Files and folders of rollouts appear under their names when they are whole; while they are written, their names
    begin with a dot.
    """
    files: Files = {}
    there = set()
    for path in sorted(folder.rglob("[!.]*")):
        name = path.relative_to(folder).as_posix()
        if path.is_file() and "/." not in name:
            with suppress(FileNotFoundError):  # replaced at this moment: it is seen the next time
                there.add(name)
                stat = path.stat()
                stamp = (stat.st_mtime_ns, stat.st_size)
                if sent.get(name) != stamp:
                    files[name] = path.read_bytes()
                    sent[name] = stamp
    for name in sent.keys() - there:
        files[name] = None
        del sent[name]
    return files
