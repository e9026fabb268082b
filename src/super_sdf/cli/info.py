"""The command ``info``: versions, devices and networks; with ``--check``, whether they work."""

from __future__ import annotations

import platform
import sys
from collections.abc import Iterator
from typing import Any

import click
import numpy as np

from .. import __version__, errors
from ..options import DISTANCE, FLOAT32, MASK, MESHERS, OPTIONS, Device
from . import main
from .main import SHARED, option, table_option

HELP = """Show versions, devices and the shipped networks.

With GRID, show instead what that grid file states: shape, type, spacing and origin. With
--check, test the installation: each network refines a ball on the CPU and on CUDA, and what is
missing is listed with the command that installs it.

\b
Examples:
  super-sdf info --check
  super-sdf info --check --device cuda
  super-sdf info scan.zarr
"""
OK, MISSING, FAILED = "ok", "missing", "failed"
SAMPLES, CENTRE, RADIUS = 32, 15.63, 12.0  # of a ball, in voxels; the centre is on no sample
MOST_OFF, MOST_OFF_OF_MASK = 0.05, 0.6  # voxels; a mask shows the surface to half a voxel
TAKES = (
    click.argument("source", metavar="[GRID]", required=False),
    option("--check", is_flag=True, help="Test the installation; exit code 1 if a check fails."),
    table_option("device", "With --check: cpu skips CUDA; cuda makes it a failure if CUDA fails."),
    SHARED["json"],
)


@main.make_command("Show versions, devices and networks, or describe a grid file.", HELP, *TAKES)
def command(source: str | None, check: bool, device: Device, as_json: bool) -> None:
    """Print facts, or findings as they come."""
    if source is not None and check:
        raise errors.OptionError(f"{source} and --check: give only one of them")
    facts: dict[str, Any]
    OPTIONS["device"].check(device)
    if check:
        findings = []
        for state, what, says in run_checks(device):
            findings.append({"state": state, "what": what, "says": says})
            if not as_json:
                main.print_stdout(f"{state:<8} {what}: {says}")
        failed = sum(finding["state"] == FAILED for finding in findings)
        said = (
            f"{failed} of {len(findings)} checks failed" if failed else "What is installed works."
        )
        facts = {"works": not failed, "findings": findings}
    elif source is not None:
        from ..files.grids import describe_grid_file

        facts, failed = describe_grid_file(source), 0
        said = "\n".join(in_words(facts))
    else:
        facts = gather_facts()
        cards = facts["models"]
        faults = {f"network {n}": cards[n]["fault"] for n in cards if "fault" in cards[n]}
        failed = len(faults) + ("fault" in facts)
        said = "\n".join(in_words({**facts, "models": list(cards), **faults}))
    main.print_stdout(facts if as_json else said)
    if failed:
        sys.exit(1)


def in_words(facts: dict[str, Any]) -> Iterator[str]:
    """Yield facts as lines: a line each, and one for each note."""
    for key, value in facts.items():
        values = value if isinstance(value, (list, tuple)) else [value]
        if key == "notes":
            yield from (f"note: {note}" for note in values)
        elif values:
            yield f"{key.replace('_', ' ')}: {', '.join(map(in_word, values))}"


def in_word(value: Any) -> str:
    """Return a value of a fact as text."""
    if isinstance(value, float):
        return f"{value:.10g}"
    return "not stated" if value is None else f"{value:,}" if isinstance(value, int) else str(value)


def gather_facts() -> dict[str, Any]:
    """Return versions, devices and the networks' cards, or under ``fault`` why one cannot load."""
    from ..network.network import NO_NETWORKS, load_network, shipped_models
    from ..network.onnx import VERSION, available_devices

    models: dict[str, Any] = {}
    for name in shipped_models():
        try:
            models[name] = dict(load_network(name, device="cpu", precision=FLOAT32).card)
        except errors.SuperSdfError as error:
            models[name] = {"fault": error.flagged}
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
    yield OK, "versions", f"{versions}, {VERSION}"
    devices: list[Device] = ["cpu"]
    if device != "cpu":
        try:
            check_cuda()
            devices.append("cuda")
            yield OK, "cuda", "its libraries are there"
        except errors.DeviceError as error:
            needed = device == "cuda" or "cuda" in available_devices()
            yield FAILED if needed else MISSING, "cuda", error.flagged
    if not shipped_models():
        yield FAILED, "networks", NO_NETWORKS
    for name in shipped_models():
        for each in devices[:1] if name.endswith("-int8") else devices:
            yield check_network(name, each)
    for name, modules in errors.EXTRAS.items():
        if lacking := errors.missing_modules(modules):
            way_out = errors.how_to_install(name)
            yield MISSING, f"extra {name}", f"no {', '.join(lacking)}: {way_out}"
        else:
            yield OK, f"extra {name}", ", ".join(modules)


def check_network(name: str, device: Device) -> tuple[str, str, str]:
    """Refine a ball with a shipped network on a device."""
    from .. import load_network, make_grid, reconstruct

    values: Any = np.linalg.norm(np.indices((SAMPLES,) * 3) - CENTRE, axis=0) - RADIUS
    is_mask, what = name.startswith(MASK), f"network {name} on {device}"
    values, most = (values < 0, MOST_OFF_OF_MASK) if is_mask else (values, MOST_OFF)
    grid = make_grid(values, spacing=1.0, origin=0.0, field=MASK if is_mask else DISTANCE)
    try:
        network = load_network(name, device=device, precision=FLOAT32)  # its own file
        found = reconstruct(grid, network, mesher="marching").vertices
    except errors.SuperSdfError as error:
        return FAILED, what, error.flagged
    off = float(np.abs(np.linalg.norm(found - CENTRE, axis=1) - RADIUS).max())
    says = f"off by {off:.3f} voxels at most on a ball"
    return (OK, what, says) if off <= most else (FAILED, what, f"{says}; allowed are {most}")
