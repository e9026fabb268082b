"""The network: an ONNX file that fulfils the ``contract``, on a device."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from os.path import isfile
from pathlib import Path
from typing import Any

import numpy as np

from .. import options
from ..arrays import NEIGHBOURHOOD, STRIDES, FloatArray, IntArray
from ..errors import DeviceError, FileError
from ..options import OPTIONS, QUALITIES, Device, Precision, Quality
from ..threads import cores_of_system, useful_threads
from .contract import EXACT_DISTANCES, INPUTS, MASKS, Decoder, read_card, trial
from .onnx import has_driver, open_session, run

MODELS = Path(__file__).parent.parent / "models"
NO_NETWORKS = "super-sdf was installed without its networks: install it again"
KIND_MODELS = ("mask", "noisy")
"""Kinds of fields that have a shipped network of this name, in place of others."""
HALF_TURNS: IntArray = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)], np.int32)
"""The signs of x, y and z after half turns about no axis and about each; none is favoured."""


@dataclass(frozen=True, eq=False, repr=False)
class Network:
    """A loaded network; safe to call from several threads."""

    session: Any  # of onnxruntime
    card: Mapping[str, Any]  # receptive field, training factors, data, commit, accuracy
    device: Device  # "cpu" or "cuda"
    symmetries: int = 1  # half turns over which the values are averaged, see ``HALF_TURNS``
    threads: int = 0  # of the CPU; 0 for one per core
    notes: tuple[str, ...] = ()  # what the user should know about device and threads
    shipped: bool = False  # whether it came with the package and was trained on distances
    path: Path = Path()  # of its file

    def __repr__(self) -> str:
        name, reach = self.card.get("name", "unnamed"), self.receptive_field
        return f"Network({name}, receptive field {reach}, device {self.device})"

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how another process, which unpickles it, loads the same file."""
        return _load_once, (self.path, self.device, self.threads, self.symmetries)

    @property
    def receptive_field(self) -> int | None:
        """Voxels to each side that a value depends on; None if the card does not have it."""
        return self.card.get("receptive_field")

    @property
    def precision(self) -> Precision:
        """The arithmetic of the file: "float32" or "int8"."""
        return "int8" if self.card.get("precision") == "int8" else "float32"

    @property
    def memory_bytes(self) -> tuple[float, float]:
        """Peak memory of a run, as measured: bytes per voxel that it sees, and bytes per value."""
        each = (9.25 if self.precision == "int8" else 7.25) * self.card.get("channels", 64)
        averages = self.symmetries > 1  # takes more for the turned inputs, and for the mean
        return 216 + each + 600 * averages, 8 + 4 * averages

    def __call__(
        self, patches: FloatArray, table: IntArray, voxels: IntArray, offsets: FloatArray
    ) -> FloatArray:
        """Return the values (D, Q) of voxels at query offsets: signed distances in half voxels.

        Inputs are those of a ``Decoder``. DeviceError if onnxruntime fails, for example for lack of
        memory on a GPU.

        A turned distance field is the distance field of the turned surface, but a network
        reproduces this only approximately. The mean of its values for several turned fields, each
        turned back, has a smaller error.
        """
        count, width = len(voxels), len(offsets)
        if count < width:  # else the order of onnxruntime's sums depends on the number of threads
            voxels = np.resize(voxels, width)
        if self.symmetries == 1:
            feeds = dict(zip(INPUTS, (patches, table, voxels, offsets)))
            return run(self.session, feeds, self.device)[:count]
        mean = np.zeros((count, width), np.float32)
        for signs in HALF_TURNS[: self.symmetries]:
            places = (NEIGHBOURHOOD * signs + 1) @ STRIDES
            turned = np.hstack([patches[:, places], patches[:, 27:]]), table.take(places, 1)
            feeds = dict(zip(INPUTS, (*turned, voxels, offsets * signs.astype(np.float32))))
            values = run(self.session, feeds, self.device)[:count]
            with np.errstate(invalid="ignore"):  # ``decode`` checks for infinities
                values /= self.symmetries
                mean += values
            del turned, feeds, values  # before the next run, whose peak they would raise
        return mean


def shipped_models() -> dict[str, Path]:
    """Return the files of the networks that come with the package, by name; empty without them."""
    return {path.stem: path for path in sorted(MODELS.glob("*.onnx"))}


