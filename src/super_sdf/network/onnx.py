"""Running sessions of onnxruntime, which this module alone imports: without telemetry.

Since 2026 the wheels for Linux and macOS send usage data by default: the import writes files under
the user's cache folder, and a process that runs for a minute sends data about its machine. A tool
for people's own shapes must not do that without their consent.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from math import ceil
from threading import Event, Thread
from typing import Any

import numpy as np

from ..arrays import FloatArray
from ..errors import DeviceError
from ..progress import ShareCallback
from ..threads import count_cores

SWITCH = "ORT_DISABLE_TELEMETRY"  # a variable that onnxruntime reads once, when it is imported


@contextmanager
def without_telemetry() -> Iterator[None]:
    """Switch off onnxruntime's telemetry while it is imported, unless the user set the variable.

    It is removed afterwards, so that child processes see the user's own environment.
    """
    given = os.environ.get(SWITCH)
    os.environ[SWITCH] = given or "1"
    try:
        yield
    finally:
        if given is None:
            os.environ.pop(SWITCH, None)


def first_line(error: Exception) -> str:
    """Return the message of an onnxruntime error in one line; of CUDA's, the part of interest."""
    failure = re.search(r"CUDA failure \d+: [^;\n]*", str(error))
    if failure:
        return failure[0].strip()
    return next(iter(str(error).strip().splitlines()), type(error).__name__)


try:
    with without_telemetry():
        import onnxruntime as ort
except Exception as error:  # a broken installation fails in other ways than ImportError, too
    raise DeviceError(
        f"onnxruntime cannot be imported ({first_line(error)}): pip install --force-reinstall "
        "onnxruntime"
    ) from error

__all__ = ["ort"]

# onnxruntime allocates from an arena, so that layers reuse the memory of earlier ones: the system
# has to zero fresh memory, which takes a third of the time of the network itself. After a large run
# the arena is shrunk, since the next grid has another size; after a small one there is no need.
SHRINK = "memory.enable_memory_arena_shrinkage"
SMALL = 20_000  # voxels ...
SMALL_OUTPUT = 5_000_000  # ... and values of a run after which the arena is not shrunk
# An optional fifth input of networks: the rows of the neighbour table per chunk. With fewer a core
# than this, cores wait for each other; with more, what they gather leaves the cache. A GPU waits
# between chunks, so it gets large ones: with 27 * 64 gathered floats a row, 113 MB.
CHUNK_INPUT, CORE_CHUNK, CPU_CHUNK, CUDA_CHUNK = "chunk", 512, 4096, 16384
POLL_INTERVAL = 0.1  # seconds
VALUES_PER_VOXEL = 300  # decoding this many values takes as long as encoding a voxel
USUAL_PACE = 2e-5  # seconds per voxel, before a run has been measured
LINEAR_UP_TO = 0.8  # above this share progress slows down: a run may take longer than expected


