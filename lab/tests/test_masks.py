"""Masks and labels beside other tools: meshes at their place, and figures of closed forms."""

from __future__ import annotations

import pytest

from lab import masks

SCENES = {scene.name: scene for scene in masks.scenes([], [])}


@pytest.mark.parametrize("method", masks.PEERS)
def test_a_ball_is_measured(method, monkeypatch):
    monkeypatch.setattr(masks, "NODES", 200_000)
    row, off = masks.measure(SCENES["ball-8-0"], method, 1), 0.16 + 0.3 * (method == "surfacenets")
    assert row["open"] == 0 and abs(row["bias"]) - 0.01 < row["voxels"] < off
    assert row["volume"] == pytest.approx(100 * abs(1 - (1 + row["bias"] / 8) ** 3), abs=0.4)


def test_walls_that_are_shared_leave_no_gap(monkeypatch):
    monkeypatch.setattr(masks, "NODES", 100_000)
    found = {name: masks.measure(SCENES["labels"], name, 1) for name in ("mc", "serra", "ours")}
    assert max(found["serra"]["gaps"], found["ours"]["overlaps"]) < 2e-4 < found["mc"]["gaps"]
