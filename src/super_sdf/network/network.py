"""The network: an ONNX file that keeps the ``contract``, opened on a ``device``."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from ..arrays import FloatArray, IntArray
from ..errors import DeviceError, FileError, ModelError, OptionError
from ..files.regular import check_regular_file
from ..machine.threads import cores_of_system, useful_threads
from ..options import check_path, check_threads
from ..progress import Tell
from .contract import INPUTS, one_voxel, read_card
from .device import open_session
from .names import DEFAULT_QUALITY, PRECISIONS, QUALITIES
from .onnx import ort
from .pace import LONG, Pace, work_of
from .running import CUDA_CHUNK, Look, run_bound, run_on_cpu
from .symmetry import cube_symmetries, turn

MODELS = Path(__file__).parent.parent / "models"
# What a run takes, measured, for each voxel that it sees, its row of the neighbour table included,
# and for each value; and what it takes to average over symmetries: turned copies, and the mean.
BYTES = {"float32": (680.0, 8.0), "int8": (950.0, 8.0)}
TURNED_BYTES = (240.0, 4.0)
NO_NETWORKS = "super-sdf was installed without its networks: install it again"
PART = 1024  # rows of a run from which its time is told: two chunks


@dataclass(frozen=True, eq=False, repr=False)
class Network:
    """A loaded network; safe to call from several threads.

    Attributes
    ----------
    card : dict
        The file's metadata: receptive field, training factors, data, commit, accuracy.
    device : str
        Where it runs: "cpu" or "cuda".
    symmetries : int
        Over how many symmetries of the cube the values are averaged.
    threads : int
        CPU threads; 0 for one a core.
    notes : tuple of str
        What the user should know of the device.
    pace : Pace
        How long runs take, learnt from them.
    tells_progress : bool
        That a call takes ``progress``: see ``decoder.Decoder``.
    """

    session: ort.InferenceSession
    card: Mapping[str, Any]
    device: str
    symmetries: int = 1
    threads: int = 0
    notes: tuple[str, ...] = ()
    pace: Pace = field(default_factory=Pace, repr=False)
    tells_progress: ClassVar[bool] = True

    def __repr__(self) -> str:
        threads = self.threads or "all"
        return (
            f"Network({self.card.get('name', 'unnamed')}, receptive field {self.receptive_field}, "
            f"symmetries {self.symmetries}, device {self.device}, threads {threads})"
        )

    @property
    def receptive_field(self) -> int | None:
        """Voxels to each side that a prediction depends on, None if the file does not say."""
        return self.card.get("receptive_field")

    @property
    def memory_bytes(self) -> tuple[float, float]:
        """What a run takes at most: bytes for each voxel that it sees, and for each value."""
        voxel, value = BYTES["int8" if self.card.get("precision") == "int8" else "float32"]
        if self.symmetries == 1:
            return voxel, value
        return voxel + TURNED_BYTES[0], value + TURNED_BYTES[1]

    def __call__(
        self,
        patches: FloatArray,
        table: IntArray,
        voxels: IntArray,
        offsets: FloatArray,
        progress: Tell | None = None,
    ) -> FloatArray:
        """Return the values (D, Q) of voxels (D,) at offsets (Q, 3), in half voxels.

        ``progress`` is called several times a second with the share that is done, 0 to 1, an
        estimate by the clock. An interrupt, or what it raises, ends the call in milliseconds.

        Raises
        ------
        DeviceError
            If onnxruntime fails, for want of memory on a GPU, say.
        """
        if self.symmetries == 1:
            return self._run(patches, table, voxels, offsets, progress)
        mean = np.zeros((len(voxels), len(offsets)), np.float32)
        for number, symmetry in enumerate(cube_symmetries()[: self.symmetries]):
            turned, turned_table, moved = turn(symmetry, patches, table, offsets)
            tell = progress and part_of(progress, number, self.symmetries)
            values = self._run(turned, turned_table, voxels, moved, tell)
            with np.errstate(invalid="ignore"):  # infinities are the caller's to refuse
                mean += values / self.symmetries
        return mean

    def _run(
        self,
        patches: FloatArray,
        table: IntArray,
        voxels: IntArray,
        offsets: FloatArray,
        progress: Tell | None,
    ) -> FloatArray:
        """Run the session; watched if that takes long, for a thread takes a tenth of a millisecond.

        Of fewer voxels than offsets onnxruntime would make the sums in an order that depends on how
        many threads there are, so voxels are repeated until there are as many.
        """
        count = len(voxels)
        voxels = np.resize(voxels, max(count, len(offsets)))
        feeds = dict(zip(INPUTS, (patches, table, voxels, offsets)))
        work = work_of(len(patches), len(voxels), len(offsets))
        if work < LONG:
            return self._ask(feeds)[:count]
        if progress and self.pace.seconds is None:
            self._try_part(feeds)
        watch = self.pace.watch(work, progress or (lambda share: None))
        begun = time.perf_counter()
        values = self._ask(feeds, watch)
        self.pace.learn(work, time.perf_counter() - begun)
        return values[:count]

    def _ask(self, feeds: Mapping[str, Any], look: Look | None = None) -> FloatArray:
        """Run the session where it is."""
        run = run_bound if self.device == "cuda" else run_on_cpu
        return run(self.session, feeds, look=look)

    def _try_part(self, feeds: Mapping[str, Any]) -> None:
        """Learn the pace from a small part of a run: the first chunks."""
        rows = CUDA_CHUNK if self.device == "cuda" else PART
        part = first_rows(feeds, rows - 1)  # one more is added to fill the last chunk
        begun = time.perf_counter()
        self._ask(part)
        offsets = len(part["offsets"])  # no fewer voxels than these are decoded at a time
        work = work_of(rows, max(len(part["voxels"]), offsets), offsets)
        self.pace.learn(work, time.perf_counter() - begun)


def part_of(progress: Tell, number: int, count: int) -> Tell:
    """Return what tells of the whole when it is told how far one part of ``count`` is."""
    return lambda share: progress((number + share) / count)


def first_rows(feeds: Mapping[str, Any], rows: int) -> dict[str, Any]:
    """Return the inputs of the first rows of a band, cut off from the others."""
    table, voxels = feeds["neighbours"][:rows], feeds["voxels"]
    decoded = voxels[voxels < rows]
    return {
        "patches": feeds["patches"][:rows],
        "neighbours": np.where(table < rows, table, np.int32(-1)),
        "voxels": decoded if len(decoded) else np.zeros(1, np.int32),
        "offsets": feeds["offsets"],
    }


def shipped_models() -> dict[str, Path]:
    """Return the networks that come with the package, by name; none if it lost their folder."""
    return {path.stem: path for path in sorted(MODELS.glob("*.onnx"))}


def find_model(model: str | Path, precision: str = "float32") -> tuple[Path, int]:
    """Return the file of a quality or of a path, and how many symmetries it is averaged over.

    Raises
    ------
    FileError
        If there is no such file, or what has its name is no regular file.
    OptionError
        If there is none of this precision.
    """
    if precision not in PRECISIONS:
        raise OptionError(f"precision is {precision!r}: give one of {', '.join(PRECISIONS)}")
    name, symmetries = QUALITIES.get(str(model), (str(model), 1))
    if str(model) in QUALITIES and name not in shipped_models():
        raise FileError(f"the network {name!r} is missing: {NO_NETWORKS}")
    path = shipped_models().get(name, Path(model))
    if precision == "int8":
        path = path.with_name(f"{path.stem}-int8.onnx")  # beside that of float32
        if not os.path.lexists(path):
            raise OptionError(
                f"{model} has no int8 variant, {path}: write one with export.quantize"
            )
    if not os.path.lexists(path):
        names = ", ".join(QUALITIES)
        raise FileError(f"no model {str(model)!r}: give an ONNX file or one of: {names}")
    return check_regular_file(path), symmetries


def load_network(
    model: str | Path = DEFAULT_QUALITY,
    *,
    device: str = "auto",
    threads: int = 0,
    precision: str = "float32",
) -> Network:
    """Load a network.

    Parameters
    ----------
    model : str or path
        "fast", "base" or "best" (base, averaged over reflections), or an ONNX file.
    device : str
        "cuda", "cpu", or "auto": CUDA where it runs, else the CPU.
    threads : int
        CPU threads; 0 for one a core, and never more.
    precision : str
        "float32", or "int8" for the variant in whole numbers, quicker on the CPU, where it runs.

    Raises
    ------
    FileError
        If there is no such file.
    OptionError
        If there is none of this precision, or another argument is not what it should be.
    ModelError
        If it is not a network of this format.
    DeviceError
        If CUDA was asked for and cannot run.
    """
    threads = check_threads(threads)
    check_path(model, "model")
    path, symmetries = find_model(model, precision)
    if precision == "int8":
        device = _cpu_for_int8(device)
    useful = useful_threads(threads)
    if not threads and useful == cores_of_system():
        useful = 0  # onnxruntime's own choice, one a physical core
    opened = open_session(path, device, useful, one_voxel())
    card = read_card(opened.session, path)
    if opened.failure:
        raise ModelError(f"{path} does not run with its own inputs: {opened.failure}")
    notes = (*opened.notes, *_note_threads(threads, useful))
    return Network(opened.session, card, opened.device, symmetries, useful, notes)


def _note_threads(requested: int, useful: int) -> tuple[str, ...]:
    """Return a note if fewer threads work than were asked for."""
    if not requested or requested <= useful:
        return ()
    return (f"--threads {requested} is cut to {useful}, the cores that this process may use",)


def _cpu_for_int8(device: str) -> str:
    """Return the device for whole numbers: they gain nothing on a GPU."""
    if device == "cuda":
        raise DeviceError("int8 is for the CPU: use --precision float32 with --device cuda")
    return "cpu" if device == "auto" else device
