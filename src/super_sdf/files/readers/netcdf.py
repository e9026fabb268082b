"""NetCDF files, with netCDF4: a variable of three axes, placed by the coordinates of its axes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..boxes import Box
from ..volume import Request, Volume
from .axes import Axes
from .choosing import choose_member
from .stored import along, placed

PACKING = ("scale_factor", "add_offset", "_FillValue", "missing_value", "valid_range")


def read_netcdf(request: Request) -> Volume:
    """Read ``FILE.nc:/GROUP/VARIABLE``; without a name the only variable of three axes.

    Values are scaled as the file says, and missing ones unknown.
    """
    import netCDF4

    file = request.files.enter_context(netCDF4.Dataset(request.path))
    found = dict(_variables(file))
    values = found[choose_member(request, list(found), "variable of three axes")]
    is_plain = values.dtype.kind in "iu" and not set(PACKING) & set(values.ncattrs())
    values.set_auto_maskandscale(not is_plain)
    about = {name: values.getncattr(name) for name in values.ncattrs()}
    space, place = placed(_axes(values), about, values.shape, request.axes)
    dtype = values.dtype if is_plain else np.result_type(values[(0,) * values.ndim], np.float32)

    def read_box(box: Box) -> NDArray[Any]:
        samples: Any = values[along(space, box, values.ndim)]
        if np.ma.isMaskedArray(samples):
            samples = samples.astype(dtype).filled(np.nan)
        return np.asarray(samples, dtype)

    def read(first: int, last: int) -> NDArray[Any]:
        return read_box((slice(first, last), slice(0, shape[1]), slice(0, shape[2])))

    shape, chunks = tuple(values.shape[axis] for axis in space), values.chunking()
    return Volume(
        *(shape, np.dtype(dtype), read),
        chunks=tuple(chunks[axis] for axis in space) if isinstance(chunks, list) else None,
        read_box=read_box,
        packed=request.path.stat().st_size,
        **place,
    )


def _variables(group: Any) -> Iterator[tuple[str, Any]]:
    """Yield the variables that may be grids, by their paths, those of groups last."""
    for name, values in group.variables.items():
        if values.ndim >= 3 >= sum(count > 1 for count in values.shape):
            yield f"{group.path.rstrip('/')}/{name}", values
    for below in group.groups.values():
        yield from _variables(below)


def _axes(values: Any) -> Axes:
    """Return the axes of a variable; those whose coordinates state an ``axis`` have its name."""
    scales = [_coordinates(values.group(), name) for name in values.dimensions]
    names = [getattr(s, "axis", name) for s, name in zip(scales, values.dimensions)]

    def found(axis: int) -> tuple[NDArray[Any] | None, dict[str, Any]]:
        scale = scales[axis]
        if scale is None:
            return None, {}
        return np.asarray(scale[:]), {name: scale.getncattr(name) for name in scale.ncattrs()}

    return Axes.of_coordinates(names, found)


def _coordinates(group: Any, name: str) -> Any:
    """Return the coordinates of a dimension, which are in its group or one above; else None."""
    while group is not None and name not in group.variables:
        group = group.parent
    scale = None if group is None else group.variables[name]
    return scale if scale is not None and scale.dimensions == (name,) else None
