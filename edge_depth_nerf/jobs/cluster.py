"""Tasks on the workers of a Dask cluster; the one module that knows Dask.

A worker starts a process for each task and waits for it; the process dies with its worker. Data stay on storage that
all machines share: what travels are paths, versions and shares of work. Dask does a lost worker's tasks again
elsewhere, and they continue from what they find on disk.
"""

from __future__ import annotations

import asyncio
import importlib.metadata
import logging
import os
import platform
import signal
import sys
import tempfile
import time
import uuid
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Lock, Thread
from typing import Any

from rich.console import Console

from edge_depth_nerf.base.console import say
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.jobs.cluster_address import LOCAL, check_address
from edge_depth_nerf.jobs.runs import LoggedCommands
from edge_depth_nerf.jobs.tasks import Task, shares_told

PACKAGES = ("edge-depth-nerf", "nerfstudio", "torch")
"""A worker has these in the versions that are here."""
GPU = "GPU"
"""What Dask calls the resource that trainings ask for."""
CONNECT_S = 20.0
"""A scheduler answers within so many seconds."""
WAIT_FOR_WORKERS_S = 600.0
"""A queue may take its time to start workers."""
SEEN_WITHIN_S = 90.0
"""What a worker wrote to shared storage is seen here by then; network disks may show it a minute late."""
THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
"""Dask sets them to 1 for its workers, and what a worker starts would inherit that."""


# ---- on the worker -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Surroundings:
    """What a task needs of the machine it runs on."""

    versions: tuple[tuple[str, str], ...]
    witness: str
    """A file that the machine of the command wrote to shared storage."""
    threads: int
    topic: str
    """Of the events that tell how far it is."""


_running: dict[str, LoggedCommands] = {}
"""By their keys: the tasks of this worker."""
_stopped: set[str] = set()
"""Keys of tasks that are not to begin any more."""


def do_task(task: Task, key: str, needs: Surroundings) -> str:
    """Do a task on this worker; give the name of its machine.

    Raises:
        InputError: the machine is not as it must be, or the command failed.
    """
    from distributed import get_worker

    worker, machine = get_worker(), platform.node()
    # workers that came later have not been looked at
    for name, wanted in needs.versions:
        _check_version(machine, name, importlib.metadata.version(name), wanted)
    if not Path(needs.witness).is_file():
        raise InputError(_not_shared(machine, Path(needs.witness).parent))

    def tell(share: float, begins: bool = False) -> None:
        worker.log_event(needs.topic, {"key": key, "share": share, "begins": begins, "machine": machine})

    commands = _running[key] = LoggedCommands()
    try:
        if key in _stopped:
            commands.stop()
        tell(0.0, begins=True)
        environment = {name: str(needs.threads) for name in THREAD_VARIABLES}
        commands.call([sys.executable, *task.arguments], task.log, needs.threads, shares_told(tell), environment)
    finally:
        del _running[key]
    return machine