def find_model(model: str | Path, precision: str = "auto") -> tuple[Path, int]:
    """Return the file for the CPU, and the number of symmetries to average over.

    ``model`` is a quality, the name of a shipped network, or a file, which "auto" leaves as it is.
    FileError if there is no such regular file.
    """
    OPTIONS["precision"].check(precision)
    shipped, (name, symmetries) = shipped_models(), QUALITIES.get(str(model), (str(model), 1))
    if name not in shipped and (str(model) in QUALITIES or name in KIND_MODELS):
        raise FileError(f"the network {name!r} is missing: {NO_NETWORKS}")
    path = shipped.get(name, Path(model))
    if precision == "auto":
        path = shipped.get(f"{name}-int8", path)
    elif precision == "int8":
        path = path.with_name(f"{path.stem}-int8.onnx")  # beside the float32 file
    if not isfile(path):
        names = ", ".join(QUALITIES)
        raise FileError(f"no model {str(path)!r}: give an ONNX file or one of: {names}")
    return path, symmetries


def load_network(
    model: Quality | str | Path = options.DEFAULT_QUALITY,
    *,
    device: Device = "auto",
    threads: int = 0,
    precision: Precision = "auto",
) -> Network:
    """Load a network, to refine many grids with it.

    Parameters
    ----------
    model : str or path
        "fast", "base" or "best" (averaged over half turns), or an ONNX file.
    device : str
        "cuda", "cpu", or "auto": CUDA if it runs, otherwise the CPU, with a note if there is a GPU.
    threads : int
        CPU threads; 0 for one per core, which is also the maximum.
    precision : str
        "float32"; "int8", the quantised variant, which is faster and runs on the CPU only; or
        "auto": int8 on the CPU for shipped networks that have int8 weights, otherwise float32.

    Raises
    ------
    FileError, OptionError, ModelError, DeviceError
        If there is no such file; if an argument is invalid; if the file is not a network of this
        format; if the device is "cuda" and CUDA cannot run.
    """
    asked, threads = OPTIONS["device"].check(device), OPTIONS["threads"].check(threads)
    path, symmetries = find_model(options.PATH.check(model, "model"), precision)
    if precision == "int8" and asked == "cuda":
        raise DeviceError("int8 is for the CPU: use --precision float32 with --device cuda")
    used, notes, failure = useful_threads(threads), list[str](), None
    if not threads and used == cores_of_system():
        used = 0  # onnxruntime's default, one thread per physical core
    session: Any = None
    runs_on: Device = "cpu"
    if asked != "cpu" and precision != "int8":
        on_cuda, _ = find_model(model, "float32")
        try:  # a session can open although it cannot run: a GPU may be too old, or its memory full
            session = open_session(on_cuda, "cuda", used)
            run(session, trial(read_card(session, on_cuda).get("wide", 0)), "cuda")
            path, runs_on = on_cuda, "cuda"
        except DeviceError as error:
            failure = error
    if runs_on == "cpu":
        session = open_session(path, "cpu", used)  # the file may be the cause of the failure
        if failure and asked == "cuda":
            said = f"cuda was asked for, but {failure}; or use --device cpu"
            raise DeviceError(said) from failure
        if failure and has_driver():
            notes += [f"a GPU seems to be here, but the network runs on the CPU: {failure}"]
    card = read_card(session, path)
    shipped = path.parent == MODELS and card.get("inputs") != MASKS
    return Network(session, card, runs_on, symmetries, used, tuple(notes), shipped, path)


@lru_cache(maxsize=4)
def _load_once(
    model: str | Path, device: Device, threads: int, symmetries: int, precision: Precision = "auto"
) -> Network:
    loaded = load_network(model, device=device, threads=threads, precision=precision)
    return replace(loaded, symmetries=symmetries)


def network_for(network: Decoder, kind: str | None) -> Decoder:
    """Return the network that a field names, in place of a shipped one.

    Masks have a network of their own. So have noisy distances, unless the network was itself
    trained on them. A network from another file, or any other function, is used as it is.
    FileError if the network for the kind is missing.
    """
    if not isinstance(network, Network) or not network.shipped or kind not in KIND_MODELS:
        return network
    if kind == "noisy" and network.card.get("inputs") != EXACT_DISTANCES:
        return network
    return _load_once(kind, network.device, network.threads, network.symmetries, network.precision)
