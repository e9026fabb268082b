"""The option ``--labels`` of ``upsample``: all labels of an image in one run."""

from __future__ import annotations

import json
from typing import Any

from .common import print_stderr, print_stdout, progress_bar
from .conversion import chosen_model, make_options
from .interrupts import raising_interrupts

OTHERS = ("save_field", "check", "report", "cluster", "jobs")


def run_labels(source: str, target: str, options: dict[str, Any]) -> None:
    """Convert the labels of an image to meshes, and print what was made."""
    from ..label_files import check_options, convert_labels
    from ..network.network import load_network
    from ..progress import Stopwatch

    watch, model, given = Stopwatch(), chosen_model(options), make_options(options)
    check_options(given, [name for name in OTHERS if options[name]])
    chosen = {name: options[name] for name in ("device", "threads", "precision")}
    network = load_network(model, **chosen)
    watch.lap("load network")
    with raising_interrupts(), progress_bar("upsampling", options["quiet"]) as progress:
        found = convert_labels(
            source,
            target,
            network,
            options["labels"],
            given,
            force=options["force"],
            progress=progress,
        )
    watch.lap("convert")
    report = {
        "input": source,
        "output": target,
        "factor": given.factor,
        "model": model,
        "precision": network.precision,
        "device": network.device,
        "device_notes": list(network.notes),
        **found,
        "seconds": {stage: round(seconds, 4) for stage, seconds in watch.seconds.items()},
    }
    if options["as_json"]:
        print_stdout(json.dumps(report, indent=2), "the meshes are written")
    if options["quiet"]:
        return
    for note in (*found["inferred"], *network.notes):
        print_stderr(f"Note: {note}")
    for row in found["labels"]:
        print_stderr(
            f"{row['output']}: label {row['label']}, {row['vertices']:,} vertices, "
            f"{row['triangles']:,} triangles, closed, volume {row['volume']:.6g}"
        )
    print_stderr(f"{len(found['labels'])} labels, {sum(watch.seconds.values()):.1f} s")
