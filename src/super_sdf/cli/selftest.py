"""The checks of ``super-sdf info --check``: what works on this machine and what is missing.

Each network is run on a ball, whose distances are known, on every device.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from typing import NamedTuple

import numpy as np

from .. import __version__
from ..arrays import FloatArray, IntArray
from ..errors import DeviceError, SuperSdfError
from ..grid.sdf_grid import make_grid
from ..errors import EXTRAS, how_to_install, missing_modules
from ..threads import free_memory
from ..network.device import available_devices, check_cuda, describe_gpu, onnxruntime_version
from ..network.network import MASK_MODEL, NO_NETWORKS, float32_name, load_network, shipped_models
from ..options import AUTO, FLOAT32, MASK, Device, FieldKind
from ..refine.nodes import block_offsets
from ..refine.survey import survey

OK, MISSING, FAILED = "ok", "missing", "failed"
SAMPLES, CENTRE, RADIUS = 32, 15.63, 12.0  # of the ball, in voxels; the centre is on no sample
MASK_ERROR = 0.6  # voxels: a mask shows the surface to half a voxel
LARGEST_ERROR = 0.05  # voxels; shipped networks stay under 0.025, broken ones are off by voxels
LARGEST_DIFFERENCE = 1e-4  # voxels, between the values of the CPU and of CUDA


@dataclass(frozen=True)
class Finding:
    """The result of a check: "ok", "missing" (an optional part is not installed) or "failed"."""

    state: str
    what: str
    says: str
    figures: Mapping[str, float] = field(default_factory=dict)


class Ball(NamedTuple):
    """A ball as the inputs of a network."""

    inputs: tuple[FloatArray, IntArray, IntArray, FloatArray]
    exact: FloatArray  # distances (D, Q) in voxels
    allowed: float  # how far off a network may be, in voxels


def run_checks(device: Device = AUTO) -> Iterator[Finding]:
    """Run all checks and yield their results.

    Without CUDA "cuda" is a failure, and "auto" if onnxruntime was built for CUDA; "cpu" skips it.
    """
    yield check_versions()
    yield check_memory()
    devices: list[Device] = ["cpu"]
    if device != "cpu":
        found = find_cuda(needed=device == "cuda" or "cuda" in available_devices())
        if found.state == OK:
            devices.append("cuda")
        yield found
    if not shipped_models():
        yield Finding(FAILED, "networks", NO_NETWORKS)
    ball, mask = make_ball(), make_ball(MASK)
    for name in sorted(shipped_models(), key=lambda name: name != float32_name(name)):  # int8 last
        plain = float32_name(name)
        some = devices if name == plain else devices[:1]
        yield from check_network(name, some, mask if plain == MASK_MODEL else ball)
    for name, modules in EXTRAS.items():
        yield check_extra(name, modules)


def check_versions() -> Finding:
    """List the versions; fail if both packages of onnxruntime, which share files, are installed."""
    says = (
        f"super-sdf {__version__}, Python {platform.python_version()}, NumPy "
        f"{np.__version__}, {onnxruntime_version()}"
    )
    if not (is_installed("onnxruntime") and is_installed("onnxruntime-gpu")):
        return Finding(OK, "versions", says)
    says += "; onnxruntime and onnxruntime-gpu are both installed: uninstall both, then install one"
    return Finding(FAILED, "versions", says)


def is_installed(package: str) -> bool:
    """Return whether a package is installed, by its metadata."""
    with suppress(PackageNotFoundError):
        return bool(version(package))
    return False


def check_memory() -> Finding:
    """Report the free memory."""
    free = free_memory()
    if free is None:
        return Finding(OK, "memory", "the system does not report the free memory")
    return Finding(OK, "memory", f"{free / 1e9:.1f} GB free", {"free_bytes": free})


def find_cuda(needed: bool) -> Finding:
    """Report the GPU, or what CUDA lacks here."""
    try:
        check_cuda()
    except DeviceError as error:
        return Finding(FAILED if needed else MISSING, "cuda", str(error))
    return Finding(OK, "cuda", describe_gpu() or "its libraries are there")


def make_ball(kind: FieldKind = AUTO) -> Ball:
    """Sample a ball, as a mask if so wanted."""
    values = np.linalg.norm(np.indices((SAMPLES,) * 3) - CENTRE, axis=0) - RADIUS
    band = survey(make_grid(values.astype(np.float32), spacing=1.0, origin=0.0, field=kind))
    patches, table, voxels = band.network_inputs()
    offsets = block_offsets(4)
    nodes = band.voxel_ijk[voxels, None] + offsets / 2  # offsets are in half voxels
    exact = np.linalg.norm(nodes - CENTRE, axis=2) - RADIUS
    allowed = MASK_ERROR if kind == MASK else LARGEST_ERROR
    return Ball((patches, table, voxels, offsets), exact.astype(np.float32), allowed)


def check_network(name: str, devices: list[Device], ball: Ball) -> Iterator[Finding]:
    """Run a shipped network on the ball on each device, the CPU first."""
    reference: FloatArray | None = None
    for device in devices:
        what = f"network {name} on {device}"
        try:
            values, microseconds = run_network(name, device, ball)
        except SuperSdfError as error:
            yield Finding(FAILED, what, str(error))
            continue
        yield judge(what, values, microseconds, ball, reference)
        reference = values if device == "cpu" else reference


def run_network(name: str, device: Device, ball: Ball) -> tuple[FloatArray, float]:
    """Return a network's values, (D, Q) in voxels, and microseconds per voxel of the band."""
    network = load_network(name, device=device, precision=FLOAT32)  # its own file
    network(*ball.inputs)  # the first run is slower
    start = time.perf_counter()
    half_voxels = network(*ball.inputs)
    seconds = time.perf_counter() - start
    return half_voxels * np.float32(0.5), 1e6 * seconds / len(ball.inputs[0])


def judge(
    what: str, values: FloatArray, microseconds: float, ball: Ball, reference: FloatArray | None
) -> Finding:
    """Compare values, (D, Q) in voxels, with the exact ones and with those of the CPU."""
    off = float(np.abs(values - ball.exact).max())
    works = off <= ball.allowed  # False for NaN
    says = f"off by {off:.3f} voxels at most on a ball, {microseconds:.1f} us per voxel"
    figures = {"off_voxels": off, "microseconds_a_voxel": microseconds}
    if reference is not None:
        apart = float(np.abs(values - reference).max())
        works = works and apart <= LARGEST_DIFFERENCE
        says += f", {apart:.0e} voxels from the values of the CPU"
        figures["from_cpu_voxels"] = apart
    if not works:
        allowed = f"{ball.allowed} on the ball and {LARGEST_DIFFERENCE:.0e} from the CPU"
        says += f"; allowed are {allowed}"
    return Finding(OK if works else FAILED, what, says, figures)


def check_extra(name: str, modules: tuple[str, ...]) -> Finding:
    """Report whether the modules of an extra are installed."""
    if missing := missing_modules(modules):
        says = f"no {', '.join(missing)}: {how_to_install(name)}"
        return Finding(MISSING, f"extra {name}", says)
    return Finding(OK, f"extra {name}", ", ".join(modules))