def run(
    session: ort.InferenceSession,
    feeds: Mapping[str, Any],
    device: str = "cpu",
    poll: Callable[[], None] = lambda: None,
) -> FloatArray:
    """Run a session, given its inputs by name, and return its output, (D, Q) float32.

    An interrupt, or an exception in ``poll``, which is called every ``POLL_INTERVAL`` seconds,
    stops the run. DeviceError if onnxruntime fails. On CUDA each input is copied there once and the
    output back once, nothing more. On the CPU the output is allocated here: in onnxruntime's arena
    it would prevent the arena from shrinking.
    """
    voxels, count = len(feeds["patches"]), len(feeds["voxels"])
    values = np.empty((count, len(feeds["offsets"])) if device == "cpu" else 0, np.float32)
    options, output = ort.RunOptions(), session.get_outputs()[0].name
    if device != "cpu" or voxels > SMALL or values.size > SMALL_OUTPUT:
        options.add_run_config_entry(SHRINK, "cpu:0" if device == "cpu" else "gpu:0")
    with failures_on(device):
        binding = session.io_binding()
        bound = {}
        for name, array in feeds.items():
            if device == "cpu":
                binding.bind_cpu_input(name, array)
            else:
                bound[name] = ort.OrtValue.ortvalue_from_numpy(array, device, 0)
        if any(given.name == CHUNK_INPUT for given in session.get_overridable_initializers()):
            threads = session.get_session_options().intra_op_num_threads if device == "cpu" else 0
            rows = cpu_chunk(voxels, threads) if device == "cpu" else CUDA_CHUNK
            bound[CHUNK_INPUT] = ort.OrtValue.ortvalue_from_numpy(np.array([rows]), "cpu", 0)
        for name, value in bound.items():
            binding.bind_ortvalue_input(name, value)
        if device == "cpu":
            binding.bind_output(output, "cpu", 0, np.float32, values.shape, values.ctypes.data)
        else:
            binding.bind_output(output, device, 0)
    _run_in_thread(session, binding, options, device, poll, keep=(feeds, bound, values))
    if device == "cpu":
        return values
    with failures_on(device):
        copied: FloatArray = binding.copy_outputs_to_cpu()[0]
    return copied


def cpu_chunk(voxels: int, threads: int) -> int:
    """Return the rows per chunk for a number of threads, 0 for all cores: chunks of equal size.

    Rows are filled up to whole chunks, by at least one.
    """
    most = min(CORE_CHUNK * (threads or count_cores()), CPU_CHUNK)
    return ceil((voxels + 1) / ceil((voxels + 1) / most))


@contextmanager
def failures_on(device: str) -> Iterator[None]:
    """Turn exceptions of onnxruntime into DeviceError."""
    try:
        yield
    except Exception as error:  # onnxruntime's errors have no other common base class
        raise DeviceError(f"the network failed on {device}: {first_line(error)}") from error


def _run_in_thread(
    session: ort.InferenceSession,
    binding: Any,
    options: Any,
    device: str,
    poll: Callable[[], None],
    keep: Any,
) -> None:
    """Run a session in a thread and poll; ``keep`` holds the bound arrays alive.

    Python handles no interrupt while onnxruntime runs in its own thread. onnxruntime reads
    ``options.terminate`` between two operators, also in the loops over chunks, so a run ends within
    milliseconds. A second interrupt waits for nothing: a loop of the file may have no end.
    """
    failures: list[BaseException] = []
    ended = Event()  # not Thread.join, which after an interrupt may return before the thread ends

    def work(keep: Any = keep) -> None:
        try:
            with failures_on(device):
                session.run_with_iobinding(binding, options)
        except DeviceError as error:
            failures.append(error)
        finally:
            ended.set()

    thread = Thread(target=work, name="super-sdf network", daemon=True)
    try:
        thread.start()
        poll()
        while not ended.wait(POLL_INTERVAL):
            poll()
    except BaseException:
        options.terminate = True
        if thread.ident:  # not if the interrupt came before the thread started
            ended.wait()
        raise
    if failures:
        raise failures[0]


class Pace:
    """The seconds that a network takes per voxel, from its last run: its progress is estimated."""

    def __init__(self) -> None:
        self.seconds = USUAL_PACE

    @contextmanager
    def watch(self, work: float, progress: ShareCallback | None) -> Iterator[Callable[[], None]]:
        """Yield what reports the progress of a run when it is called, and measure the run."""
        began, expected = time.perf_counter(), work * self.seconds
        show = progress or (lambda share: None)
        yield lambda: show(share_of_time(time.perf_counter() - began, expected))
        self.seconds = (time.perf_counter() - began) / work


def share_of_time(seconds: float, expected: float) -> float:
    """Return the estimated finished share of a run; it stays below 1, however long it takes."""
    share = seconds / expected
    if share <= LINEAR_UP_TO:
        return share
    left = 1 - LINEAR_UP_TO
    return 1 - left / (1 + (share - LINEAR_UP_TO) / left)
