"""Any number of slabs and threads gives the same mesh, bit for bit, as far as indices go."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from conftest import ball, trilinear

from super_sdf import (SdfGrid, extract_mesh, load_network, make_grid, pipeline, reconstruct, upsample)
from super_sdf.errors import OptionError, OutOfMemoryError
from super_sdf.grid.field import Field
from super_sdf import threads as resources
from super_sdf.threads import Resources
from super_sdf.surface.mesh import Mesh, join_meshes
from super_sdf.options import MARCHING, SHARP
from super_sdf.pipeline import reconstruct_slabs
from super_sdf.slabs import cutting, preparing
from super_sdf.slabs.cutting import (check_vertices, cut, equal_parts, peak_bytes, plan_slabs, slab_bytes)
from super_sdf.surface.meshers import BY_NAME
from super_sdf.refine.nodes import number_parts, share_parts
from super_sdf.refine.survey import count_crossings, look_at_band, survey


@pytest.fixture(scope="module")
def network():
    return load_network("fast")


def rod(planes=56):
    """Return distances to a bent rod along x, longer than the planes that a slab depends on."""
    i, j, k = np.indices((planes, 14, 15)).astype(np.float64)
    middle = np.hypot(j - 6.6 - 1.5 * np.sin(i / 6), k - 7.2)
    return np.maximum(middle - 3.4, np.abs(i - planes / 2 + 0.4) - planes / 2 + 3.7)


def bad_samples(values):
    rng = np.random.default_rng(0)
    return values + (rng.random(values.shape) < 0.002)


def noise(values):
    return values + np.random.default_rng(0).uniform(-0.3, 0.3, values.shape)


FIELDS = {
    "clean": rod(),
    "bad samples": bad_samples(rod()),
    "noisy": noise(rod()),
    "cut off": np.clip(rod(), -0.4, 0.4),
    "leaves the grid": rod()[8:44, :10],
    "ends before the border": rod()[:, :13] - 0.3,
}


def in_pieces(grid, network, monkeypatch, pieces, **options):
    """Reconstruct in ``pieces`` slabs."""

    def plan(band, factor, receptive_field, resources, needed, mesher):
        return cut(band, pieces, receptive_field, mesher.planes_beside(factor))

    monkeypatch.setattr(preparing, "plan_slabs", plan)
    return list(reconstruct_slabs(grid, network, **options))


def joined(pieces):
    return join_meshes([mesh for piece in pieces for mesh in piece.meshes])


def assert_same(mesh, other):
    np.testing.assert_array_equal(mesh.faces, other.faces)
    np.testing.assert_array_equal(mesh.vertices, other.vertices)


@pytest.mark.parametrize(
    "field, factor, cap", [*((field, 2, True) for field in FIELDS), ("leaves the grid", 4, False)]
)
def test_slabs_change_nothing(network, monkeypatch, field, factor, cap):
    grid = SdfGrid.trusted(FIELDS[field], (1.0,) * 3)
    (whole,) = in_pieces(grid, network, monkeypatch, 1, factor=factor, cap=cap)
    for pieces in (3, 14) if field == "clean" else (7,):
        parts = in_pieces(grid, network, monkeypatch, pieces, factor=factor, cap=cap)
        assert len(parts) > 1
        assert_same(joined(parts), joined([whole]))
        for name, count in whole.counts.items():
            assert sum(part.counts[name] for part in parts) == count
        assert any(part.is_cut for part in parts) == whole.is_cut


def test_slabs_need_all_the_planes_beside_them(network, monkeypatch):
    """With fewer planes the mesh differs, so the tests above can fail."""
    grid = SdfGrid.trusted(FIELDS["clean"], (1.0,) * 3)
    options = {"factor": 2, "mesher": "marching"}
    one = reconstruct(grid, network, **options)
    monkeypatch.setattr(cutting, "REACH_IN_VOXELS", 1)
    mesh = joined(in_pieces(grid, network, monkeypatch, 4, **options))
    assert not np.array_equal(mesh.vertices, one.vertices)


@pytest.mark.parametrize("field", ["noisy", "bad samples"])
def test_threads_change_nothing(monkeypatch, field):
    grid = SdfGrid.trusted(FIELDS[field][:32], (1.0,) * 3, (1.0, 2.0, 3.0))
    monkeypatch.setattr(resources, "CHUNK", 5000)
    monkeypatch.setattr(resources, "MIN_PER_THREAD", 1000)
    monkeypatch.setattr(resources, "count_cores", lambda: 3)

    def mesh_with(number):
        def stand_in(*inputs):
            return trilinear(*inputs)

        stand_in.threads = number
        return reconstruct(grid, stand_in, 2)

    one = mesh_with(1)
    for number in (2, 3):
        assert_same(mesh_with(number), one)


def test_a_network_without_a_receptive_field_is_called_once_for_the_whole_band():
    calls = []

    def network(patches, table, voxels, offsets):
        calls.append(len(patches))
        return trilinear(patches, table, voxels, offsets)

    band = survey(ball())
    list(reconstruct_slabs(ball(), network, max_memory=10**12))
    assert calls == [len(band.voxel_ijk)]
    with pytest.raises(OutOfMemoryError, match=r"[MG]B of memory at once, 100 MB may be used; "):
        list(reconstruct_slabs(ball(), network, max_memory=10**8))


@pytest.mark.parametrize("pieces", [1, 5, 1000])
def test_slabs_cover_the_grid_once(pieces):
    band = survey(SdfGrid.trusted(rod(), (1.0,) * 3))
    slabs = cut(band, pieces, receptive_field=4, beside=1)
    assert slabs[0].planes[0] == 0 and slabs[-1].planes[1] == 56
    assert all(a.planes[1] == b.planes[0] for a, b in pairwise(slabs))
    for slab in slabs:
        ijk = band.voxel_ijk[slab.seen]
        reach = 1 + cutting.REACH_IN_VOXELS + 4
        first, last = max(slab.planes[0] - reach, 0), min(slab.planes[1] + reach, 56)
        want = (band.voxel_ijk[:, 0] >= first) & (band.voxel_ijk[:, 0] < last)
        assert len(ijk) == want.sum() and first <= ijk[0, 0] and ijk[-1, 0] < last


def test_less_memory_makes_more_slabs_and_too_little_is_refused(bare_plan):
    band = survey(SdfGrid.trusted(rod(112), (1.0,) * 3))
    need = peak_bytes(band, [cutting.whole(band)], 4)
    assert len(plan_slabs(band, 4, 2, Resources(memory=need))) == 1
    less = [Resources(memory=10**8 + int(share * (need - 10**8))) for share in (0.9, 0.7)]
    counts = [len(plan_slabs(band, 4, 2, resources)) for resources in less]
    assert 1 < counts[0] <= counts[1]
    with pytest.raises(OutOfMemoryError, match=r"^factor 4 on [\d,]+ voxels needs 1\d\d MB of "):
        plan_slabs(band, 4, 2, Resources(memory=10**8 + 1))
    assert len(plan_slabs(band, 4, 2, Resources(memory=None))) == 1


def test_where_only_marching_cubes_fits_it_is_named(bare_plan):
    band, free = survey(SdfGrid.trusted(rod(112), (1.0,) * 3)), Resources(memory=None)
    both = [BY_NAME[name] for name in (SHARP, MARCHING)]
    more, less = (cutting.least_bytes(band, 4, 2, free, cutting.NETWORK_BYTES, m) for m in both)
    between = Resources(memory=(more + less) // 2)
    with pytest.raises(OutOfMemoryError) as caught:
        plan_slabs(band, 4, 2, between, mesher=both[0])
    want = "; use --mesher marching, which leaves edges alone, or a smaller factor, or allow more "
    assert want in str(caught.value)
    assert len(plan_slabs(band, 4, 2, between, mesher=both[1])) > 1
    with pytest.raises(OutOfMemoryError, match="; use a smaller factor, or allow more "):
        plan_slabs(band, 4, 2, Resources(memory=less // 2), mesher=both[0])


def test_a_large_band_is_cut_where_that_costs_hardly_more(monkeypatch):
    band, free = survey(SdfGrid.trusted(rod(112), (1.0,) * 3)), Resources(memory=None)
    monkeypatch.setattr(cutting, "LARGE", len(band.voxel_ijk) // 4)

    def seen(pieces):
        slabs = cut(band, pieces, receptive_field=2, beside=1)
        return sum(slab.seen.stop - slab.seen.start for slab in slabs)

    for most, want in ((seen(2) - 1, 1), (seen(2), 2), (seen(3), 3), (10**9, 4)):
        monkeypatch.setattr(cutting, "SEEN_AGAIN", most / len(band.voxel_ijk))
        assert len(plan_slabs(band, 4, 2, free)) == want
        assert len(plan_slabs(band, 4, None, free)) == 1


def test_a_band_larger_than_memory_is_refused_while_it_is_read():
    with pytest.raises(
        OutOfMemoryError, match=r"the band of the first \d+ planes already takes \d MB of memory, "
    ):
        survey(ball(), resources=Resources(memory=400_000))


def test_the_plan_counts_how_distances_are_made_and_the_spline():
    values = np.tile(ball(20, 7.5).values, (2, 1, 1)) < 0
    mask, exact = survey(make_grid(values, spacing=1, origin=0)), survey(ball(20, 7.5))
    for band in (mask, exact):
        assert band.peak > len(band.voxel_ijk) * 123 + len(band.beyond.number) * 12
    slabs = [cutting.whole(mask)]
    assert peak_bytes(replace(mask, peak=10**12), slabs, 4) == 10**12

    def bytes_of(band):
        slab = cutting.whole(exact)
        return slab_bytes(band, slab.seen, slab.decoded, slab.planes, 2)

    fitted = replace(exact, field=Field(smooth=exact.patches), exact=np.zeros_like(exact.exact))
    assert bytes_of(exact) > bytes_of(fitted)
    assert bytes_of(replace(fitted, shape=(512, 512, 512))) > 60 << 20


def solid_block():
    """Return a block that fills the grid in its middle planes, whose samples are far from 0."""
    i, j, k = np.indices((60, 12, 12)).astype(np.float64)
    return np.maximum(np.abs(i - 29.6) - 26.2, np.maximum(np.abs(j - 5.5), np.abs(k - 5.5)) - 14)


BRICKS = {**FIELDS, "fills the grid": solid_block(), "fills, turned over": -solid_block()}


@pytest.mark.parametrize(
    "field, mesher, cap",
    [
        *((field, "marching", True) for field in BRICKS),
        ("leaves the grid", "marching", False),
        ("bad samples", "sharp", True),
        ("fills the grid", "sharp", True),
    ],
)
def test_bricks_of_planes_make_the_same_mesh(network, field, mesher, cap):
    """Each knows only its planes and those beside them, in one slab or several."""
    grid = SdfGrid.trusted(BRICKS[field], (1.0,) * 3)
    options = {"cap": cap, "mesher": mesher, "max_memory": 10**12}
    whole = list(reconstruct_slabs(grid, network, 2, **options))
    seen = look_at_band(grid, 0.0)
    assert seen.summary.voxels == whole[0].whole["band_voxels"]
    assert seen.summary.noisy == whole[0].whole["noisy_voxels"]
    meshes, counts, vertices = [], [], 0
    for planes in equal_parts(np.append(0, np.cumsum(seen.decoded)), 6):
        brick = list(
            pipeline.reconstruct_planes(grid, network, 2, planes, whole=seen.summary, **options)
        )
        part = joined(brick)
        meshes.append(Mesh(part.vertices, part.faces + vertices))
        vertices += len(part.vertices)
        counts += [brick[0].whole | {"is_cut": any(piece.is_cut for piece in brick)}]
    assert_same(join_meshes(meshes), joined(whole))
    for name in ("band_voxels", "noisy_voxels"):
        assert sum(count[name] for count in counts) == whole[0].whole[name]
    assert any(count["is_cut"] for count in counts) == whole[0].is_cut


def test_nodes_are_counted_beyond_32_bits():
    """A few voxels that share nothing, with very many nodes per part, stand in for a large grid."""
    table = np.full((5, 27), -1, np.int32)
    table[:, 13] = np.arange(5)
    parts = share_parts(table)
    with pytest.raises(OptionError, match=r"^there are 13,500,000,000 nodes, but 32-bit indices "):
        number_parts(parts, np.full(27, 10**8))
    starts, count = number_parts(parts, np.full(27, 10**7))
    assert count == 135 * 10**7 and starts.max() == 134 * 10**7


def test_too_many_vertices_are_refused_before_an_index_overflows():
    """The vertices of earlier slabs count, and the last valid index is used."""
    field = upsample(ball(), trilinear, 2)
    room = resources.MAX_INDEX - len(extract_mesh(field, ball()).vertices)
    assert extract_mesh(field, ball(), first_vertex=room).faces.min() == room
    message = r"^there are 2,147,483,648 vertices, but 32-bit indices allow only 2,147,483,647: use"
    with pytest.raises(OptionError, match=message):
        extract_mesh(field, ball(), first_vertex=room + 1)


def test_far_too_many_vertices_are_refused_before_the_network_runs(monkeypatch):
    band = survey(ball(24, 9.0))
    vertices = len(reconstruct(ball(24, 9.0), trilinear, 4).vertices)
    estimate = count_crossings(band.patches) * 4**2
    assert 0.8 < estimate / vertices < 1.25
    monkeypatch.setattr(resources, "MAX_INDEX", estimate // 2)
    check_vertices(band, 4)
    monkeypatch.setattr(resources, "MAX_INDEX", estimate // 2 - 1)
    with pytest.raises(OptionError, match=rf"there are {estimate // 2:,} vertices or more, but"):
        check_vertices(band, 4)


def test_a_plane_that_holds_everything_is_meshed_in_chunks_to_the_same_mesh(monkeypatch):
    i, j, k = np.indices((8, 16, 16)).astype(np.float64)
    grid = SdfGrid(np.abs(i - 3.6) - 1.3 + 0.01 * np.sin(j + k), 1.0)
    meshes = []
    for chunk in (1 << 19, 2000):
        monkeypatch.setattr(resources, "CHUNK", chunk)
        meshes.append(reconstruct(grid, trilinear, 2))
    np.testing.assert_array_equal(meshes[0].faces, meshes[1].faces)
    np.testing.assert_array_equal(meshes[0].vertices, meshes[1].vertices)
    assert meshes[0].is_closed()