def dask_setup(_: Any) -> None:
    """Leave Ctrl-C, which a terminal sends to all it has started, to the command; Dask calls this on local workers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def stop_tasks(keys: Sequence[str]) -> None:
    """Kill those of these tasks that run on this worker, which Dask cannot, and let none of them begin."""
    _stopped.update(keys)
    for key in keys:
        commands = _running.get(key)
        if commands is not None:
            commands.stop()


# ---- what is said of a worker ----------------------------------------------------------------------------------


def _check_version(worker: str, name: str, found: str, wanted: str) -> None:
    """Raise an InputError if a worker's version is another one; builds of one version for other devices are the same.

    Python counts by its first two numbers.
    """

    def told_apart(version: str) -> str:
        return ".".join(version.split(".")[:2]) if name == "Python" else version.split("+")[0]

    if told_apart(found) != told_apart(wanted):
        raise InputError(
            f"worker {worker}: has {name} {found}, this machine {wanted}. All machines need the same version, or "
            "their results differ: give the workers this machine's environment, and restart them."
        )


def _not_shared(worker: str, folder: Path) -> str:
    return (
        f"worker {worker}: does not have {folder} as this machine does. Expected storage that all machines share, "
        "under one path: data are not sent to workers. Mount it on the worker, or give a shared folder."
    )


# ---- on the command's machine ------------------------------------------------------------------------------------


class Cluster:
    """A place for tasks: the workers of a cluster, which have been looked at."""

    def __init__(self, client: Any, needs: Surroundings, has_gpus: bool, console: Console) -> None:
        """Hand tasks to `client`; trainings ask for a GPU if there are any."""
        self._client, self._needs, self._has_gpus, self._console = client, needs, has_gpus, console
        self._tasks: dict[str, tuple[Task, Callable[[float], None], Any]] = {}
        self._begun: Counter[str] = Counter()
        self._lock = Lock()
        client.subscribe_topic(needs.topic, self._told)

    def start(self, task: Task, tell: Callable[[float], None]) -> Future[None]:
        """Put a task into the cluster's queue."""
        key = f"{task.title} {uuid.uuid4().hex[:8]}"
        ended: Future[None] = Future()
        resources = {GPU: 1} if self._has_gpus and task.trains else None
        with self._lock:
            submitted = self._client.submit(do_task, task, key, self._needs, key=key, pure=False, resources=resources)
            self._tasks[key] = task, tell, submitted
        # Dask calls back in a thread of its own, where the wait for a network disk would hold up other tasks' ends
        submitted.add_done_callback(
            lambda done: Thread(target=self._hand_on, args=(task, done, ended), daemon=True).start()
        )
        return ended

    def stop(self) -> None:
        """Drop what has not begun, and kill what runs."""
        with self._lock:
            futures = [future for _, _, future in self._tasks.values()]
        # a scheduler that is gone is told of by the error before
        with suppress(Exception):
            self._client.cancel(futures, force=True)
            self._client.run(stop_tasks, list(self._tasks), on_error="ignore")

    def _told(self, event: tuple[float, Mapping[str, Any]]) -> None:
        """Hear how far a task is."""
        said = event[1]
        with self._lock:
            task, tell, _ = self._tasks[said["key"]]
        if said["begins"]:
            self._begun[said["key"]] += 1
            if self._begun[said["key"]] > 1:
                say(self._console, f"{task.title}: worker lost; continuing on {said['machine']}.", "yellow")
        tell(said["share"])

    def _hand_on(self, task: Task, done: Any, ended: Future[None]) -> None:
        """Hand on how a task ended."""
        from distributed import KilledWorker

        try:
            _wait_for(task.makes, machine=done.result())
            ended.set_result(None)
            return
        except InputError as error:
            fault = error
        except KilledWorker as error:
            count = error.allowed_failures + 1
            lost = f"{_count(count, 'worker')} {'was' if count == 1 else 'were'}"
            fault = InputError(
                f"{task.title}: {lost} lost while running it. Its log is {task.log}. The workers' logs may show the "
                "reason; often it is too little memory. Finished work is kept. Run the same command again to resume."
            )
        except BaseException as error:  # whatever a worker or a lost scheduler makes of it
            fault = InputError(
                f"{task.title}: the cluster did not finish it ({type(error).__name__}: {error}). Check whether "
                "scheduler and workers still run; finished work is kept. Run the same command again to resume."
            )
        ended.set_exception(fault)


def _wait_for(path: Path, machine: str) -> None:
    """Wait until a file that a worker has written is seen here, too."""
    until = time.monotonic() + SEEN_WITHIN_S
    while not path.exists():
        if time.monotonic() > until:
            raise InputError(
                f"{path}: was made on {machine}, but did not appear here within {SEEN_WITHIN_S:g} s. Expected "
                "storage that all machines share, under one path: mount it on that machine, or remove the "
                "machine from the cluster."
            )
        time.sleep(0.1)


