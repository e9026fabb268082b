"""Show versions, devices, networks and extras, and the command that installs missing extras.

With --check, each network also refines a ball, on the CPU and on CUDA. With GRID, show only what
the grid file states: shape, type, spacing and origin.

  super-sdf info --check --device cuda
  super-sdf info scan.zarr
"""

from __future__ import annotations

import platform
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
from click import Argument, Option

from .. import __version__, errors
from ..files.grids import describe_grid_file
from ..options import OPTIONS, Device
from . import main

OK, MISSING, FAILED = "ok", "missing", "failed"
SHORT = ("shape", "dtype", "spacing", "origin")  # of each of several grids
SAID = {float: "{:.10g}", int: "{:,}", type(None): "not stated"}  # how facts are shown
CENTRE, RADIUS = 15.63, 12.0  # of a ball, in voxels; the centre is on no sample
MOST_OFF, MOST_OFF_OF_MASK = 0.05, 0.6  # voxels; a mask shows the surface to half a voxel
TAKES = (
    Argument(["source"], metavar="[GRID]", required=False, type=main.NAME),
    Option(["--check"], is_flag=True, help="Also run the networks."),
    main.table_option("device", "cpu leaves CUDA out; with cuda the exit code is 1 if CUDA fails."),
    "json",
)  # fmt: skip


def command(source: str | None, check: bool, device: Device, as_json: bool) -> None:
    """Print findings as they come; the exit code is 1 if something failed."""
    OPTIONS["device"].check(device)
    if source is not None:
        facts = describe_grid_file(source)
        main.print_stdout(*([facts] if as_json else in_words(facts)))
        return
    findings = []
    for state, what, says in run_checks(device, check):
        findings.append({"state": state, "what": what, "says": says})
        if not as_json:
            main.print_stdout(f"{state:<8} {what}: {says}")
    works = all(finding["state"] != FAILED for finding in findings)
    if as_json:
        main.print_stdout({"works": works, "findings": findings})
    if not works:
        sys.exit(1)


def in_words(facts: dict[str, Any]) -> Iterator[str]:
    """Yield facts as lines: a line each, and one for each note, or for each of several grids."""
    for key, value in facts.items():
        values = value if isinstance(value, list) else [value]
        words = [SAID.get(type(each), "{}").format(each) for each in values]
        if key == "notes":
            yield from (f"note: {note}" for note in words)
        elif key == "grids":
            for each in value:
                shown = in_words({name: each[name] for name in SHORT if name in each})
                yield each.get("error") or f"{each['file']}: {'; '.join(shown)}"
        elif words:
            yield f"{key.replace('_', ' ')}: {', '.join(words)}"


def run_checks(device: Device, check: bool) -> Iterator[tuple[str, str, str]]:
    """Yield state, name and words of each finding; CUDA is needed if onnxruntime has it."""
    from ..network.network import NO_NETWORKS, shipped_models
    from ..network.onnx import VERSION, available_devices, check_cuda

    yield OK, "versions", f"super-sdf {__version__}, Python {platform.python_version()}, {VERSION}"
    devices: list[Device] = ["cpu"]
    if device != "cpu":
        try:
            check_cuda()
            devices.append("cuda")
            yield OK, "cuda", "its libraries are there"
        except errors.DeviceError as error:
            needed = device == "cuda" or "cuda" in available_devices()
            yield FAILED if needed else MISSING, "cuda", error.flagged
    names = ", ".join(shipped_models())
    yield OK if names else FAILED, "networks", names or NO_NETWORKS
    for name in shipped_models() if check else ():
        for each in devices[:1] if name.endswith("-int8") else devices:
            yield check_network(name, each)
    absent = [name for name in errors.EXTRAS if errors.to_install(name)]
    for name, modules in errors.EXTRAS.items():
        yield MISSING if name in absent else OK, f"extra {name}", ", ".join(modules)
    if absent:
        yield MISSING, "to install", f"pip install -e '.[{','.join(absent)}]' in a clone"


def check_network(name: str, device: Device) -> tuple[str, str, str]:
    """Refine a ball with a shipped network on a device."""
    from .. import load_network, make_grid, reconstruct

    values: Any = np.linalg.norm(np.indices((32, 32, 32)) - CENTRE, axis=0) - RADIUS
    is_mask, what = name.startswith("mask"), f"network {name} on {device}"
    grid = make_grid(values < 0 if is_mask else values, spacing=1.0, origin=0.0)
    try:  # float32, as its file for int8 is a network of its own
        network = load_network(name, device=device, precision="float32")
        found = reconstruct(grid, network, mesher="marching").vertices
    except errors.SuperSdfError as error:
        return FAILED, what, error.flagged
    off = float(np.abs(np.linalg.norm(found - CENTRE, axis=1) - RADIUS).max())
    is_good = off <= (MOST_OFF_OF_MASK if is_mask else MOST_OFF)
    return OK if is_good else FAILED, what, f"off by {off:.3f} voxels at most on a ball"
