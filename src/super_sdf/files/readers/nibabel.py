"""NIfTI, FreeSurfer and Analyze files: world coordinates are RAS.

Analyze states sizes and spacing only, and not which side is left; a pair ``.hdr`` and ``.img`` of
NIfTI states all.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...options import RAS
from ..formats import check_beside
from . import LABELS, XYZ, Request, Volume, from_affine, one_unit, triple

PAIRS = (".img", ".IMG", ".img.gz")
UNITS = {1: "metre", 3: "micrometre"}  # of lengths, but for millimetres
INTENT_LABEL = 1002


def read_nifti(request: Request) -> Volume:
    """Read a NIfTI file or pair, a file of FreeSurfer, or the ``.hdr`` of Analyze.

    The affine is nibabel's: of NIfTI the sform if there is one, else the qform. Without both, and
    of Analyze, the axes of the array are x, y and z, as ITK and method 1 of the standard have it;
    nibabel mirrors x. Values are scaled by the slope and intercept of the header.
    """
    import nibabel

    if request.path.suffix.lower() == ".hdr":
        beside = [request.path.with_suffix(end) for end in PAIRS]
        check_beside(request.path, next((o for o in beside if o.exists()), beside[0]).name)
    image: Any = nibabel.load(request.path, mmap=False)
    proxy, shape, header = image.dataobj, image.shape, image.header
    place: dict[str, Any] = {"index": request.pick(shape, kept=(0, 1, 2))}
    codes, is_placed = ("sform_code", "qform_code"), isinstance(image, nibabel.MGHImage)
    if "xyzt_units" in header:
        is_placed = any(int(header[code]) for code in codes)
        place["notes"] = one_unit([UNITS.get(int(header["xyzt_units"]) & 7, "")])[1]
        place["hint"] = LABELS if int(header["intent_code"]) == INTENT_LABEL else ""
    if is_placed:
        place |= {**from_affine(header.get_best_affine()), "space": RAS}
    else:
        place |= {"spacing": triple(np.abs(header.get_zooms()[:3])), "direction": XYZ}
    dtype = np.asarray(proxy[(slice(0, 1),) * len(shape)]).dtype
    return Volume(lambda at: proxy[at], shape, dtype, **place)


read_mgh = read_analyze = read_nifti