@contextmanager
def on_cluster(address: str, tasks: Sequence[Task], reads: Sequence[Path], console: Console) -> Iterator[Cluster]:
    """The workers of a cluster as a place for tasks.

    Args:
        address: of a scheduler, or `local` for processes on this machine.
        tasks: what is to be done there.
        reads: folders that all of them need.
        console: where to say who is there.

    Raises:
        InputError: Dask is not installed, nobody answers, no worker comes, or one is not as it must be.
    """
    check_address(address)
    try:
        from distributed import Client
    except ImportError:
        raise InputError(
            f"--cluster {address}: needs Dask. Install it here and for the workers: pip install '.[cluster]'"
        ) from None
    with ExitStack() as stack:
        if address == LOCAL:
            client = stack.enter_context(Client(stack.enter_context(_local(len(tasks))), set_as_default=False))
        else:
            try:
                client = Client(address, timeout=CONNECT_S, set_as_default=False)
            except (OSError, asyncio.TimeoutError, ValueError, TypeError) as error:
                said = (str(error).splitlines() or [type(error).__name__])[0]
                raise InputError(
                    f"--cluster {address}: no scheduler answers ({said}). Start one with `dask scheduler` where this "
                    "machine can reach it; for tls://, Dask's own settings name the keys (docs/cluster.md)."
                ) from None
            stack.enter_context(client)
        _await_workers(client, address, console)
        witness = stack.enter_context(_witness(tasks[0].log.parent))
        versions = tuple((name, importlib.metadata.version(name)) for name in PACKAGES)
        workers = client.scheduler_info(n_workers=-1)["workers"]
        machines = _look_at(client, workers, versions, [*reads, *{task.log.parent for task in tasks}], witness)
        threads = _threads(client, machines)
        gpus = [address for address, worker in workers.items() if worker["resources"].get(GPU, 0) >= 1]
        say(
            console,
            f"Cluster {address}: {_count(len(workers), 'worker')} on {_count(len(set(machines.values())), 'machine')}, "
            f"{len(gpus) or 'none'} with a GPU; {_count(len(tasks), 'task')}, threads of each: {threads}.",
        )
        needs = Surroundings(versions, str(witness), threads, f"edge-depth-nerf-{uuid.uuid4().hex}")
        yield Cluster(client, needs, bool(gpus), console)


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _await_workers(client: Any, address: str, console: Console) -> None:
    if not client.scheduler_info(n_workers=-1)["workers"]:
        say(console, f"Cluster {address}: no worker yet; waiting up to {WAIT_FOR_WORKERS_S:g} s at most.", "yellow")
    try:
        client.wait_for_workers(1, timeout=WAIT_FOR_WORKERS_S)
    except asyncio.TimeoutError:  # Dask's; with Python 3.10, another one than Python's own
        raise InputError(
            f"--cluster {address}: the scheduler has no worker after {WAIT_FOR_WORKERS_S:g} s. Start some with `dask "
            f"worker {address} --nthreads 1`, and with --resources 'GPU=1' on machines with a GPU."
        ) from None


