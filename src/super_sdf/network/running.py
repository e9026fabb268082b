"""One run of a session: what is bound where, and how a long one is watched and stopped."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from threading import Event, Thread
from typing import Any

import numpy as np

from ..arrays import FloatArray
from ..errors import DeviceError
from .cuda import first_line
from .onnx import ort

# Memory comes from an arena, so that the arrays of one layer serve the next: fresh memory has to be
# zeroed by the system, which takes a third of the time of the network itself. After a run the arena
# gives back what it took, for the next grid has another size; after a small one there is no need.
SHRINK = "memory.enable_memory_arena_shrinkage"
SMALL = 20_000  # voxels ...
SMALL_OUTPUT = 5_000_000  # ... and values
# An input that networks may have besides the four: how many rows of the neighbour table at a time.
# The file's own suits a CPU's cache; a GPU waits between chunks, so that they should be large: the
# gathered rows of this one are 27 * 64 floats each, 113 MB.
CHUNK_INPUT, CUDA_CHUNK = "chunk", 16384
LOOK = 0.1  # seconds between two looks at a run

Look = Callable[[], None]
"""Called every ``LOOK`` seconds of a run; if it raises, the run is stopped."""


def run_on_cpu(
    session: ort.InferenceSession, feeds: Mapping[str, Any], look: Look | None = None
) -> FloatArray:
    """Run a session and return its one output, (voxels, offsets).

    The output is bound to an array of ours: in the arena it would keep that from giving back.
    With ``look`` the run can be stopped, as by an interrupt; see ``_run_watched``.

    Raises
    ------
    DeviceError
        If onnxruntime fails.
    """
    values = np.empty((len(feeds["voxels"]), len(feeds["offsets"])), np.float32)
    options = ort.RunOptions()
    if len(feeds["patches"]) > SMALL or values.size > SMALL_OUTPUT:
        options.add_run_config_entry(SHRINK, "cpu:0")
    with failures_on("cpu"):
        binding = session.io_binding()
        for name, array in feeds.items():
            binding.bind_cpu_input(name, array)
        output = session.get_outputs()[0].name
        binding.bind_output(output, "cpu", 0, np.float32, values.shape, values.ctypes.data)
    _run(session, binding, options, "cpu", look, keep=(feeds, values))
    return values


def run_bound(
    session: ort.InferenceSession,
    feeds: Mapping[str, Any],
    place: str = "cuda",
    chunk: int = CUDA_CHUNK,
    look: Look | None = None,
) -> FloatArray:
    """Run a session with its inputs and its one output on a device.

    Each input is copied there once and the output back once; nothing else is. ``chunk`` is how many
    rows of the neighbour table go at a time, where the file leaves that open. Otherwise as
    ``run_on_cpu``.
    """
    options = ort.RunOptions()
    if place == "cuda":
        options.add_run_config_entry(SHRINK, "gpu:0")
    with failures_on(place):
        binding = session.io_binding()
        bound = {name: ort.OrtValue.ortvalue_from_numpy(feeds[name], place, 0) for name in feeds}
        if any(given.name == CHUNK_INPUT for given in session.get_overridable_initializers()):
            # A size: it is wanted on the CPU, which launches the work.
            bound[CHUNK_INPUT] = ort.OrtValue.ortvalue_from_numpy(np.array([chunk]), "cpu", 0)
        for name, value in bound.items():
            binding.bind_ortvalue_input(name, value)
        binding.bind_output(session.get_outputs()[0].name, place, 0)
    _run(session, binding, options, place, look, keep=bound)
    with failures_on(place):
        values: FloatArray = binding.copy_outputs_to_cpu()[0]
    return values


@contextmanager
def failures_on(device: str) -> Iterator[None]:
    """Turn what onnxruntime raises into DeviceError."""
    try:
        yield
    except Exception as error:  # onnxruntime's errors have no common base but this
        raise DeviceError(f"the network failed on {device}: {first_line(error)}") from error


def _run(
    session: ort.InferenceSession,
    binding: Any,
    options: Any,
    device: str,
    look: Look | None,
    keep: Any,
) -> None:
    """Run a session, here or watched; ``keep`` is what is bound, which must outlive the run."""

    def work(keep: Any = keep) -> None:
        with failures_on(device):
            session.run_with_iobinding(binding, options)

    if look is None:
        work()
    else:
        _run_watched(work, options, look)


def _run_watched(work: Callable[[], None], options: Any, look: Look) -> None:
    """Work in a thread and look on; an interrupt, or what ``look`` raises, stops the run.

    Within onnxruntime nobody hears an interrupt. It looks at ``terminate`` between two operators,
    also in the loops over chunks, so a run ends within milliseconds.
    """
    failures: list[BaseException] = []
    ended = Event()  # not Thread.join: interrupted, that takes a running thread for an ended one

    def keep_failure() -> None:
        try:
            work()
        except DeviceError as error:
            failures.append(error)
        finally:
            ended.set()

    thread = Thread(target=keep_failure, name="super-sdf network")
    try:
        thread.start()
        while not ended.wait(LOOK):
            look()
    except BaseException:
        options.terminate = True
        if thread.ident:  # it runs, and an interrupt did not come before that
            ended.wait()
        raise
    if failures:
        raise failures[0]
