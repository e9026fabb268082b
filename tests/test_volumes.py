"""--keep-volume: meshes of masks and labels with the volume of their samples."""

import json
from collections import Counter

import numpy as np
import pytest

from super_sdf import make_grid, reconstruct, reconstruct_labels
from super_sdf.check.check import check_mesh
from super_sdf.grid.sdf_grid import volume_of_samples
from super_sdf.labels.volumes import keep_volumes
from super_sdf.truth.mesh_files import read_mesh

SPACING = (1.5, 1.5, 4.0)


def organs():
    """Return two balls that touch, and a tube through one of them."""
    x, y, z = (s * (i + 0.5) for s, i in zip(SPACING, np.indices((42, 32, 12))))
    labels = np.zeros(x.shape, np.uint8)
    labels[np.sqrt((x - 22) ** 2 + (y - 24) ** 2 + (z - 24) ** 2) < 16] = 1
    labels[np.sqrt((x - 44) ** 2 + (y - 24) ** 2 + (z - 24) ** 2) < 11] = 2
    labels[np.hypot(x - 22, y - 24) < 5] = 5
    return labels


def ball(radius=6.7):
    places = np.indices((18, 19, 20)) - np.array([8.3, 9.1, 9.6])[:, None, None, None]
    return np.linalg.norm(places, axis=0) < radius


def test_a_mask_has_the_volume_of_its_samples():
    grid = make_grid(ball(), spacing=0.5)
    mesh = reconstruct(grid)
    volume = volume_of_samples(grid)
    assert volume == ball().sum() / 8
    assert mesh.volume() < 0.985 * volume
    (kept,) = keep_volumes([mesh], [volume], 0.5)
    assert kept.volume() == pytest.approx(volume, rel=1e-5)
    assert check_mesh(kept, grid).surface.faults() == []
    away = np.linalg.norm(kept.vertices - mesh.vertices, axis=1)
    assert 0.25 < away.min() / away.max() < 1 and away.max() < 0.05 * 0.5


def test_labels_have_the_volumes_of_their_samples_and_share_their_walls():
    labels = organs()
    plain, kept = (
        reconstruct_labels(labels, spacing=SPACING, keep_volume=k) for k in (False, True)
    )
    for label, mesh in kept.items():
        volume = (labels == label).sum() * np.prod(SPACING)
        assert mesh.volume() == pytest.approx(volume, rel=1e-4)
        assert abs(plain[label].volume() - volume) > 2e-3 * volume
        np.testing.assert_array_equal(mesh.faces, plain[label].faces)
        grid = make_grid(labels, label=label, spacing=SPACING)
        assert check_mesh(mesh, grid).surface.faults() == []
    triangles = [mesh.vertices[mesh.faces].tolist() for mesh in kept.values()]
    times = Counter(tuple(sorted(map(tuple, corners))) for part in triangles for corners in part)
    assert sorted(set(times.values())) == [1, 2] and list(times.values()).count(2) > 3000


def test_the_command_keeps_volumes(tmp_path, command):
    for name, values, option in (("mask", ball(), ()), ("labels", organs(), ("--labels", "all"))):
        np.save(tmp_path / f"{name}.npy", values)
        run = "upsample", tmp_path / f"{name}.npy", tmp_path / f"{name}.ply", "--spacing", 1
        code, out, _ = command(*run, *option, "--keep-volume", "--json")
        assert code == 0
        rows = json.loads(out).get("labels") or [{"output": tmp_path / "mask.ply", "label": 1}]
        for row in rows:
            mesh = read_mesh(row["output"])
            assert mesh.volume() == pytest.approx((values == row["label"]).sum(), rel=1e-4)
            assert row.get("volume", mesh.volume()) == pytest.approx(mesh.volume(), rel=1e-6)


def test_a_volume_that_stays_off_is_noted(tmp_path, command):
    np.save(tmp_path / "mask.npy", ball())
    run = "upsample", tmp_path / "mask.npy", tmp_path / "mask.ply", "--spacing", 1
    for option, is_off in (((), False), (("--simplify", 0.2), True)):
        code, _, err = command(*run, "--keep-volume", "--force", *option)
        assert code == 0 and ("off those of the samples: the mesh " in err) == is_off


def test_what_has_no_volume_to_keep_is_refused(tmp_path, command):
    exact = 6 - np.linalg.norm(np.indices((18, 18, 18)) - 8.6, axis=0)
    np.save(tmp_path / "exact.npy", -exact)
    np.save(tmp_path / "mask.npy", ball())
    for name, option, message in (
        ("exact", (), " is for masks and labels, the values are exact: leave it out"),
        ("mask", ("--offset", "0.1"), " is for the surface of the samples, offset is 0.1: "),
        ("mask", ("--open",), " needs a closed mesh: leave out --open"),
    ):  # fmt: skip
        run = "upsample", tmp_path / f"{name}.npy", tmp_path / "out.ply", "--keep-volume"
        code, _, err = command(*run, "--spacing", 1, *option)
        assert code == 2 and f"Error: keep-volume{message}" in err
        assert not (tmp_path / "out.ply").exists()