@contextmanager
def _witness(folder: Path) -> Iterator[Path]:
    """A file in a folder, by which a worker tells that it sees the same folder."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        witness = tempfile.NamedTemporaryFile(prefix=".cluster-", dir=folder)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror}). Choose another folder.") from error
    try:
        with witness:
            yield Path(witness.name)
    finally:
        for path in missing:
            try:
                path.rmdir()
            except OSError:
                break  # something is in it


def _look_at(
    client: Any,
    workers: Mapping[str, Mapping[str, Any]],
    versions: Sequence[tuple[str, str]],
    folders: Sequence[Path],
    witness: Path,
) -> dict[str, str]:
    """Make sure that every worker can do the tasks; give their machines' names.

    Workers are asked by functions of Python's own library: one without this package, or with another Python, answers.
    """

    def ask(function: Callable[..., Any], *given: Any) -> Iterator[tuple[str, Any]]:
        answers = client.run(function, *given, on_error="return")
        # one that is lost in this moment gives no answer
        return ((f"{machines.get(address, '')} ({address})", answer) for address, answer in answers.items())

    machines: dict[str, str] = client.run(platform.node)
    for address, worker in workers.items():
        if worker["nthreads"] != 1:
            raise InputError(
                f"worker {machines.get(address, '')} ({address}): has {worker['nthreads']} threads, so Dask would "
                "give it that many tasks at once. Expected one: a task is a process that uses several "
                "cores. Start it with --nthreads 1."
            )
    for where, found in ask(platform.python_version):
        _check_version(where, "Python", str(found), platform.python_version())
    for name, wanted in versions:
        for where, found in ask(importlib.metadata.version, name):
            _check_version(where, name, found if isinstance(found, str) else "not installed", wanted)
    looks = [*((os.path.isdir, folder, folder) for folder in folders), (os.path.isfile, witness, witness.parent)]
    for is_there, path, folder in looks:
        for where, seen in ask(is_there, str(path)):
            if seen is not True:
                raise InputError(_not_shared(where, folder))
    for where, may in ask(os.access, str(witness.parent), os.W_OK):
        if may is not True:
            raise InputError(
                f"worker {where}: has no permission to write to {witness.parent}. Start the worker as the user of "
                "this machine, or give its user permission to write there."
            )
    return machines


def _threads(client: Any, machines: Mapping[str, str]) -> int:
    """Cores that each worker has for itself, at the smallest worker: the same for all tasks, or times differ."""
    given = os.environ.get(THREAD_VARIABLES[0], "")
    if given.isdecimal() and int(given) > 0:
        return int(given)
    from dask.system import cpu_count

    cores = client.run(cpu_count)
    # a queue may give the jobs on one machine cores of their own
    own = client.run(os.sched_getaffinity, 0) if hasattr(os, "sched_getaffinity") else {}
    groups = {address: (machines.get(address, ""), frozenset(own.get(address, ()))) for address in cores}
    shared = Counter(groups.values())
    return max(1, min((cores[address] // shared[group] for address, group in groups.items()), default=1))


@contextmanager
def _local(count: int) -> Iterator[Any]:
    """A cluster of processes on this machine, at most `count`: one for each GPU, or else for each core.

    It listens on the loopback alone, and speaks TLS with keys that nobody else has: anyone who reaches a scheduler can
    run programs as its user, and on a machine of several users all of them reach the loopback.
    """
    import dask.config
    import torch
    from distributed import Nanny, Scheduler, Security, SpecCluster

    visible, gpus = os.environ.get("CUDA_VISIBLE_DEVICES"), torch.cuda.device_count()
    names = visible.split(",") if visible else map(str, range(gpus))
    places = [{"env": {"CUDA_VISIBLE_DEVICES": name}, "resources": {GPU: 1}} for name in [*names][:gpus]]
    places = places or [{} for _ in range(os.cpu_count() or 1)]
    security = Security.temporary()
    here = {"host": "127.0.0.1", "protocol": "tls://", "dashboard": False, "dashboard_address": "127.0.0.1:0"}
    settings: dict[str, Any] = {f"distributed.{of}.http.routes": [] for of in ("scheduler", "worker")}
    # a nanny would set OMP_NUM_THREADS=1 for this process, too
    settings["distributed.nanny.pre-spawn-environ"] = {}
    with ExitStack() as stack:
        scratch = stack.enter_context(tempfile.TemporaryDirectory(prefix="edge-depth-nerf-"))
        stack.enter_context(dask.config.set(settings))
        # a task's memory is its process's, which Dask does not see
        options = {**here, "nthreads": 1, "memory_limit": None, "local_directory": scratch, "security": security}
        options |= {"preload": [__name__]}
        # of each lost worker, which is said in other words here
        quiet: Any = {"silence_logs": logging.CRITICAL}
        yield stack.enter_context(
            SpecCluster(
                workers={
                    number: {"cls": Nanny, "options": {**options, **place, **quiet}}
                    for number, place in enumerate(places[:count])
                },
                scheduler={"cls": Scheduler, "options": {**here, "port": 0, "security": security}},
                security=security,
                **quiet,
            )
        )
