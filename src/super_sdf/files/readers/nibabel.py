"""NIfTI, FreeSurfer and Analyze files: world coordinates are RAS.

Analyze states sizes and spacing only, and not which side is left; a pair ``.hdr`` and ``.img`` of
NIfTI states all.
"""

from __future__ import annotations

from contextlib import suppress
from itertools import product
from typing import Any

import numpy as np

from ...options import RAS
from ..formats import check_beside
from . import LABELS, XYZ, Request, Volume, from_affine, triple
from .axes import in_unit

PAIRS = (".img", ".IMG", ".img.gz")
UNITS = {1: "metre", 3: "micrometre"}  # of lengths, but for millimetres
INTENT_LABEL = 1002
ASTRAY = 0.1  # of a voxel: how far sform and qform may place a corner apart without a note
NO_PLACE = (
    "Analyze files state no place and not which side is left: x, y and z are taken as stored, from "
    "0 on"
)


def read_nifti(request: Request) -> Volume:
    """Read a ``.nii`` or ``.nii.gz`` file, or a pair, of NIfTI-1 or NIfTI-2.

    The affine is nibabel's: the sform if there is one, else the qform. Without both the axes of the
    array are x, y and z, as ITK and method 1 of the standard have it; nibabel mirrors x. Values are
    scaled by the slope and intercept of the header.
    """
    image, header = _load(request)
    image["notes"] = in_unit(UNITS.get(int(header["xyzt_units"]) & 7, ""))
    if int(header["intent_code"]) == INTENT_LABEL:
        image["hint"] = LABELS
    codes = int(header["sform_code"]), int(header["qform_code"])
    if codes == (0, 0):
        image["notes"] += (
            "it states no place (sform_code and qform_code are 0): its axes are taken as x, y and "
            "z, as ITK does; nibabel would mirror x",
        )
        return Volume(**image, spacing=triple(np.abs(header.get_zooms()[:3])), direction=XYZ)
    if min(codes) > 0:
        corners = np.array(list(product(*((0, size - 1) for size in image["stored"][:3]), [1])))
        off = 0.0
        with suppress(ValueError):  # if the qform is no rotation
            off = np.abs(corners @ (header.get_sform() - header.get_qform()).T).max()
        if off > ASTRAY * min(header.get_zooms()[:3]):
            image["notes"] += (
                f"its sform (code {codes[0]}) and qform (code {codes[1]}) place a corner {off:.3g} "
                "apart: the sform is taken, as nibabel does; ITK may take the qform",
            )
    return Volume(**image, **from_affine(header.get_best_affine()), space=RAS)


def read_mgh(request: Request) -> Volume:
    """Read a ``.mgh`` or ``.mgz`` file of FreeSurfer."""
    image, header = _load(request)
    return Volume(**image, **from_affine(header.get_affine()), space=RAS)


def read_analyze(request: Request) -> Volume:
    """Read a ``.hdr`` file and the ``.img`` file beside it, of Analyze or NIfTI."""
    beside = [request.path.with_suffix(end) for end in PAIRS]
    check_beside(request.path, next((o for o in beside if o.exists()), beside[0]).name)
    with request.path.open("rb") as file:
        if file.read(348)[344:347] == b"ni1":
            return read_nifti(request)
    image, header = _load(request)
    return Volume(**image, spacing=triple(header.get_zooms()[:3]), direction=XYZ, notes=(NO_PLACE,))


def _load(request: Request) -> tuple[dict[str, Any], Any]:
    """Return what a ``Volume`` says of an image beside its place, and the header."""
    import nibabel

    image: Any = nibabel.load(request.path, mmap=False)
    proxy, shape, dtype = image.dataobj, image.shape, image.get_data_dtype()
    index = request.pick(shape, kept=(0, 1, 2))
    if (getattr(proxy, "slope", 1), getattr(proxy, "inter", 0)) != (1, 0):
        dtype = np.asarray(proxy[(slice(0, 1),) * len(shape)]).dtype
    about = dict(load=lambda at: proxy[at], stored=shape, dtype=dtype, index=index)
    return about, image.header
