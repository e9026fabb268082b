"""The option ``--labels`` of ``upsample``: all labels of an image in one run."""

from __future__ import annotations

import json
from typing import Any

from ..label_files import check_options, convert_labels
from ..options import ConvertOptions
from ..progress import Stopwatch
from .common import print_stderr, print_stdout, progress_bar
from .conversion import chosen_model, load_chosen
from .interrupts import raising_interrupts
from .upsampling import describe_network, rounded

NOT_WITH_LABELS = ("save_field", "check", "report", "cluster", "jobs")


def upsample_labels(
    source: str, target: str, chosen: ConvertOptions, options: dict[str, Any]
) -> None:
    """Convert the labels of an image to meshes, and print what was made."""
    watch, model = Stopwatch(), chosen_model(options)
    check_options(chosen, [name for name in NOT_WITH_LABELS if options[name]])
    network, labels, force = load_chosen(options), options["labels"], options["force"]
    watch.lap("load network")
    with raising_interrupts(), progress_bar("upsampling", options["quiet"]) as progress:
        found = convert_labels(
            source, target, network, labels, chosen, force=force, progress=progress
        )
    watch.lap("convert")
    if options["as_json"]:
        report = {
            "input": source,
            "output": target,
            "factor": chosen.factor,
            **describe_network(model, network),
            **found,
            "seconds": rounded(watch.seconds),
        }
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
