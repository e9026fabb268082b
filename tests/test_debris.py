"""Small pieces of the surface: which are dropped, which stay, and that vessels have no handles."""

import json

import numpy as np
import pytest
from conftest import ball
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from super_sdf import load_network, make_grid, reconstruct
from super_sdf.check.surface import count_components
from super_sdf.network.network import Network
from super_sdf.refine.debris import count_between, drop_debris
from super_sdf.refine.field import SampleSpheres
from super_sdf.refine.nodes import VoxelIndex, block_ijk, share_parts

K, SIZE = 4, 6
VOXELS = np.indices((SIZE,) * 3).reshape(3, -1).T.astype(np.int32)
NODES = K * VOXELS[:, None] + block_ijk(K)  # of all blocks, (D, Q, 3)
MIDDLE = np.array([3 * K + K // 2] * 3)  # of voxel (3, 3, 3)


@pytest.fixture(scope="module")
def network():
    return load_network(threads=1)


def table_of_all():
    """Return the neighbour table of the voxels of a whole grid."""
    steps = np.indices((3, 3, 3)).reshape(3, -1).T - 1
    beside = VOXELS[:, None] + steps
    number = np.ravel_multi_index(np.moveaxis(beside.clip(0, SIZE - 1), -1, 0), (SIZE,) * 3)
    return np.where(((beside >= 0) & (beside < SIZE)).all(-1), number, -1).astype(np.int32)


def drop(lattice, centres=(), distances=()):
    """Drop debris from a dense field: return it, and what ``drop_debris`` counts."""
    blocks = np.zeros((len(block_ijk(K)), len(VOXELS) + 1), np.float32)
    blocks[:, :-1] = lattice[tuple(NODES.T)]
    shape = (SIZE,) * 3
    centres = np.array(centres, np.int32).reshape(-1, 3)
    spheres = SampleSpheres(shape, centres, np.array(distances, np.float32))
    parts = share_parts(table_of_all())
    found = drop_debris(blocks, K, parts, VoxelIndex(VOXELS, shape), spheres)
    out = np.empty_like(lattice)
    out[tuple(NODES.T)] = blocks[:, :-1]
    assert (out[tuple(NODES.T)] == blocks[:, :-1]).all()  # all copies agree
    return out, *found


def field_with(*nodes, value=-0.3):
    """Return a field of 1 with some nodes of another value."""
    lattice = np.ones((K * SIZE + 1,) * 3, np.float32)
    for node in nodes:
        lattice[tuple(node)] = value
    return lattice


@settings(max_examples=30)
@pytest.mark.parametrize("sign", [1, -1])
@given(size=st.tuples(*[st.integers(1, 6)] * 3), at=st.tuples(*[st.integers(0, K - 1)] * 3))
def test_pieces_of_less_than_a_voxel_are_dropped_wherever_they_are(sign, size, at):
    low = np.array([2 * K, 2 * K, 2 * K]) + at
    nodes = low + np.indices(size).reshape(3, -1).T
    on_samples = ((nodes - K // 2) % K == 0).all(1).any()
    lattice = sign * field_with(*nodes)
    out, dropped, lone = drop(lattice)
    fits = max(size) <= K
    assert list(dropped) == ([(low[0] - 1) // K] if fits and not on_samples else [])
    assert list(lone) == ([(low[0] - 1) // K] if fits and on_samples else [])
    assert (out != lattice).sum() == (len(nodes) if len(dropped) else 0)
    assert ((out > 0) == (sign > 0)).all() or not len(dropped)
    assert count_between(dropped, (0, SIZE)) == len(dropped)


def test_a_sample_of_0_is_no_piece_and_nodes_across_a_face_are_one_where_it_says_so():
    for value, count in ((0.0, 1), (-1e-3, 1), (-0.01, 0)):
        _, dropped, lone = drop(field_with(MIDDLE, value=value))
        assert (len(dropped), len(lone)) == (count, 1 - count)
    one, other = MIDDLE + 1, np.add(MIDDLE, (2, 2, 1))
    longer = [np.add(other, (n, 0, 0)) for n in range(K)]
    for value, count in ((-2.0, 0), (-0.5, 2)):  # deep: one piece of more than a voxel
        assert len(drop(field_with(one, *longer, value=value))[1]) == count


def test_a_piece_stays_if_only_it_touches_a_sphere():
    crumb = np.add(MIDDLE, (K // 2, 0, 0))
    lattice = field_with(crumb)
    distance = 1 - 2 / K * 0.3 / 1.3  # to its vertex, from the sample before
    for radius, stays in ((distance, True), (distance - 0.3, False), (-distance, False)):
        out, dropped, _ = drop(lattice, [(3, 3, 3)], [radius])
        assert len(dropped) == (not stays)
        assert (out <= 0).sum() == stays
    lattice[:, : MIDDLE[1] - 1] = -1  # a wall that the sphere touches, too
    _, dropped, _ = drop(lattice, [(3, 3, 3)], [distance])
    assert len(dropped) == 1


STRAIGHT = np.stack(np.meshgrid(*[np.arange(24) - 11.5] * 3, indexing="ij"), -1)


def turned_grid(size, spacing, seed):
    """Return the places (..., 3) of a centred grid, turned at random."""
    axes = [(np.arange(n) - (n - 1) / 2) * h for n, h in zip(size, spacing)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    return places @ Rotation.random(random_state=seed).as_matrix()


def rod(places, radius, half):
    """Return the distances to a cylinder along z."""
    across = np.linalg.norm(places[..., :2], axis=-1) - radius
    along = np.abs(places[..., 2]) - half
    beyond = np.hypot(np.maximum(across, 0), np.maximum(along, 0))
    return np.minimum(np.maximum(across, along), 0) + beyond


def box(places, *half):
    """Return the distances to a box."""
    q = np.abs(places) - half
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0)


@pytest.mark.parametrize("half", [None, (8, 8, 0.1), (9, 0.1, 0.3)], ids=["rod", "plate", "bar"])
def test_thin_solids_are_one_piece(network, half):
    turned = turned_grid((24,) * 3, (1,) * 3, 1)
    values = box(turned, *half) if half else rod(STRAIGHT, 0.5, 8)
    mesh = reconstruct(make_grid(values, spacing=1, origin=0, inside="negative"), network)
    assert mesh.is_closed()
    assert count_components(mesh.faces, len(mesh.vertices)) == 1


@pytest.mark.parametrize("size, spacing", [((36, 36, 16), (1, 1, 2.5)), ((30, 16, 16), (1, 2, 2))])
@pytest.mark.parametrize("solid", ["vessel", "plate"])
def test_masks_of_thin_solids_have_no_handles(network, size, spacing, solid):
    for seed in range(2):
        places = turned_grid(size, spacing, seed)
        mask = rod(places, 1.0, 10) <= 0 if solid == "vessel" else box(places, 9, 9, 0.75) <= 0
        mesh = reconstruct(make_grid(mask, spacing=spacing, origin=0), network)
        euler = len(mesh.vertices) - len(mesh.faces) // 2
        handles = (2 * count_components(mesh.faces, len(mesh.vertices)) - euler) // 2
        assert handles <= (0 if solid == "vessel" else 3)


def test_what_is_dropped_and_what_is_alone_is_said(command, tmp_path, monkeypatch):
    exact = Network.__call__

    def with_crumbs(network, patches, table, voxels, offsets, **options):
        values = exact(network, patches, table, voxels, offsets, **options)
        far = np.flatnonzero(patches[voxels, 13] > 1.5)[:3]
        values[far, np.flatnonzero((offsets == 0.5).all(1))] = -0.3  # within a voxel
        return values

    np.savez(tmp_path / "ball.npz", values=ball(16, 5.0).values, spacing=1.0, origin=0.0)
    mask = np.linalg.norm(STRAIGHT, axis=-1) < 7
    mask[3, 3, 3] = mask[20, 3, 4] = True
    np.savez(tmp_path / "mask.npz", values=mask, spacing=1.0, origin=0.0)
    words = ("upsample", tmp_path / "mask.npz", tmp_path / "mask.ply", "--json")
    _, out, err = command(*words)
    assert (json.loads(out)["dropped_pieces"], json.loads(out)["lone_samples"]) == (0, 2)
    note = "Note: voxels of the mask without a neighbour on their side, each meshed as a piece: 2"
    assert f"{note}\n" in err
    monkeypatch.setattr(Network, "__call__", with_crumbs)
    _, out, err = command("upsample", tmp_path / "ball.npz", tmp_path / "ball.ply", "--json")
    assert json.loads(out)["dropped_pieces"] == 3
    note = "Note: pieces smaller than a voxel that no sample supports, and so left out: 3"
    assert f"{note}\n" in err
