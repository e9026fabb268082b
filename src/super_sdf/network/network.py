"""The network: an ONNX file that fulfils the ``contract``, opened on a ``device``.

Masks and noisy distances have networks of their own, see ``network_for``.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from ..arrays import FloatArray, IntArray
from ..errors import DeviceError, FileError, ModelError, OptionError
from ..options import (
    AUTO,
    DEFAULT_QUALITY,
    FLOAT32,
    INT8,
    MASK,
    NOISY,
    OPTIONS,
    QUALITIES,
    Device,
    Precision,
    Quality,
    check_path,
)
from ..progress import ShareCallback
from ..threads import cores_of_system, described_processor, useful_threads
from .contract import EXACT_DISTANCES, INPUTS, MASKS, read_card
from .decoder import Decoder
from .device import open_session
from .neighbourhood import cube_symmetries, turn
from .onnx import VALUES_PER_VOXEL, Pace, ort, run

MODELS = Path(__file__).parent.parent / "models"
# Memory of a run, measured: of each voxel that it sees, its patch and its row of the neighbour
# table and, by precision, what each channel takes; and of each value. Averaging over symmetries
# takes more: for the transformed inputs, and for the mean.
INPUT_BYTES, VALUE_BYTES, SYMMETRY_BYTES = 216.0, 8.0, (600.0, 4.0)
CHANNEL_BYTES = {FLOAT32: 7.25, INT8: 9.25}
USUAL_CHANNELS = 64  # of a network whose card does not say
NO_NETWORKS = "super-sdf was installed without its networks: install it again"
MASK_MODEL, NOISY_MODEL = "mask", "noisy"
KIND_MODELS = (MASK_MODEL, NOISY_MODEL)
"""The shipped networks that replace others for a kind of field."""


@dataclass(frozen=True, eq=False, repr=False)
class Network:
    """A loaded network; safe to call from several threads."""

    session: ort.InferenceSession
    card: Mapping[str, Any]  # receptive field, training factors, data, commit, accuracy
    device: Device  # "cpu" or "cuda"
    symmetries: int = 1  # of the cube, over which the values are averaged
    threads: int = 0  # of the CPU; 0 for one per core
    notes: tuple[str, ...] = ()  # what the user should know about device and threads
    pace: Pace = field(default_factory=Pace, repr=False)  # of earlier runs
    shipped: bool = False  # whether it came with the package and was trained on distances
    path: Path | None = None  # of its file
    reports_progress: ClassVar[bool] = True  # a call takes ``progress``, see ``decoder.Decoder``

    def __repr__(self) -> str:
        return (
            f"Network({self.card.get('name', 'unnamed')}, receptive field {self.receptive_field}, "
            f"symmetries {self.symmetries}, device {self.device}, threads {self.threads or 'all'})"
        )

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how another process, which unpickles it, loads the same file, once."""
        return _load_once, (self.path, self.device, self.threads, self.symmetries)

    def averaged(self, symmetries: int) -> Network:
        """Return the same network averaged over a number of symmetries."""
        return replace(self, symmetries=symmetries, pace=Pace())

    @property
    def receptive_field(self) -> int | None:
        """Voxels to each side that a value depends on; None if the card does not have it."""
        return self.card.get("receptive_field")

    @property
    def precision(self) -> Precision:
        """The arithmetic of the file: "float32" or "int8"."""
        return INT8 if self.card.get("precision") == INT8 else FLOAT32

    @property
    def memory_bytes(self) -> tuple[float, float]:
        """Peak memory of a run: bytes per voxel that it sees, and bytes per value."""
        each = CHANNEL_BYTES[self.precision] * self.card.get("channels", USUAL_CHANNELS)
        more = SYMMETRY_BYTES if self.symmetries > 1 else (0.0, 0.0)
        return INPUT_BYTES + each + more[0], VALUE_BYTES + more[1]

    def __call__(
        self,
        patches: FloatArray,
        table: IntArray,
        voxels: IntArray,
        offsets: FloatArray,
        progress: ShareCallback | None = None,
    ) -> FloatArray:
        """Return the values (D, Q) of voxels at query offsets: signed distances in half voxels.

        Parameters and their shapes are those of ``decoder.Decoder``. ``progress`` is called several
        times a second with the finished share, estimated from the elapsed time. An exception in it,
        or an interrupt, ends the call within milliseconds. DeviceError if onnxruntime fails, for
        example for lack of memory on a GPU.
        """
        if self.symmetries == 1:
            return self._run(patches, table, voxels, offsets, progress)
        mean = np.zeros((len(voxels), len(offsets)), np.float32)
        for number, symmetry in enumerate(cube_symmetries()[: self.symmetries]):
            turned, turned_table, moved = turn(symmetry, patches, table, offsets)
            within = progress and partial(_within, progress, number, self.symmetries)
            values = self._run(turned, turned_table, voxels, moved, within)
            with np.errstate(invalid="ignore"):  # the caller checks for infinities
                values /= self.symmetries
                mean += values
            del values  # before the next run, whose peak it would raise
        return mean

    def _run(
        self,
        patches: FloatArray,
        table: IntArray,
        voxels: IntArray,
        offsets: FloatArray,
        progress: ShareCallback | None,
    ) -> FloatArray:
        """Run the session once.

        With fewer voxels than offsets, the order of onnxruntime's sums would depend on the number
        of threads.
        """
        some = np.resize(voxels, max(len(voxels), len(offsets)))
        feeds = dict(zip(INPUTS, (patches, table, some, offsets)))
        work = len(patches) + len(some) * len(offsets) / VALUES_PER_VOXEL
        with self.pace.watch(work, progress) as poll:
            return run(self.session, feeds, self.device, poll)[: len(voxels)]


