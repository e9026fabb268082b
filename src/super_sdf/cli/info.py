"""The command ``info``: versions, devices and networks; with ``--check``, whether they work."""

from __future__ import annotations

import json
import platform
import sys
from collections.abc import Iterator
from typing import Any

import click

from .. import __version__, errors
from ..options import EXACT, FLOAT32, MARCHING, MASK, MESHERS, Device
from . import common
from .common import option, print_stdout

EXAMPLES = """\b
Examples:
  super-sdf info --check
  super-sdf info --check --device cuda
  super-sdf info scan.zarr
"""
OK, MISSING, FAILED = "ok", "missing", "failed"
SAMPLES, CENTRE, RADIUS = 32, 15.63, 12.0  # of a ball, in voxels; the centre is on no sample
MOST_OFF, MOST_OFF_OF_MASK = 0.05, 0.6  # voxels; a mask shows the surface to half a voxel

# fmt: off
TAKES = (
    click.argument("source", metavar="[GRID]", required=False),
    option("--check", is_flag=True, help="Test the installation; exit code 1 if a check fails."),
    common.table_options("device",
        device="With --check: cpu skips CUDA; cuda makes it a failure if CUDA does not work."),
    common.shared("json"),
)
# fmt: on


@common.make_command(
    "Show versions, devices and networks, check them, or describe a grid file.", EXAMPLES, *TAKES
)
def command(source: str | None, check: bool, device: Device, as_json: bool) -> None:
    """Show versions, devices, and the shipped networks with their metadata.

    With GRID, show instead what that grid file states: shape, type, spacing, origin, and
    how it is stored, such as the chunks of a Zarr array; of an OpenVDB file, all its grids.

    With --check, test instead whether they work on this machine: each network refines a ball on the
    CPU and on CUDA. What is missing is listed with the command that installs it.
    """
    if source is not None and check:
        raise errors.OptionError(f"{source} and --check: give only one of them")
    if check:
        findings = []
        for state, what, says in run_checks(device):
            findings.append({"state": state, "what": what, "says": says})
            if not as_json:
                print_stdout(f"{state:<8} {what}: {says}")
        failed = sum(finding["state"] == FAILED for finding in findings)
        said = (
            f"{failed} of {len(findings)} checks failed" if failed else "What is installed works."
        )
        facts: dict[str, Any] = {"works": not failed, "findings": findings}
    else:
        if source is not None:
            from ..files.grids import describe_grid_file

        facts = gather_facts() if source is None else describe_grid_file(source)
        cards = facts.get("models", {}).values()
        failed = "fault" in facts or any("fault" in card for card in cards)
        said = "\n".join(in_words(facts))
    print_stdout(json.dumps(facts, indent=2) if as_json else said)
    if failed:
        sys.exit(1)


def in_words(facts: dict[str, Any]) -> Iterator[str]:
    """Yield lines of facts: one each, one for each of several, or a heading with lines below."""
    for key, value in facts.items():
        name = key.replace("_", " ")
        if isinstance(value, dict):
            for of, inner in value.items():
                yield f"{name.removesuffix('s')} {of}"
                yield from (f"  {line}" for line in in_words(inner))
        elif isinstance(value, (list, tuple)) and value and isinstance(value[0], dict):
            for inner in value:  # the grids of a file of OpenVDB
                said = [x for x in inner.values() if x]
                words = (f"{x:,} active voxels" if isinstance(x, int) else str(x) for x in said)
                yield f"{name.removesuffix('s')}: {', '.join(words)}"
        elif key == "notes":
            yield from (f"note: {note}" for note in value)
        elif isinstance(value, (list, tuple)) and value:
            words = (f"{x:.10g}" if isinstance(x, (int, float)) else str(x) for x in value)
            yield f"{name}: {', '.join(words)}"
        elif value not in ([], ()):
            text = f"{value:,}" if isinstance(value, int) else str(value)
            yield f"{name}: {'not stated' if value is None else text}"


def gather_facts() -> dict[str, Any]:
    """Return versions, devices and the networks' cards, or under ``fault`` why one cannot load."""
    from ..network.network import NO_NETWORKS, load_network, shipped_models
    from ..network.onnx import VERSION, available_devices

    models: dict[str, Any] = {}
    for name in shipped_models():
        try:
            models[name] = dict(load_network(name, device="cpu", precision=FLOAT32).card)
        except errors.SuperSdfError as error:
            models[name] = {"fault": str(error)}
    return {
        "super-sdf": __version__,
        "python": platform.python_version(),
        "onnxruntime": VERSION.removeprefix("onnxruntime "),
        "devices": available_devices(),
        "meshers": MESHERS,
        "models": models,
        **({} if models else {"fault": NO_NETWORKS}),
    }


def run_checks(device: Device) -> Iterator[tuple[str, str, str]]:
    """Yield state, name and words of each check; CUDA is needed if onnxruntime is built for it."""
    from ..network.network import NO_NETWORKS, shipped_models
    from ..network.onnx import VERSION, available_devices, check_cuda

    versions = f"super-sdf {__version__}, Python {platform.python_version()}"
    yield (OK, "versions", f"{versions}, {VERSION}")
    devices: list[Device] = ["cpu"]
    if device != "cpu":
        try:
            check_cuda()
            devices.append("cuda")
            yield (OK, "cuda", "its libraries are there")
        except errors.DeviceError as error:
            needed = device == "cuda" or "cuda" in available_devices()
            yield (FAILED if needed else MISSING, "cuda", str(error))
    if not shipped_models():
        yield (FAILED, "networks", NO_NETWORKS)
    for name in shipped_models():
        for each in devices[:1] if name.endswith("-int8") else devices:
            yield check_network(name, each)
    for name, modules in errors.EXTRAS.items():
        lacking, says = errors.missing_modules(modules), ", ".join(modules)
        if lacking:
            says = f"no {', '.join(lacking)}: {errors.how_to_install(name)}"
        yield (MISSING if lacking else OK, f"extra {name}", says)


def check_network(name: str, device: Device) -> tuple[str, str, str]:
    """Refine a ball with a shipped network on a device."""
    import numpy as np

    from ..grid.sdf_grid import make_grid
    from ..network.network import load_network
    from ..pipeline import reconstruct

    values: Any = np.linalg.norm(np.indices((SAMPLES,) * 3) - CENTRE, axis=0) - RADIUS
    is_mask, what = name.startswith(MASK), f"network {name} on {device}"
    values, most = (values < 0, MOST_OFF_OF_MASK) if is_mask else (values, MOST_OFF)
    grid = make_grid(values, spacing=1.0, origin=0.0, field=MASK if is_mask else EXACT)
    try:
        network = load_network(name, device=device, precision=FLOAT32)  # its own file
        found = reconstruct(grid, network, mesher=MARCHING).vertices
    except errors.SuperSdfError as error:
        return (FAILED, what, str(error))
    off = float(np.abs(np.linalg.norm(found - CENTRE, axis=1) - RADIUS).max())
    works = off <= most  # False for NaN
    says = f"off by {off:.3f} voxels at most on a ball" + f"; allowed are {most}" * (not works)
    return (OK if works else FAILED, what, says)
