"""napari: fine, closed surfaces of a Labels or an Image layer, in its place.

They are in Layers > Visualize and in Plugins > super-sdf. docs/guides/plugins.md says how this
package and super-sdf are installed.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

if TYPE_CHECKING:
    import napari.layers
    import napari.types

MISSING = (
    "super-sdf is not installed in napari's Python: run "
    f"'{sys.executable} -m pip install /path/to/super-sdf'"
)
PLACE = "scale", "translate", "rotate", "shear", "affine", "units", "axis_labels"
Factor = Literal["automatic", "2", "4", "8", "16"]
Field = Literal["auto", "distance", "noisy", "mask", "smooth", "density"]


def labels_to_surfaces(
    labels: "napari.layers.Labels", factor: Factor = "automatic", simplify: float = 0.0
) -> list["napari.types.LayerDataTuple"]:
    """Return a closed surface of each label, in its colour; neighbours share their walls.

    Triangles are spared within ``simplify`` voxels; with 0, within about a hundredth.
    """
    check_installed()
    from super_sdf import reconstruct_labels

    values, spacing = samples_of(labels)
    options: dict[str, Any] = {"factor": factor_of(factor), "spacing": spacing}
    if simplify:
        options["tolerance"] = simplify * spacing.min()
    with shown("super-sdf") as progress:
        meshes = reconstruct_labels(values, progress=progress, **options)
    found = []
    for label, mesh in meshes.items():
        colours = np.tile(labels.get_color(label), (len(mesh.vertices), 1))
        found.append(surface(mesh, labels, f"{labels.name} {label}", vertex_colors=colours))
    return found


def image_to_surface(
    image: "napari.layers.Image",
    field: Field = "auto",
    level: float = 0.0,
    factor: Factor = "automatic",
    simplify: float = 0.0,
) -> list["napari.types.LayerDataTuple"]:
    """Return the closed surface of distances, of a mask, or of densities at a ``level``.

    Triangles are spared within ``simplify`` voxels; 0 keeps all.
    """
    check_installed()
    from super_sdf import make_grid, reconstruct, simplify_mesh

    values, spacing = samples_of(image)
    kind: dict[str, Any] = {"level": level} if field == "density" else {"field": field}
    grid = make_grid(values, spacing=spacing, **kind)
    with shown("super-sdf") as progress:
        mesh = reconstruct(grid, factor=factor_of(factor), progress=progress)
    if simplify:
        mesh = simplify_mesh(mesh, error=simplify * grid.voxel_size)
    return [surface(mesh, image, f"{image.name} surface")]


def check_installed() -> None:
    """Raise an error that says how super-sdf is installed, if it is not."""
    try:
        import super_sdf  # noqa: F401
    except ModuleNotFoundError:
        raise ModuleNotFoundError(MISSING) from None


def samples_of(layer: Any) -> tuple[Any, Any]:
    """Return the samples of a layer, at its finest scale, and their spacings."""
    return layer.data[0] if layer.multiscale else layer.data, np.abs(layer.scale)


def factor_of(factor: Factor) -> int | None:
    """Return the factor as a number; None, if super-sdf chooses it."""
    return None if factor == "automatic" else int(factor)


def surface(mesh: Any, layer: Any, name: str, **more: Any) -> Any:
    """Return a Surface layer as a tuple, which lies where the layer of its samples lies."""
    place = {key: getattr(layer, key) for key in PLACE if hasattr(layer, key)}
    data = mesh.vertices / np.abs(layer.scale), mesh.faces
    return (
        data,
        {"name": name, "shading": "smooth", "blending": "opaque", **place, **more},
        "surface",
    )


@contextmanager
def shown(what: str) -> Iterator[Any]:
    """Yield a callback of (done, total) that moves a bar of napari's activity dock."""
    from napari.utils import progress

    with progress(total=100, desc=what) as bar:
        yield lambda done, total: bar.update(int(100 * done / total) - bar.n)