def _within(progress: ShareCallback, number: int, count: int, share: float) -> None:
    """Report the share of a run, one of ``count``, among all of them."""
    progress((number + share) / count)


def shipped_models() -> dict[str, Path]:
    """Return the files of the networks that come with the package, by name; empty without them."""
    return {path.stem: path for path in sorted(MODELS.glob("*.onnx"))}


def float32_name(name: str) -> str:
    """Return the name of a network without what marks an int8 variant."""
    return name.removesuffix(f"-{INT8}")


def digest_of_model(model: str | Path, precision: str = AUTO) -> str:
    """Return the SHA-256 of a network's file, which is found as by ``find_model``."""
    return hashlib.sha256(find_model(model, precision)[0].read_bytes()).hexdigest()


def find_model(model: str | Path, precision: str = AUTO) -> tuple[Path, int]:
    """Return the file for the CPU, and the number of symmetries to average over.

    ``model`` is a quality, the name of a shipped network, or a file, and "auto" leaves a file as it
    is. So it does with all networks on processors with AVX but without AVX2, where int8 is slower.
    FileError if there is no such regular file, OptionError if there is none of this precision.
    """
    OPTIONS["precision"].check(precision)
    name, symmetries = QUALITIES.get(str(model), (str(model), 1))
    shipped = shipped_models()
    if str(model) in QUALITIES and name not in shipped:
        raise FileError(f"the network {name!r} is missing: {NO_NETWORKS}")
    path = shipped.get(name, Path(model))
    flags = described_processor().get("flags", "").split()
    if precision == AUTO and not ("avx" in flags and "avx2" not in flags):
        path = shipped.get(f"{name}-{INT8}", path)
    if precision == INT8:
        path = path.with_name(f"{path.stem}-{INT8}.onnx")  # beside the float32 file
        if not path.is_file():
            lacks = f"{model} has no int8 variant, {path}"
            raise OptionError(f"{lacks}: write one with export.quantize")
    try:
        is_file = path.is_file()
    except ValueError:  # a null byte
        is_file = False
    if not is_file:
        names = ", ".join(QUALITIES)
        raise FileError(f"no model {str(model)!r}: give an ONNX file or one of: {names}")
    return path, symmetries


