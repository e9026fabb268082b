"""FreeSurfer's and Analyze's files, with nibabel: arrays (x, y, z), x fastest.

FreeSurfer states the place, in RAS. Analyze states sizes and spacing only, and not which side is
left; a pair ``.hdr`` and ``.img`` of NIfTI states all.
"""

from __future__ import annotations

from ..regular import check_beside
from ..volume import XYZ, Request, Volume, from_affine
from .nifti import SIZES, opened, place_of, proxied

HEADER_MGH = 284  # bytes
PAIRS = (".img", ".IMG", ".img.gz")
NO_PLACE = (
    "Analyze files state no place and not which side is left: x, y and z are taken as stored, from "
    "0 on"
)


def read_mgh(request: Request) -> Volume:
    """Read a ``.mgh`` or ``.mgz`` file of FreeSurfer."""
    from nibabel.freesurfer.mghformat import MGHHeader

    stream = opened(request, request.path)
    header = MGHHeader(stream.read(HEADER_MGH))
    return proxied(request.path, stream, header, from_affine(header.get_affine()))


def read_analyze(request: Request) -> Volume:
    """Read a ``.hdr`` file and the ``.img`` file beside it, of Analyze or NIfTI."""
    import nibabel

    with request.path.open("rb") as file:
        head = file.read(SIZES[0])
    beside = [request.path.with_suffix(end) for end in PAIRS]
    path = next((other for other in beside if other.exists()), beside[0])
    stream = opened(request, check_beside(request.path, path.name))
    if head[344:347] == b"ni1":
        pair = nibabel.nifti1.Nifti1PairHeader(head)
        return proxied(path, stream, pair, *place_of(pair))
    header = nibabel.Spm2AnalyzeHeader(head)
    place = (header.get_zooms()[:3], None, XYZ)
    return proxied(path, stream, header, place, (NO_PLACE,))
