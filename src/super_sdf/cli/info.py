"""The command ``info``: versions, devices and networks; with ``--check``, whether they work."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from typing import Any

import click

from .. import __version__
from ..errors import OptionError, SuperSdfError
from ..options import DEVICES, FLOAT32, MESHERS, Device
from .common import CONTEXT, one_line_errors, print_stdout

EXAMPLES = """\b
Examples:
  super-sdf info --check
  super-sdf info --check --device cuda
  super-sdf info scan.zarr
  super-sdf info fire.vdb
"""


@click.command(
    "info",
    context_settings=CONTEXT,
    epilog=EXAMPLES,
    short_help="Show versions, devices and networks, check them, or describe a grid file.",
)
@click.argument("source", metavar="[GRID]", required=False)
@click.option("--check", is_flag=True, help="Test the installation; exit code 1 if a check fails.")
@click.option(
    "--device",
    type=click.Choice(DEVICES),
    default=DEVICES[0],
    show_default=True,
    help="With --check: cpu skips CUDA; cuda makes it a failure if CUDA does not work.",
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def info_command(source: str | None, check: bool, device: Device, as_json: bool) -> None:
    """Show versions, devices, and the shipped networks with their metadata.

    With GRID, show instead what that grid file states: shape, type, spacing, origin, and
    how it is stored, such as the chunks of a Zarr array; of an OpenVDB file, all its grids.

    With --check, test instead whether they work on this machine: each network is run on a ball,
    whose distances are known, on the CPU and on CUDA. What is missing is listed with the command
    that installs it.
    """
    with one_line_errors():
        if source is not None and check:
            raise OptionError(f"{source} and --check: give only one of them")
        if source is not None:
            print_grid(source, as_json)
        elif not (print_checks(device, as_json) if check else print_facts(as_json)):
            sys.exit(1)


def print_grid(source: str, as_json: bool) -> None:
    """Print what a grid file states."""
    from ..files.grids import describe_grid_file

    found = describe_grid_file(source)
    if as_json:
        print_stdout(json.dumps(found, indent=2))
        return
    notes, grids = found.pop("notes", ()), found.pop("grids", ())
    for key, value in found.items():
        print_stdout(f"{key}: {_in_words(value)}")
    for grid in grids:
        print_stdout(f"grid: {_grid_in_words(grid)}")
    for note in notes:
        print_stdout(f"note: {note}")


def _in_words(value: Any) -> str:
    if value is None:
        return "not stated"
    if isinstance(value, list):
        return ", ".join(f"{x:.10g}" for x in value)
    return f"{value:,}" if isinstance(value, int) else str(value)


def _grid_in_words(grid: dict[str, Any]) -> str:
    """Return one of the grids that a file of OpenVDB holds."""
    words = [grid["name"] or "without a name", grid["type"], grid["class"]]
    if grid["active_voxels"] is not None:
        words.append(f"{grid['active_voxels']:,} active voxels")
    return ", ".join(words)


def print_checks(device: Device, as_json: bool) -> bool:
    """Run the checks and print each result as it comes; return whether none failed."""
    from .selftest import FAILED, run_checks

    findings = []
    for finding in run_checks(device):
        findings.append(finding)
        if not as_json:
            print_stdout(f"{finding.state:<8} {finding.what}: {finding.says}")
    failed = sum(finding.state == FAILED for finding in findings)
    if as_json:
        report = {"works": not failed, "findings": [asdict(finding) for finding in findings]}
        print_stdout(json.dumps(report, indent=2))
    elif failed:
        print_stdout(f"{failed} of {len(findings)} checks failed")
    else:
        print_stdout("What is installed works.")
    return not failed


def print_facts(as_json: bool) -> bool:
    """Print versions, devices and the networks' cards; return whether all networks load."""
    facts = gather_facts()
    if as_json:
        print_stdout(json.dumps(facts, indent=2))
    else:
        for key in ("super-sdf", "python", "onnxruntime"):
            print_stdout(f"{key} {facts[key]}")
        for key in ("devices", "meshers"):
            print_stdout(f"{key}: {', '.join(facts[key])}")
        for name, card in facts["models"].items():
            print_stdout(f"model {name}")
            for key, value in sorted(card.items()):
                print_stdout(f"  {key.replace('_', ' ')}: {value}")
        if not facts["models"]:
            print_stdout(f"models: {facts['fault']}")
    return "fault" not in facts and not any("fault" in card for card in facts["models"].values())


def gather_facts() -> dict[str, Any]:
    """Return versions, devices and the networks' cards, or under ``fault`` why one cannot load."""
    import platform

    from ..network.device import available_devices
    from ..network.network import NO_NETWORKS, load_network, shipped_models
    from ..network.onnx import ort

    models: dict[str, dict[str, Any]] = {}
    for name in shipped_models():
        try:
            models[name] = dict(load_network(name, device="cpu", precision=FLOAT32).card)
        except SuperSdfError as error:
            models[name] = {"fault": str(error)}
    facts = {
        "super-sdf": __version__,
        "python": platform.python_version(),
        "onnxruntime": ort.__version__,
        "devices": available_devices(),
        "meshers": MESHERS,
        "models": models,
    }
    return facts if models else {**facts, "fault": NO_NETWORKS}