def load_network(
    model: Quality | str | Path = DEFAULT_QUALITY,
    *,
    device: Device = AUTO,
    threads: int = 0,
    precision: Precision = AUTO,
) -> Network:
    """Load a network.

    Parameters
    ----------
    model : str or path
        "fast", "base" or "best" (averaged over half turns), or an ONNX file.
    device : str
        "cuda", "cpu", or "auto": CUDA if it runs, otherwise the CPU.
    threads : int
        CPU threads; 0 for one per core, which is also the maximum.
    precision : str
        "float32"; "int8", the quantised variant, which is faster and runs on the CPU only; or
        "auto": on the CPU int8, if the network is a shipped one that has it, otherwise float32; so
        are processors with AVX but without AVX2 (2011 to 2013), on which int8 is slower.

    Raises
    ------
    FileError
        If there is no such file.
    OptionError
        If there is no file of this precision, or another argument is invalid.
    ModelError
        If the file is not a network of this format.
    DeviceError
        If the device is "cuda" and CUDA cannot run.
    """
    threads = OPTIONS["threads"].check(threads)
    check_path(model, "model")
    path, symmetries = find_model(model, precision)
    if precision == INT8 and device == "cuda":
        raise DeviceError("int8 is for the CPU: use --precision float32 with --device cuda")
    if precision == INT8 and device == "auto":
        device = "cpu"
    on_cuda, _ = find_model(model, FLOAT32 if precision == AUTO else precision)
    useful = useful_threads(threads)
    if not threads and useful == cores_of_system():
        useful = 0  # onnxruntime's default, one thread per physical core
    opened = open_session((path, on_cuda), device, useful, one_voxel())
    path = on_cuda if opened.device == "cuda" else path
    card = read_card(opened.session, path)
    if opened.failure:
        raise ModelError(f"{path} does not run with its own inputs: {opened.failure}")
    cut = f"--threads {threads} is cut to {useful}, the cores that this process may use"
    notes = (*opened.notes, *([cut] if threads > useful > 0 else []))
    shipped = path.parent == MODELS and card.get("inputs") != MASKS
    loaded = opened.session, card, opened.device, symmetries, useful, notes
    return Network(*loaded, shipped=shipped, path=path)


def one_voxel() -> dict[str, Any]:
    """Return the inputs of a trial run; two offsets, to notice an output with its axes swapped."""
    arrays = np.zeros((1, 27)), np.full((1, 27), -1), np.zeros(1), np.zeros((2, 3))
    kinds = np.float32, np.int32, np.int32, np.float32
    return {name: array.astype(kind) for name, array, kind in zip(INPUTS, arrays, kinds)}


def given_or_loaded(
    network: Decoder | None, quality: Quality | str | Path | None, **where: Any
) -> Decoder:
    """Return a network, or load one if it is None; OptionError if both are asked for.

    ``where`` are keywords of ``load_network``, None for its defaults.
    """
    asked = {name: value for name, value in where.items() if value is not None}
    if network is None:
        return load_network(DEFAULT_QUALITY if quality is None else quality, **asked)
    for name in (*["quality"] * (quality is not None), *asked):
        raise OptionError(f"a network and {name} are given: give only one of them")
    return network


def network_for(network: Decoder, kind: str) -> Decoder:
    """Return the network for a kind of field: one for that kind in place of a shipped one.

    Masks have a network of their own. So have noisy distances, unless the network was itself
    trained on them. A network from another file, or any other function, is used as it is.
    FileError if the network for the kind is missing.
    """
    if not isinstance(network, Network) or not network.shipped:
        return network
    name = MASK_MODEL if kind == MASK else NOISY_MODEL if kind == NOISY else None
    if name is None or (kind == NOISY and network.card.get("inputs") != EXACT_DISTANCES):
        return network
    if name not in shipped_models():
        raise FileError(f"the network {name!r} is missing: {NO_NETWORKS}")
    given = network.device, network.threads, network.symmetries, network.precision
    return _load_once(name, *given)


@lru_cache(maxsize=4)
def _load_once(
    model: str | Path,
    device: Device,
    threads: int,
    symmetries: int,
    precision: Precision = AUTO,
) -> Network:
    loaded = load_network(model, device=device, threads=threads, precision=precision)
    return loaded.averaged(symmetries)
